"""Reader of bags: MCAP files and folders of ROS 2, and .bag files of ROS 1."""

from __future__ import annotations

import hashlib
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Any, Literal, NamedTuple

from runtime.core.errors import RecordingError
from runtime.interop.bag_messages import NUMBERS

_BLOCK = 1024 * 1024


class Sample(NamedTuple):
    """Message of a topic with its time [ns]."""

    topic: str
    stamp: int
    message: Any


class Bag:
    """Opened bag; `kinds` maps its topics to the types of their messages.

    Raises:
        RecordingError: rosbags is not installed, or the file is no bag that it reads.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._stack = ExitStack()
        try:
            from rosbags.highlevel import AnyReader
            from rosbags.typesys import Stores, get_typestore
        except ImportError as error:
            raise RecordingError(
                f"{path}: bags are read by rosbags, which is not installed: pip install 'eva-web[bags]' ({error})"
            ) from error
        try:
            # Definitions in the bag take precedence; the store is for bags that contain none.
            self._reader: Any = self._stack.enter_context(
                AnyReader([path], default_typestore=get_typestore(Stores.ROS2_JAZZY))
            )
        except Exception as error:  # the reader raises many types for files that are damaged or no bags
            raise _unreadable(path, error) from error
        self.kinds: Mapping[str, str] = {
            connection.topic: str(connection.msgtype) for connection in self._reader.connections
        }

    def __enter__(self) -> Bag:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stack.close()

    def samples(
        self, topics: Collection[str], stamps: Literal["header", "log"] = "header"
    ) -> Iterator[Sample]:
        """Yield the messages of some topics in the order in which they were logged.

        Raises:
            RecordingError: The bag ends within a message, or a message is damaged.
        """
        connections = [one for one in self._reader.connections if one.topic in topics]
        if not connections:
            return
        try:
            for connection, logged, data in self._reader.messages(connections=connections):
                message = self._reader.deserialize(data, connection.msgtype)
                stamp = _header_stamp(message) if stamps == "header" else None
                yield Sample(connection.topic, int(logged) if stamp is None else stamp, message)
        except RecordingError:
            raise
        except Exception as error:  # as above
            raise _unreadable(self.path, error) from error

    def first_names(self, topic: str) -> Sequence[str]:
        """Return the names of the numbers in the first message of a topic that has any."""
        for sample in self.samples([topic]):
            if names := NUMBERS[self.kinds[topic]](sample.message).names:
                return names
        return ()


def bag_size(path: Path) -> int:
    """Return the size of a bag on the disk [bytes]."""
    return sum(file.stat().st_size for file in _files(path))


def _files(path: Path) -> list[Path]:
    return sorted(part for part in path.rglob("*") if part.is_file()) if path.is_dir() else [path]


def file_digest(path: Path) -> str:
    """Return the SHA-256 of a file, or of all files in a folder by name."""
    digest = hashlib.sha256()
    try:
        for file in _files(path):
            digest.update(file.name.encode() + b"\0")
            with file.open("rb") as opened:
                while block := opened.read(_BLOCK):
                    digest.update(block)
    except OSError as error:
        raise _unreadable(path, error) from error
    return digest.hexdigest()


def _header_stamp(message: Any) -> int | None:
    """Return the stamp of a message [ns]; None if it has none, or one that was never set."""
    time = getattr(getattr(message, "header", message), "stamp", None) or getattr(message, "timestamp", None)
    if time is None:
        return None
    stamp = int(time.sec) * 10**9 + int(time.nanosec)
    return stamp or None


def _unreadable(path: Path, error: Exception) -> RecordingError:
    return RecordingError(f"{path} cannot be read as a bag: {type(error).__name__}: {error}")
