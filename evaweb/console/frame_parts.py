"""Parts of frames, each encoded once for all viewers: a viewer's frame is a concatenation of parts.

The layout is that of evaweb.core.binary_frames, which also reads it.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evaweb.core.binary_frames import to_json_value

_ALIGNMENT = 8
_AGE = "age"  # placeholder of a part's age


@dataclass(frozen=True, slots=True, eq=False)
class EncodedPart:
    """Encoded newest content of one stream.

    `entry` is its header entry in pieces: texts, integers (offsets into `body`), and _AGE for the time since
    `received` (monotonic clock of this process). The length of `body` is a multiple of 8 bytes.
    """

    stream: str
    entry: tuple[str | int, ...]
    body: bytes
    received: float

    def at(self, offset: int, now: float) -> str:
        """Return the header entry for a body that begins at `offset` in the frame."""
        return "".join(
            str(offset + piece)
            if isinstance(piece, int)
            else f"{max(0.0, now - self.received):.3f}"
            if piece is _AGE
            else piece
            for piece in self.entry
        )


def encode_facts(stream: str, content: Mapping[str, Any], received: float) -> EncodedPart:
    """Return the part that encodes a map, such as the state."""
    return EncodedPart(stream, (f'{_key(stream)}:{{"json":{_json(content)}}}',), b"", received)


def encode_numbers(
    stream: str, content: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]], received: float
) -> EncodedPart:
    """Return the part that encodes a map with float32 arrays, such as the joints."""
    entry: list[str | int] = [f'{_key(stream)}:{{"json":{_json(content)},"arrays":{{']
    body = b""
    for count, (name, array) in enumerate(arrays.items()):
        entry += [f'{"," if count else ""}{_key(name)}:{{"offset":', len(body), f",{_shape(array)}}}"]
        body += _bytes(array)
    return EncodedPart(stream, (*entry, "}}"), body, received)


def encode_array(stream: str, content: NDArray[Any], received: float) -> EncodedPart:
    """Return the part that encodes one float32 array, such as the poses."""
    return EncodedPart(
        stream, (f'{_key(stream)}:{{"offset":', 0, f",{_shape(content)}}}"), _bytes(content), received
    )


def encode_picture(stream: str, jpeg: bytes, received: float) -> EncodedPart:
    """Return the part that encodes one JPEG image; its entry carries the image's age when the frame is sent."""
    entry = (f'{_key(stream)}:{{"mime":"image/jpeg","length":{len(jpeg)},"offset":', 0, ',"age":', _AGE, "}")
    return EncodedPart(stream, entry, _padded(jpeg), received)


def build_frame(parts: Iterable[EncodedPart], number: int, now: float) -> bytes:
    """Return the binary message with these parts, sent at `now`."""
    entries, bodies, offset = [], [], 0
    for part in parts:
        entries.append(part.at(offset, now))
        bodies.append(part.body)
        offset += len(part.body)
    header = f'{{"frame":{number},"t":{now:.4f},"streams":{{{",".join(entries)}}}}}'.encode()
    start = 4 + len(header)
    return b"".join([struct.pack("<I", len(header)), header, bytes(-start % _ALIGNMENT), *bodies])


def _key(name: str) -> str:
    return json.dumps(name)


def _json(content: Mapping[str, Any]) -> str:
    return json.dumps(to_json_value(content), separators=(",", ":"), allow_nan=False)


def _shape(content: NDArray[Any]) -> str:
    return f'"dtype":"f4","shape":{json.dumps(list(content.shape), separators=(",", ":"))}'


def _bytes(content: NDArray[Any]) -> bytes:
    return _padded(np.ascontiguousarray(content, "<f4").tobytes())


def _padded(data: bytes) -> bytes:
    return data + bytes(-len(data) % _ALIGNMENT)
