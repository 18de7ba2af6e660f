"""Requirements of a RoboArena server, parsed from its first frame."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal, get_args

from runtime.core.errors import ActionSpaceError, PolicyError, WrongProtocolError

ActionSpace = Literal["joint_position", "joint_velocity", "cartesian_position", "cartesian_velocity"]
SPACES: tuple[ActionSpace, ...] = get_args(ActionSpace)
_FIELDS = (
    "image_resolution",
    "needs_wrist_camera",
    "n_external_cameras",
    "needs_stereo_camera",
    "needs_session_id",
    "action_space",
)
_PIXELS = range(1, 4097)


@dataclass(frozen=True, slots=True)
class ServerRequirements:
    """Requirements of the server; `resolution` is (height, width), None if pictures are not resized.

    `horizon` (rows per response), `width` (values per row) and `parts` (names of the parts of a row) are extras of
    vLLM-Omni.
    """

    resolution: tuple[int, int] | None
    wrist: bool
    externals: int
    stereo: bool
    session: bool
    space: ActionSpace
    horizon: int | None = None
    width: int | None = None
    parts: tuple[str, ...] = ()


def parse_requirements(metadata: Mapping[str, Any]) -> ServerRequirements:
    """Parse the metadata, with the defaults of the original clients.

    Raises PolicyError, whose message names the wrong key.
    """
    if not any(name in metadata for name in _FIELDS):
        keys = ", ".join(map(str, metadata)) or "nothing"
        raise WrongProtocolError(
            f"the server's metadata have none of {', '.join(_FIELDS)}, but {keys}: it is no server of the "
            'RoboArena family; correct policy.kind (a plain openpi server: "openpi") or policy.url'
        )
    parts = metadata.get("action_keys")
    return ServerRequirements(
        resolution=_resolution(metadata.get("image_resolution", [224, 224])),
        wrist=_flag(metadata, "needs_wrist_camera", True),
        externals=_externals(metadata.get("n_external_cameras", 1)),
        stereo=_flag(metadata, "needs_stereo_camera", False),
        session=_flag(metadata, "needs_session_id", False),
        space=_space(metadata.get("action_space", "joint_position")),
        horizon=_positive(metadata, "action_horizon"),
        width=_positive(metadata, "action_dim"),
        parts=tuple(map(str, parts)) if isinstance(parts, list) else (),
    )


def _resolution(value: Any) -> tuple[int, int] | None:
    if value is None:
        return None
    if isinstance(value, list) and len(value) == 2 and all(type(n) is int and n in _PIXELS for n in value):
        return value[0], value[1]
    raise _wrong("image_resolution", value, "[height, width] from 1 to 4096 each, or nil")


def _externals(value: Any) -> int:
    if type(value) is int and 0 <= value <= 2:
        return value
    raise _wrong("n_external_cameras", value, "0, 1 or 2")


def _flag(metadata: Mapping[str, Any], name: str, default: bool) -> bool:
    value = metadata.get(name, default)
    if isinstance(value, bool):
        return value
    raise _wrong(name, value, "true or false")


def _space(value: Any) -> ActionSpace:
    for space in SPACES:
        if value == space:
            return space
    raise ActionSpaceError(_unknown("action_space", value, ", ".join(SPACES)))


def _positive(metadata: Mapping[str, Any], name: str) -> int | None:
    value = metadata.get(name)
    if value is None or (type(value) is int and value > 0):
        return value
    raise _wrong(name, value, "a whole number above 0")


def _wrong(name: str, value: Any, allowed: str) -> PolicyError:
    return WrongProtocolError(_unknown(name, value, allowed))


def _unknown(name: str, value: Any, allowed: str) -> str:
    return f"the server's metadata have {name} = {value!r}; allowed: {allowed}"
