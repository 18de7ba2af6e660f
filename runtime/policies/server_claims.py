"""Comparison of a policy server's metadata with the deployment; if they differ, that is an error."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from runtime.core.errors import ActionSpaceError, ContradictionError
from runtime.core.pose_format import PoseFormat
from runtime.core.types import ActionMode, RelativeFrame, Space
from runtime.policies.request_layout import RequestSettings

_SPACES: dict[str, Space] = {"joint": "joint", "qpos": "joint", "eef": "eef"}
_MODES = ("absolute", "relative", "delta")
_QUATERNIONS = ("wxyz", "xyzw")  # a name that leaves their order open contradicts neither
_ORIENTATIONS: dict[str, tuple[str, ...]] = {  # other names of the orientations of PoseFormat
    "quat": _QUATERNIONS,
    "quaternion": _QUATERNIONS,
    "quat_wxyz": ("wxyz",),
    "quat_xyzw": ("xyzw",),
    "rpy": ("euler",),
    "axis_angle": ("rotation_vector",),
    "rotvec": ("rotation_vector",),
    "rot6d": ("6d",),
    "rotation_6d": ("6d",),
}
_OF_ACTIONS = (
    "action_space",
    "action_mode",
    "action_dim",
    "relative_frame",
    "action_orientation",
    "orientation",
)
_SIZES = ("image_size", "image_resolution", "training_obs_image_size")
_COMPARED = frozenset(
    {*_OF_ACTIONS, *_SIZES, "action_rate", "observation_orientation", "action_pose", "observation_pose"}
)


@dataclass(frozen=True, slots=True)
class DeclaredPolicy:
    """Statements of the deployment about a policy: its requests and the rows of its responses (`rate` in Hz)."""

    request: RequestSettings
    space: Space
    mode: ActionMode
    frame: RelativeFrame
    pose: PoseFormat
    width: int
    rate: float


def check_server_claims(said: Mapping[str, Any], declared: DeclaredPolicy, where: str) -> Space | None:
    """Check the server's statements; return the action space that they name, or None.

    `where` names their origin in errors (metadata or an answer). Compared keys: action_mode and action_space,
    action_dim, action_rate, relative_frame, action_orientation (or orientation), observation_orientation, action_pose
    and observation_pose (maps with the keys of a pose format), and image_size (image_resolution,
    training_obs_image_size).

    Raises:
        ActionSpaceError: The server and the deployment differ about the actions; the message has both values.
        ContradictionError: They differ about something else.
    """
    if _COMPARED.isdisjoint(said):  # the case of most responses
        return None
    space = _space(said, declared, where)
    for key, given, key_here, here in _pairs(said, declared):
        if given != here:
            raise _contradiction(where, key, given, f"policy.{key_here}", here)
    return space


def _pairs(said: Mapping[str, Any], declared: DeclaredPolicy) -> Iterator[tuple[str, Any, str, Any]]:
    """Yield (server's key, its value, deployment's key, its value) for each compared key that the server states."""
    if said.get("action_dim") is not None:
        what = "joints" if declared.space == "joint" else f"poses ({declared.pose})"
        yield "action_dim", said["action_dim"], f"action_space: {what} of this robot, numbers", declared.width
    if said.get("action_rate") is not None:
        yield "action_rate", said["action_rate"], "action_rate", declared.rate
    if said.get("relative_frame") is not None and declared.mode != "absolute":
        yield "relative_frame", said["relative_frame"], "relative_frame", declared.frame
    request = declared.request
    for side, pose, space in (
        ("action", declared.pose, declared.space),
        ("observation", request.observation_pose, request.observation_space),
    ):
        if space == "eef":
            yield from _pose_pairs(said, side, pose)
    if request.image_size is not None and request.resize != "none":
        for key in _SIZES:
            if said.get(key) is not None:
                yield key, _size(said[key]), "image_size", list(request.image_size)


def _pose_pairs(said: Mapping[str, Any], side: str, pose: PoseFormat) -> Iterator[tuple[str, Any, str, Any]]:
    words = [f"{side}_orientation", *(["orientation"] if side == "action" else [])]
    for key in words:
        if said.get(key) is not None:
            here = f"{side}_pose.orientation"
            yield key, _orientation(said[key], pose.orientation), here, pose.orientation
    given = said.get(f"{side}_pose")
    if isinstance(given, Mapping):
        for key, value in pose.model_dump().items():
            if key in given:
                theirs = _orientation(given[key], value) if key == "orientation" else given[key]
                yield f"{side}_pose.{key}", theirs, f"{side}_pose.{key}", value


def _orientation(said: object, here: str) -> object:
    """Return our name for an orientation that the server names `said`; `here` if it is among the possible names."""
    meant = _ORIENTATIONS.get(str(said).lower(), (said,))
    return here if here in meant else meant[0]


def _space(said: Mapping[str, Any], declared: DeclaredPolicy, where: str) -> Space | None:
    """Return the space that the server names by action_space, or by action_mode, which some servers use for it."""
    found: Space | None = None
    for key, words in (("action_space", [*_SPACES]), ("action_mode", [*_SPACES, *_MODES])):
        given = said.get(key)
        if given is None:
            continue
        if not isinstance(given, str) or given not in words:
            raise ActionSpaceError(f"the server's {where} has {key} {given!r}; allowed: {', '.join(words)}")
        if given in _MODES:
            if given != declared.mode:
                raise _contradiction(where, key, given, "policy.action_mode", declared.mode)
            continue
        found = _SPACES[given]
        if found != declared.space:
            raise ActionSpaceError(
                f"the server's {where} says that actions are {found!r}, policy.action_space is "
                f"{declared.space!r}; correct the one that is wrong"
            )
    return found


def _size(given: Any) -> Any:
    """Return [height, width] from one number (a square), two numbers, or three numbers with the channels."""
    if isinstance(given, int | np.integer):
        return [int(given), int(given)]
    if isinstance(given, list | tuple | np.ndarray) and len(given) in (2, 3):
        numbers = np.asarray(given).tolist()
        return numbers[1:] if len(numbers) == 3 and numbers[0] == 3 else numbers[:2]
    return given


def _contradiction(where: str, key: str, given: Any, key_here: str, here: Any) -> ContradictionError:
    kind = ActionSpaceError if key in _OF_ACTIONS or key.startswith("action_pose") else ContradictionError
    return kind(
        f"the server's {where} has {key} = {given!r}, {key_here} = {here!r}; correct the one that is wrong"
    )
