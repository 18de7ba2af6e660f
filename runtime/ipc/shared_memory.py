"""Shared memory of the station processes: double-buffered records and byte rings, each with one writer.

Independent of robots. The memory is an anonymous file (memfd) whose descriptor the supervisor passes to its children:
it has no name that could remain, and vanishes with the last process that has it open.
"""

from __future__ import annotations

import mmap
import os
import struct
import zlib
from collections.abc import Iterator
from typing import Any

import numpy as np

from runtime.core.errors import RuntimeFault
from runtime.ipc.bells import Bell

_LENGTH_CRC = struct.Struct("<II")
_ALIGN = 64  # [bytes] one cache line, so that two writers never share one


def int64_view(memory: mmap.mmap, offset: int) -> memoryview[int]:
    """Return a view of one aligned 8-byte integer, which is read and written atomically.

    struct.pack_into is not used, because it clears the bytes before it writes them, so that a reader could get zeros.
    """
    return memoryview(memory)[offset : offset + 8].cast("q")


def float64_view(memory: mmap.mmap, offset: int) -> memoryview[float]:
    """Return a view of one aligned 8-byte float, which is read and written atomically."""
    return memoryview(memory)[offset : offset + 8].cast("d")


def align_size(size: int) -> int:
    """Return `size` rounded up to whole cache lines."""
    return (size + _ALIGN - 1) // _ALIGN * _ALIGN


def create(size: int) -> int:
    """Create an anonymous shared file of `size` bytes; return its inheritable descriptor."""
    descriptor = os.memfd_create("eva", 0)
    os.ftruncate(descriptor, size)
    return descriptor


def attach(descriptor: int, size: int = 0) -> mmap.mmap:
    """Map the first `size` bytes of an inherited shared file for reading and writing; 0: the whole file."""
    return mmap.mmap(descriptor, size or os.fstat(descriptor).st_size)


class TornReadError(RuntimeFault):
    """Error about a record that changed during many successive reads; its writer is far faster than expected."""


class Record:
    """Structured record with one writer and any number of readers.

    It is double-buffered, so that a preempted writer never makes it unreadable. The checksum covers content and
    version. A reader therefore notices if the content and the version that it has read do not belong together, which
    happens if it was delayed between the two reads or the processor has reordered them.
    """

    def __init__(self, memory: mmap.mmap, offset: int, dtype: np.dtype[np.void]) -> None:
        self._memory = memory
        self._version = int64_view(memory, offset)
        self._offset = offset
        self._dtype = dtype
        self._slot = align_size(dtype.itemsize + 4)

    @staticmethod
    def size(dtype: np.dtype[np.void]) -> int:
        """Return the bytes that a record of `dtype` needs in the shared file."""
        return _ALIGN + 2 * align_size(dtype.itemsize + 4)

    @property
    def version(self) -> int:
        """Number of writes of the record; 0: never written."""
        return int(self._version[0])

    def write(self, value: np.void | np.ndarray[Any, np.dtype[np.void]]) -> None:
        """Replace the record's content; readers get the new content completely or not at all."""
        version = self.version + 1
        start = self._offset + _ALIGN + (version & 1) * self._slot
        payload = value.tobytes()
        self._memory[start + 4 : start + 4 + len(payload)] = payload
        self._memory[start : start + 4] = _checksum(payload, version)
        # The version is published last: a reader uses the new buffer only when it is complete.
        self._version[0] = version

    def read(self) -> np.void:
        """Return the newest content, zeros if it was never written.

        Raises:
            TornReadError: the record changed during each of 100 attempts.
        """
        for _ in range(100):
            version = self.version
            if version == 0:
                return _single_record(np.zeros(1, self._dtype))
            start = self._offset + _ALIGN + (version & 1) * self._slot
            checksum = self._memory[start : start + 4]
            payload = self._memory[start + 4 : start + 4 + self._dtype.itemsize]
            if _checksum(payload, version) == checksum:
                return _single_record(np.frombuffer(payload, self._dtype))
        raise TornReadError(f"record at offset {self._offset} could not be read in 100 tries")


def _checksum(payload: bytes, version: int) -> bytes:
    return zlib.crc32(payload, version & 0xFFFFFFFF).to_bytes(4, "little")


def _single_record(records: np.ndarray[Any, np.dtype[np.void]]) -> np.void:
    record: np.void = records[0]
    return record


class Ring:
    """Queue of byte messages with one writer and one reader; a full ring refuses messages and never overwrites.

    A message becomes visible when the head moves, so a writer killed in the middle leaves no trace. A restarted writer
    or reader continues at the positions in the memory.
    """

    def __init__(self, memory: mmap.mmap, offset: int, capacity: int) -> None:
        self._memory = memory
        self._head = int64_view(memory, offset)
        self._tail = int64_view(memory, offset + _ALIGN)
        self._data = offset + 2 * _ALIGN
        self._capacity = capacity
        self.refused = 0
        self.bell: Bell | None = None  # rung after each message if the reader sleeps

    @staticmethod
    def size(capacity: int) -> int:
        """Return the bytes that a ring for `capacity` bytes of messages needs in the shared file."""
        return 2 * _ALIGN + align_size(capacity)

    @property
    def waiting(self) -> bool:
        """True if there is an unread message."""
        return int(self._head[0]) != int(self._tail[0])

    @property
    def fill(self) -> float:
        """Share of the capacity in use, 0 to 1."""
        return (int(self._head[0]) - int(self._tail[0])) / self._capacity

    def push(self, payload: bytes) -> bool:
        """Append a message; return False, and count it in `refused`, if there is no room."""
        head, tail = int(self._head[0]), int(self._tail[0])
        needed = _LENGTH_CRC.size + len(payload)
        if head - tail + needed > self._capacity:
            self.refused += 1
            return False
        self._write(head, _LENGTH_CRC.pack(len(payload), zlib.crc32(payload)) + payload)
        self._head[0] = head + needed
        if self.bell is not None:
            self.bell.ring()
        return True

    def drain(self) -> Iterator[bytes]:
        """Yield all messages, oldest first.

        A message is consumed before it is yielded, so a reader that fails on it does not get it again.
        """
        while True:
            head, tail = int(self._head[0]), int(self._tail[0])
            if head == tail:
                return
            length, checksum = _LENGTH_CRC.unpack(self._read(tail, _LENGTH_CRC.size))
            payload = self._read(tail + _LENGTH_CRC.size, length)
            if zlib.crc32(payload) != checksum:
                return  # not all bytes are visible yet on a weakly ordered machine: retry at the next call
            self._tail[0] = tail + _LENGTH_CRC.size + length
            yield payload

    def _write(self, position: int, data: bytes) -> None:
        start = position % self._capacity
        first = min(len(data), self._capacity - start)
        self._memory[self._data + start : self._data + start + first] = data[:first]
        if first < len(data):
            self._memory[self._data : self._data + len(data) - first] = data[first:]

    def _read(self, position: int, length: int) -> bytes:
        start = position % self._capacity
        first = min(length, self._capacity - start)
        data = self._memory[self._data + start : self._data + start + first]
        if first < length:
            data += self._memory[self._data : self._data + length - first]
        return data
