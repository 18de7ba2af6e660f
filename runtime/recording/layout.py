"""Layout of an episode as its manifest declares it: widths of vectors, cameras, columns."""

from __future__ import annotations

import math
import uuid
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, TypeVar

from runtime.benches.schema import DEFAULT_BENCH
from runtime.core.errors import RecordingError

VECTOR_STREAMS = ("qvel", "effort", "eef", "eef_action")
FORMAT = 1

_Kind = TypeVar("_Kind")


@dataclass(frozen=True, slots=True)
class Layout:
    """Part of a manifest that determines the form of the files.

    `cameras` maps a key to the (height, width) of its video.
    """

    uuid: str
    fps: float
    dim: int
    eef_dim: int
    started: float  # start on our monotonic clock [s]; times in the tables count from it
    cameras: Mapping[str, tuple[int, int]]
    streams: tuple[str, ...]  # recorded members of VECTOR_STREAMS
    capture_streams: tuple[str, ...]
    pictures: Mapping[str, tuple[int, int]]  # like `cameras`, before scaling
    max_skew_s: float  # a row with a larger spread of capture times is flagged; inf: none

    def width(self, vector: str) -> int:
        """Return the width of the vector `vector`."""
        return self.eef_dim if vector in ("eef", "eef_action") else self.dim

    @classmethod
    def from_manifest(cls, manifest: Mapping[str, object]) -> Layout:
        """Read the layout from a manifest. Raises RecordingError with the key that is missing or wrong."""
        if manifest.get("format", FORMAT) != FORMAT:
            raise _wrong("format", manifest["format"], str(FORMAT))
        robot = _require_key(manifest, "robot", dict)
        streams = _require_key(manifest, "streams", dict)
        chosen = tuple(name for name in VECTOR_STREAMS if streams.get(name) is True)
        poses = any(name.startswith("eef") for name in chosen)
        cameras = _require_key(manifest, "cameras", dict)
        return cls(
            uuid=_uuid(manifest),
            fps=_rate(manifest, "fps"),
            dim=_count(robot, "dim"),
            eef_dim=_count(robot, "eef_dim") if poses else 0,
            started=_number(manifest, "started_monotonic"),
            cameras={key: _camera(key, value) for key, value in cameras.items()},
            streams=chosen,
            capture_streams=tuple(str(name) for name in _require_key(manifest, "capture_streams", list)),
            pictures={key: _captured(value) for key, value in cameras.items()},
            max_skew_s=_number(manifest, "max_skew_s") if "max_skew_s" in manifest else math.inf,
        )


def _wrong(key: str, value: object, allowed: str) -> RecordingError:
    return RecordingError(f"manifest: {key} is {value!r}, must be {allowed}")


def _require_key(table: Mapping[str, object], key: str, kind: type[_Kind]) -> _Kind:
    value = table.get(key)
    if isinstance(value, tuple) and kind is list:
        value = list(value)
    if isinstance(value, Mapping) and kind is dict:
        value = dict(value)
    if not isinstance(value, kind):
        raise _wrong(key, value, f"a {kind.__name__}")
    return value


def _number(table: Mapping[str, object], key: str) -> float:
    value = table.get(key)
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
        raise _wrong(key, value, "a finite number")
    return float(value)


def _rate(table: Mapping[str, object], key: str) -> float:
    value = _number(table, key)
    if not 1 <= value <= 1000:
        raise _wrong(key, value, "from 1 to 1000 Hz")
    return value


def _count(table: Mapping[str, object], key: str) -> int:
    value = table.get(key)
    if isinstance(value, bool) or not isinstance(value, int) or value < 1:
        raise _wrong(key, value, "a whole number from 1")
    return value


def _uuid(manifest: Mapping[str, object]) -> str:
    value = _require_key(manifest, "uuid", str)
    try:
        parsed = uuid.UUID(value)
    except ValueError:
        raise _wrong("uuid", value, "a UUID") from None
    if value not in (str(parsed), parsed.hex):
        raise _wrong("uuid", value, f"a UUID in lower case, as {parsed}")
    return value


def _camera(key: str, size: object) -> tuple[int, int]:
    if not key or key.startswith(".") or "/" in key or "\0" in key:
        raise _wrong("cameras", key, "keys that can name a file: not empty, no slash, no leading dot")
    if not isinstance(size, Mapping):
        raise _wrong(f"cameras.{key}", size, "a table with width and height")
    height, width = _count(size, "height"), _count(size, "width")
    if height % 2 or width % 2:
        raise _wrong(f"cameras.{key}", f"{width}x{height}", "even in width and height (yuv420p)")
    return height, width


def _captured(size: Mapping[str, object]) -> tuple[int, int]:
    """Return height and width of a camera's pictures; if the manifest does not name them, those of its video."""
    names = ("captured_height", "captured_width") if "captured_height" in size else ("height", "width")
    return _count(size, names[0]), _count(size, names[1])


def simulated_bench(manifest: Mapping[str, Any]) -> str:
    """Return the simulated bench that the episode's deployment declares, whose pictures are rendered; "" if none."""
    configuration = manifest.get("configuration")
    transport = configuration.get("transport") if isinstance(configuration, Mapping) else None
    if not isinstance(transport, Mapping) or transport.get("simulated") is not True:
        return ""
    return str(
        transport.get("bench", DEFAULT_BENCH)
    )  # recordings from before there were several do not name it
