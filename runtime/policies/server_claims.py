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
    """Properties of a policy as the deployment declares them.

    They are the settings of its requests, and the format of the rows in its responses. `rate` is the rate of these rows
    [Hz].
    """

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
    for key, claimed, key_here, own in _pairs(said, declared):
        if claimed != own:
            raise _contradiction(where, key, claimed, f"policy.{key_here}", own)
    return space


def _pairs(claims: Mapping[str, Any], declared: DeclaredPolicy) -> Iterator[tuple[str, Any, str, Any]]:
    """Yield (server's key, its value, deployment's key, its value) for each compared key that the server states."""
    if claims.get("action_dim") is not None:
        label = "joints" if declared.space == "joint" else f"poses ({declared.pose})"
        yield (
            "action_dim",
            claims["action_dim"],
            f"action_space: {label} of this robot, numbers",
            declared.width,
        )
    if claims.get("action_rate") is not None:
        yield "action_rate", claims["action_rate"], "action_rate", declared.rate
    if claims.get("relative_frame") is not None and declared.mode != "absolute":
        yield "relative_frame", claims["relative_frame"], "relative_frame", declared.frame
    request = declared.request
    for side, pose, space in (
        ("action", declared.pose, declared.space),
        ("observation", request.observation_pose, request.observation_space),
    ):
        if space == "eef":
            yield from _pose_pairs(claims, side, pose)
    if request.image_size is not None and request.resize != "none":
        for key in _SIZES:
            if claims.get(key) is not None:
                yield key, _size(claims[key]), "image_size", list(request.image_size)


def _pose_pairs(
    claims: Mapping[str, Any], side: str, pose: PoseFormat
) -> Iterator[tuple[str, Any, str, Any]]:
    keys = [f"{side}_orientation", *(["orientation"] if side == "action" else [])]
    for key in keys:
        if claims.get(key) is not None:
            own_key = f"{side}_pose.orientation"
            yield key, _orientation(claims[key], pose.orientation), own_key, pose.orientation
    claimed = claims.get(f"{side}_pose")
    if isinstance(claimed, Mapping):
        for key, value in pose.model_dump().items():
            if key in claimed:
                claimed_value = _orientation(claimed[key], value) if key == "orientation" else claimed[key]
                yield f"{side}_pose.{key}", claimed_value, f"{side}_pose.{key}", value


def _orientation(claimed: object, own: str) -> object:
    """Return our name for the orientation that the server calls `claimed`.

    The server's name may stand for several of our orientations. If one of them is `own`, the orientation in the
    deployment, `own` is returned; otherwise the first of them.
    """
    candidates = _ORIENTATIONS.get(str(claimed).lower(), (claimed,))
    return own if own in candidates else candidates[0]


def _space(claims: Mapping[str, Any], declared: DeclaredPolicy, where: str) -> Space | None:
    """Return the action space that the server states in its metadata or answer; None if it states none.

    The space is stated by the key action_space. Some servers state it by action_mode instead.
    """
    space: Space | None = None
    for key, allowed in (("action_space", [*_SPACES]), ("action_mode", [*_SPACES, *_MODES])):
        claimed = claims.get(key)
        if claimed is None:
            continue
        if not isinstance(claimed, str) or claimed not in allowed:
            raise ActionSpaceError(
                f"the server's {where} has {key} {claimed!r}; allowed: {', '.join(allowed)}"
            )
        if claimed in _MODES:
            if claimed != declared.mode:
                raise _contradiction(where, key, claimed, "policy.action_mode", declared.mode)
            continue
        space = _SPACES[claimed]
        if space != declared.space:
            raise ActionSpaceError(
                f"the server's {where} says that actions are {space!r}, policy.action_space is "
                f"{declared.space!r}; correct the one that is wrong"
            )
    return space


def _size(value: Any) -> Any:
    """Return [height, width] from one number (a square), two numbers, or three numbers with the channels."""
    if isinstance(value, int | np.integer):
        return [int(value), int(value)]
    if isinstance(value, list | tuple | np.ndarray) and len(value) in (2, 3):
        numbers = np.asarray(value).tolist()
        return numbers[1:] if len(numbers) == 3 and numbers[0] == 3 else numbers[:2]
    return value


def _contradiction(where: str, key: str, claimed: Any, key_here: str, own: Any) -> ContradictionError:
    kind = ActionSpaceError if key in _OF_ACTIONS or key.startswith("action_pose") else ContradictionError
    return kind(
        f"the server's {where} has {key} = {claimed!r}, {key_here} = {own!r}; correct the one that is wrong"
    )
