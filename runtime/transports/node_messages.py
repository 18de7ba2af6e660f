"""Messages of an execution node, checked against the robot.

An invalid message is refused. The error has the name of the fault under which such messages are counted.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal, TypeVar

import numpy as np
from pydantic import ConfigDict, JsonValue, TypeAdapter, ValidationError

from runtime.core import msgpack_arrays
from runtime.core.errors import CodecError
from runtime.core.types import EEF_WIDTH, Float32, Float64, UInt8

if TYPE_CHECKING:
    from robots import Robot

Encoding = Literal["bgr", "rgb"]
MESSAGE_LIMIT = 64 * 1024 * 1024  # [bytes]; three 1080p pictures are 19 MB
TRUTH_LIMIT = 16 * 1024  # [bytes]; it is part of snapshots, ten times a second
DRIVE_FAULTS_LIMIT = 64  # number per message
DRIVE_FAULT_LENGTH = 200  # [characters]
Part = TypeVar("Part")
_JSON: TypeAdapter[dict[str, JsonValue]] = TypeAdapter(
    dict[str, JsonValue], config=ConfigDict(strict=True, allow_inf_nan=False)
)


class MessageRefused(CodecError):
    """Message that cannot be used; `fault` is the name under which it is counted."""

    def __init__(self, fault: str, text: str) -> None:
        super().__init__(text)
        self.fault = fault


@dataclass(frozen=True, slots=True)
class NodeStatus:
    """Status that the node reports. The simulated node reports all fields, older nodes only the `hil_*` fields."""

    holding: bool | None = None  # its command deadline has passed and it holds its position
    refused: Mapping[str, int] = field(default_factory=dict)  # number of refused commands by reason
    master: str | None = None  # id of the client that it obeys
    ack: int | None = None  # sequence number of that client's newest message that it has obeyed
    hil_supported: bool = False
    hil_active: bool = False
    hil_error: str = ""


@dataclass(frozen=True, slots=True)
class NodeFrame:
    """One complete observation as sent.

    `stamp` is in the node's own clock [s], pictures are in the `encoding` of the node. `truth` is the ground truth of a
    simulated bench, as JSON. `drives` is {"enabled": bool, "faults": [str]}, or None if the node does not report it.
    `environment_state` is a benchmark's own observation vector, whose width its bench declares.
    `remarks` are (fault, text) of optional parts that were dropped as unusable.
    """

    stamp: float
    qpos: Float32
    pictures: Mapping[str, UInt8]
    encoding: Encoding
    eef: Float32 | None
    action: Float32 | None
    action_eef: Float32 | None
    sequence: int | None
    status: NodeStatus
    truth: Mapping[str, Any] | None = None
    drives: Mapping[str, Any] | None = None
    environment_state: Float64 | None = None
    remarks: tuple[tuple[str, str], ...] = ()


class NodeMessages:
    """Reader of the node's messages for one robot. Cameras in `disabled` are neither required nor delivered."""

    def __init__(self, robot: Robot, encoding: Encoding, disabled: frozenset[str], limit: int) -> None:
        self._robot = robot
        self._encoding = encoding
        self._cameras = tuple(camera.key for camera in robot.cameras if camera.key not in disabled)
        self._eef_width = EEF_WIDTH * len(robot.arms)
        self._limit = limit

    def read(self, payload: bytes | memoryview) -> NodeFrame:
        """Decode and check one message. Raises MessageRefused if a part that control needs is missing or wrong."""
        message = self._message(payload)
        remarks: list[tuple[str, str]] = []
        return NodeFrame(
            stamp=_stamp(message),
            qpos=self._qpos(message),
            pictures=self._pictures(message),
            encoding=self._encoding_of(message),
            eef=self._optional(remarks, "eef", self._eef, message.get("eef")),
            action=self._optional(remarks, "action", self._action, message.get("action")),
            action_eef=self._optional(remarks, "action_eef", self._poses, message.get("action_eef")),
            sequence=_number(message.get("seq")),
            status=_status(message),
            truth=self._optional(remarks, "truth", _truth, message.get("truth")),
            drives=self._optional(remarks, "drives", _drives, message.get("drives")),
            environment_state=self._optional(
                remarks, "environment_state", _state_vector, message.get("environment_state")
            ),
            remarks=tuple(remarks),
        )

    def _message(self, payload: bytes | memoryview) -> dict[Any, Any]:
        try:
            message = msgpack_arrays.unpack(payload, self._limit)
        except CodecError as error:
            raise MessageRefused("malformed", str(error)) from error
        if not isinstance(message, dict):
            raise MessageRefused("malformed", f"a message is a {type(message).__name__}; expected a map")
        return message

    def _qpos(self, message: Mapping[Any, Any]) -> Float32:
        state = _map(message, "state")
        missing = [group.name for group in self._robot.groups if group.name not in state]
        if missing:
            groups = ", ".join(map(str, state)) or "none"
            raise MessageRefused("missing_group", f"state lacks {', '.join(missing)}; it has {groups}")
        parts = [_vector(f"state.{g.name}", state[g.name], g.dof) for g in self._robot.groups]
        return np.concatenate(parts)

    def _pictures(self, message: Mapping[Any, Any]) -> dict[str, UInt8]:
        images = _map(message, "images")
        missing = [key for key in self._cameras if key not in images]
        if missing:
            cameras = ", ".join(map(str, images)) or "none"
            raise MessageRefused("missing_camera", f"images lack {', '.join(missing)}; they have {cameras}")
        return {key: _picture(key, images[key]) for key in self._cameras}

    def _encoding_of(self, message: Mapping[Any, Any]) -> Encoding:
        encoding = message.get("encoding", self._encoding)
        if encoding == "bgr":
            return "bgr"
        if encoding == "rgb":
            return "rgb"
        raise MessageRefused("unknown_encoding", f"encoding is {encoding!r}; allowed: 'bgr', 'rgb'")

    def _optional(
        self, remarks: list[tuple[str, str]], name: str, read: Callable[[str, object], Part], value: object
    ) -> Part | None:
        """Return the part that `read` reads from `value`; None if it is absent or unusable.

        An unusable part is added to `remarks`.
        """
        if value is None:
            return None
        try:
            return read(name, value)
        except MessageRefused as error:
            remarks.append((f"{name}_unusable", str(error)))
            return None

    def _eef(self, name: str, poses: object) -> Float32:
        if not isinstance(poses, dict):
            raise MessageRefused("malformed", f"{name} is a {type(poses).__name__}; expected a map by arm")
        missing = [arm.name for arm in self._robot.arms if arm.name not in poses]
        if missing:
            raise MessageRefused("missing_group", f"{name} lacks {', '.join(missing)}")
        parts = [_vector(f"{name}.{arm.name}", poses[arm.name], EEF_WIDTH) for arm in self._robot.arms]
        return self._poses(name, np.concatenate(parts) if parts else np.empty(0, np.float32))

    def _poses(self, name: str, poses: object) -> Float32:
        vector = _vector(name, poses, self._eef_width)
        norms = np.linalg.norm(vector.reshape(-1, EEF_WIDTH)[:, 3:7], axis=1)
        if (np.abs(norms - 1.0) > 0.05).any():  # some nodes send zeros for an unknown pose
            raise MessageRefused(
                "malformed", f"{name} has quaternions of length {norms.round(3).tolist()}; expected 1"
            )
        return vector

    def _action(self, name: str, value: object) -> Float32:
        return _vector(name, value, self._robot.dim)


def _stamp(message: Mapping[Any, Any]) -> float:
    stamp = message.get("t")
    if isinstance(stamp, bool) or not isinstance(stamp, int | float) or not math.isfinite(stamp):
        raise MessageRefused("malformed", f"t is {stamp!r}; expected seconds of the node's monotonic clock")
    return float(stamp)


def _map(message: Mapping[Any, Any], key: str) -> Mapping[Any, Any]:
    value = message.get(key)
    if not isinstance(value, dict):
        raise MessageRefused("malformed", f"{key} is a {type(value).__name__}; expected a map")
    return value


def _vector(name: str, value: object, width: int) -> Float32:
    if not isinstance(value, np.ndarray) or value.dtype.kind != "f":
        kind = value.dtype.str if isinstance(value, np.ndarray) else type(value).__name__
        raise MessageRefused("wrong_dtype", f"{name} is {kind}; expected a float32 array")
    if value.shape != (width,):
        raise MessageRefused("wrong_dimension", f"{name} has shape {list(value.shape)}; expected [{width}]")
    vector = value.astype(np.float32)
    if not np.isfinite(vector).all():
        raise MessageRefused("not_finite", f"{name} has {vector.tolist()}; expected finite numbers")
    return vector


def _state_vector(name: str, value: object) -> Float64:
    if not isinstance(value, np.ndarray) or value.dtype != np.float64 or value.ndim != 1:
        kind = (
            f"{value.dtype.str} {list(value.shape)}"
            if isinstance(value, np.ndarray)
            else type(value).__name__
        )
        raise MessageRefused("malformed", f"{name} is {kind}; expected a float64 vector")
    if not np.isfinite(value).all():
        raise MessageRefused("malformed", f"{name} has numbers that are not finite")
    return value


def _picture(key: str, value: object) -> UInt8:
    if not isinstance(value, np.ndarray) or value.dtype != np.uint8:
        kind = value.dtype.str if isinstance(value, np.ndarray) else type(value).__name__
        raise MessageRefused("wrong_dtype", f"images.{key} is {kind}; expected a uint8 array")
    if value.ndim != 3 or value.shape[2] != 3 or value.size == 0:
        raise MessageRefused(
            "wrong_dimension", f"images.{key} has shape {list(value.shape)}; expected [H, W, 3]"
        )
    return value


def _truth(name: str, value: object) -> Mapping[str, Any]:
    """Return the simulated bench's ground truth after checking it.

    It is JSON with three keys: `reset`, the id of the newest reset; `milestones`, which of them were reached since that
    reset; and `success`. Raises: MessageRefused if a key is invalid or the whole is too long.
    """
    try:
        truth: dict[str, Any] = _JSON.validate_python(value)
    except ValidationError as invalid:
        error = invalid.errors()[0]
        where = ".".join(map(str, (name, *error["loc"][:1])))
        raise MessageRefused("malformed", f"{where}: {error['msg']}") from None
    size = len(msgpack_arrays.pack(truth))
    if size > TRUTH_LIMIT:
        raise MessageRefused("malformed", f"{name} has {size} bytes; expected at most {TRUTH_LIMIT}")
    reset, milestones, success = truth.get("reset"), truth.get("milestones"), truth.get("success")
    if not isinstance(reset, str):
        raise MessageRefused("malformed", f"{name}.reset is {reset!r:.80}; expected the id of a reset or ''")
    if not isinstance(milestones, dict) or not all(
        isinstance(reached, bool) for reached in milestones.values()
    ):
        raise MessageRefused("malformed", f"{name}.milestones is {milestones!r:.80}; expected a map of bools")
    if not isinstance(success, bool):
        raise MessageRefused("malformed", f"{name}.success is {success!r:.80}; expected true or false")
    return truth


def _drives(name: str, value: object) -> Mapping[str, Any]:
    """Return the state of the drives: whether they are enabled, and their faults; other keys are dropped."""
    if not isinstance(value, dict):
        raise MessageRefused("malformed", f"{name} is a {type(value).__name__}; expected a map")
    enabled, faults = value.get("enabled"), value.get("faults", [])
    if not isinstance(enabled, bool):
        raise MessageRefused("malformed", f"{name}.enabled is {enabled!r:.80}; expected true or false")
    if not isinstance(faults, list) or not all(isinstance(fault, str) for fault in faults):
        raise MessageRefused("malformed", f"{name}.faults is {faults!r:.80}; expected a list of sentences")
    if len(faults) > DRIVE_FAULTS_LIMIT or any(len(fault) > DRIVE_FAULT_LENGTH for fault in faults):
        raise MessageRefused(
            "malformed",
            f"{name}.faults are {len(faults)} of at most {max(map(len, faults))} characters; "
            f"expected at most {DRIVE_FAULTS_LIMIT} of {DRIVE_FAULT_LENGTH}",
        )
    return {"enabled": enabled, "faults": list(faults)}


def _number(value: object) -> int | None:
    return value if type(value) is int else None


def _status(message: Mapping[Any, Any]) -> NodeStatus:
    holding, refused, master = message.get("holding"), message.get("refused"), message.get("master")
    counts = refused.items() if isinstance(refused, dict) else ()
    return NodeStatus(
        holding=holding if isinstance(holding, bool) else None,
        refused={str(reason): n for reason, n in counts if type(n) is int},
        master=master if isinstance(master, str) else None,
        ack=_number(message.get("ack")),
        hil_supported=message.get("hil_supported") is True,
        hil_active=message.get("hil_active") is True,
        hil_error=str(message.get("hil_error", "")),
    )
