"""ROS 2 messages of exported episodes: their definitions as text (`ros2msg`), and their encoding as plain CDR.

Sources of the encoding: OMG DDS-RTPS 2.5, section 10 (header of four bytes, alignment counted from its end), and the
message definitions of rosidl. Numbers are copied bit by bit: no float passes through another width.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

SECOND = 1_000_000_000  # [ns]

# Fields of each message by its name without "msg/". Those of other packages are the fields that these have in ROS 2.
DEFINITIONS: Mapping[str, str] = {
    "builtin_interfaces/Time": """
int32 sec
uint32 nanosec
""",
    "builtin_interfaces/Duration": """
int32 sec
uint32 nanosec
""",
    "std_msgs/Header": """
builtin_interfaces/Time stamp
string frame_id
""",
    "std_msgs/String": """
string data
""",
    "std_msgs/Bool": """
bool data
""",
    "sensor_msgs/JointState": """
std_msgs/Header header
string[] name
float64[] position
float64[] velocity
float64[] effort
""",
    "sensor_msgs/CompressedImage": """
std_msgs/Header header
string format
uint8[] data
""",
    "foxglove_msgs/CompressedVideo": """
builtin_interfaces/Time timestamp
string frame_id
uint8[] data
string format
""",
    "trajectory_msgs/JointTrajectoryPoint": """
float64[] positions
float64[] velocities
float64[] accelerations
float64[] effort
builtin_interfaces/Duration time_from_start
""",
    "trajectory_msgs/JointTrajectory": """
std_msgs/Header header
string[] joint_names
trajectory_msgs/JointTrajectoryPoint[] points
""",
    # Columns of the tables of an episode, with the same names. `row` counts the rows of the table, and `absent` names
    # the columns that are null in this row.
    "evaweb_msgs/Row": """
std_msgs/Header header
uint64 row
int64 index
int64 step
float64 time
float64 tick_time
int64 sequence
float32[] qpos
float32[] action
float32[] qvel
float32[] effort
float32[] eef
float32[] eef_action
bool eef_measured
bool eef_action_reported
string control_source
bool intervention
string[] capture_streams
float64[] capture_times
bool skewed
string[] cameras
bool[] repeated
bool[] lost
bool[] stale
string bench
string[] absent
""",
    "evaweb_msgs/ExecutedTick": """
std_msgs/Header header
uint64 row
int64 step
float64 planned
float64 sent
int64 sequence
string control_source
float32[] qpos
float32[] executed
string[] changes
bool refused
int64 chunk_id
float64 woke
string[] absent
""",
    "evaweb_msgs/SmoothedAction": """
std_msgs/Header header
uint64 row
int64 step
float32[] smoothed
int64[] chunk_ids
float64[] weights
string[] absent
""",
    "evaweb_msgs/RawAction": """
std_msgs/Header header
uint64 row
int64 chunk_id
int64 observation_step
int64 arrival_step
int64 index
int64 target_step
float32[] action
string space
int64 delay
int64 mistimed
float64 inference_ms
string strategy
int64 overlap
float32[] ik_position_error
float32[] ik_rotation_error
uint8[] ik_flags
string eef_source
string[] absent
""",
    "evaweb_msgs/Event": """
std_msgs/Header header
string kind
string text
string id
string arguments
string data
int64 step
float64 time
""",
    "evaweb_msgs/Label": """
std_msgs/Header header
float64 time
string by
string result
string note
bool discarded
""",
}

_SIZES = {"bool": 1, "uint8": 1, "int32": 4, "uint32": 4, "int64": 8, "uint64": 8, "float32": 4, "float64": 8}
_CODES = {"bool": "?", "uint8": "B", "int32": "i", "uint32": "I", "int64": "q", "uint64": "Q"} | {
    "float32": "f",
    "float64": "d",
}
_ARRAYS = _CODES | {"int32": "i4", "uint32": "u4", "int64": "i8", "uint64": "u8"}
_HEADER = b"\x00\x01\x00\x00"  # plain CDR, little-endian


class _Field(NamedTuple):
    """Field of a message: its type without brackets, and whether it is a sequence of that type."""

    name: str
    kind: str
    is_sequence: bool


def _fields(definition: str) -> tuple[_Field, ...]:
    parts = [line.split() for line in definition.split("\n") if line]
    return tuple(_Field(name, kind.removesuffix("[]"), kind.endswith("[]")) for kind, name in parts)


_FIELDS: Mapping[str, tuple[_Field, ...]] = {name: _fields(text) for name, text in DEFINITIONS.items()}


def schema_name(kind: str) -> str:
    """Return the name of a schema in a file: "sensor_msgs/msg/JointState" for "sensor_msgs/JointState"."""
    package, name = kind.split("/")
    return f"{package}/msg/{name}"


def schema_text(kind: str) -> str:
    """Return the definition of a message followed by those of all messages that it contains, as `ros2msg` has them."""
    needed = [kind]
    for name in needed:  # grows while it is walked
        needed += [part.kind for part in _FIELDS[name] if part.kind in _FIELDS and part.kind not in needed]
    texts = [DEFINITIONS[kind].lstrip()]
    texts += [f"MSG: {name}\n{DEFINITIONS[name].lstrip()}" for name in needed[1:]]
    return f"{'=' * 80}\n".join(texts)


def to_time(stamp: int) -> dict[str, int]:
    """Return builtin_interfaces/Time, or a Duration, of `stamp` [ns]."""
    seconds, nanoseconds = divmod(stamp, SECOND)
    return {"sec": seconds, "nanosec": nanoseconds}


def to_header(stamp: int, frame: str = "") -> dict[str, Any]:
    """Return std_msgs/Header with a stamp [ns]."""
    return {"stamp": to_time(stamp), "frame_id": frame}


def encode(kind: str, values: Mapping[str, Any]) -> bytes:
    """Encode a message, given the values of all its fields by name.

    Sequences of numbers are arrays or lists, messages are mappings. Raises KeyError for a field without a value,
    struct.error for a number out of range, and UnicodeEncodeError for a text that is not Unicode.
    """
    out = bytearray(_HEADER)
    _write(out, kind, values)
    return bytes(out)


def _write(out: bytearray, kind: str, values: Mapping[str, Any]) -> None:
    for part in _FIELDS[kind]:
        value = values[part.name]
        if not part.is_sequence:
            _write_item(out, part.kind, value)
        elif part.kind in _SIZES:
            _write_numbers(out, part.kind, value)
        else:
            _write_number(out, "uint32", len(value))
            for item in value:
                _write_item(out, part.kind, item)


def _write_item(out: bytearray, kind: str, value: Any) -> None:
    if kind in _SIZES:
        _write_number(out, kind, value)
    elif kind == "string":
        _write_text(out, value)
    else:
        _write(out, kind, value)


def _pad(out: bytearray, size: int) -> None:
    out += bytes(-(len(out) - len(_HEADER)) % size)


def _write_number(out: bytearray, kind: str, value: Any) -> None:
    _pad(out, _SIZES[kind])
    out += struct.pack(f"<{_CODES[kind]}", value)


def _write_text(out: bytearray, text: str) -> None:
    raw = text.encode() + b"\0"
    _write_number(out, "uint32", len(raw))
    out += raw


def _write_numbers(out: bytearray, kind: str, values: Any) -> None:
    """Write a sequence of numbers; an empty one is not aligned."""
    _write_number(out, "uint32", len(values))
    if not len(values):
        return
    _pad(out, _SIZES[kind])
    if isinstance(values, bytes):
        out += values
    else:
        out += np.asarray(values, dtype=f"<{_ARRAYS[kind]}").tobytes()


_NOT_IN_NAMES = re.compile(r"[^A-Za-z0-9_]+")


def topic_part(name: str) -> str:
    """Return `name` as one part of a topic's name: letters, digits and underscores, not beginning with a digit."""
    part = _NOT_IN_NAMES.sub("_", name).strip("_") or "unnamed"
    return f"_{part}" if part[0].isdigit() else part
