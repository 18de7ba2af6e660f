"""Stand-in for an XPolicyLab policy server: envelopes with ids, trials, actions as a map of keys for each step."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

import msgpack  # type: ignore[import-untyped]
import numpy as np
from websockets.sync.server import ServerConnection

from runtime.core.errors import SetupError
from runtime.core.pose_format import CANONICAL
from runtime.core.types import EEF_WIDTH, Float32, Float64, UInt8
from runtime.simulation.bench.bench import camera_arm
from runtime.simulation.scripts.script import Answer, Script, WavingScript
from runtime.standins import gr00t_wire as wire
from runtime.standins.faults import NONE, Fault
from runtime.standins.websocket_server import Answering, Frames, WebsocketServer

if TYPE_CHECKING:
    from robots import Robot

_REPLIES = {
    "hello": "hello_ack",
    "prepare_case": "prepare_case_ack",
    "reset": "reset_result",
    "infer": "infer_result",
    "trial_end": "trial_end_ack",
    "heartbeat": "heartbeat_ack",
}
_ECHOED = ("message_id", "evaluation_id", "action_case_id", "trial_id", "repeat_index", "step")
_REQUIRED = ("message_type", "message_id", "evaluation_id")
_POSE = 7  # numbers of a pose


@dataclass(frozen=True, slots=True)
class XpolicylabBehaviour:
    """Behaviour of the server; `views` is the robot's camera for each slot of a picture, None for the usual ones.

    `single` is the name of the joints of a single arm, `arm_joint_state` or `joint_state`.
    """

    horizon: int = 16
    rate: float = 30.0
    latency: float = 0.0
    fault: Fault = NONE
    seed: int = 0
    views: Mapping[str, str] | None = None
    single: str = "arm_joint_state"


class XpolicylabServer(WebsocketServer):
    """Stand-in for an XPolicyLab server, which listens on loopback.

    The server plays `script`; without a script it plays a gesture. A script in poses must write them as the protocol
    does. `calls` is a log of (message type, trial), `seen` of the observations, for tests.

    Raises:
        SetupError: If the robot has not one or two arms, or the poses of the script have another format.
    """

    speaks_first = False

    def __init__(
        self, robot: Robot, lab: XpolicylabBehaviour, port: int = 0, script: Script | None = None
    ) -> None:
        super().__init__("xpolicylab", lab.fault, port)
        self.calls: list[tuple[str, str | None]] = []
        self.seen: list[dict[str, Any]] = []
        self._lab = lab
        self._robot = robot
        self._script = script or WavingScript(robot, lab.horizon, lab.rate, lab.seed)
        self._prefixes = _prefixes(robot)
        self._views = _usual_views(robot) if lab.views is None else dict(lab.views)
        self._in_poses = self._script.metadata.get("action_space") == "eef"
        pose = self._script.metadata.get("action_pose")
        if self._in_poses and pose != CANONICAL.model_dump() | {"frame": _frame(pose)}:
            raise SetupError(
                f"--pose: {pose}; allowed for xpolicylab: x, y, z, qw, qx, qy, qz and the gripper, as without --pose, "
                "in any frame"
            )

    def greeting(self) -> Frames | None:
        """Return nothing, because the client speaks first."""
        return None

    def begin(self) -> Answering:
        """Return the function that answers the requests of a new connection."""
        answer = self._script.begin()
        return lambda request: self._reply(answer, request)

    def failed(self, connection: ServerConnection, error: Exception, request: Frames) -> bool:
        """Report the error in an envelope; the connection stays."""
        message = _envelope(request)
        if message is not None:
            connection.send(wire.packed(_error(message, "internal", str(error)), modern=True))
        return True

    def _answer(self, connection: ServerConnection, answer: Answering, request: Frames) -> bool:
        message = _envelope(request)
        if message is not None and message["message_type"] == "close":
            self.calls.append(("close", message.get("trial_id")))
            return False
        return super()._answer(connection, answer, request)

    def _reply(self, answer: Answer, request: Frames) -> Frames | None:
        message, fault = _envelope(request), self._lab.fault.name
        if message is None:
            return None  # as the original, which only logs it
        kind = message["message_type"]
        self.calls.append((kind, message.get("trial_id")))
        if fault == "mute_on_connect":
            return None
        if kind != "infer":
            ok = {"ok": True} | ({"server": "stand-in"} if kind == "hello" else {})
            return wire.packed(_enveloped(message, _REPLIES[kind], ok), modern=True)
        if fault == "malformed":
            return b"\x93\xc1"
        if fault == "refused":
            failed = _error(message, "infer_failed", "CUDA out of memory (on purpose)")
            return wire.packed(failed, modern=True)
        if "observation" not in message["payload"]:
            missing = _error(message, "invalid_frame", "infer payload missing observation")
            return wire.packed(missing, modern=True)
        started = time.monotonic()
        try:
            rows = self._inferred(answer, message["payload"]["observation"])
        except (KeyError, TypeError, ValueError, IndexError) as error:
            return wire.packed(
                _error(message, "infer_failed", f"{type(error).__name__}: {error}"), modern=True
            )
        time.sleep(max(0.0, self._lab.latency - (time.monotonic() - started)))
        result = {"actions": self._actions(rows), "latency_ms": 1e3 * (time.monotonic() - started)}
        reply = _enveloped(message, _REPLIES[kind], result)
        if fault == "request_id":
            reply["message_id"] = f"{reply['message_id']}-other"
        return wire.packed(reply, modern=True, foreign=fault == "bad_array_dialect")

    def _inferred(self, answer: Answer, observation: dict[str, Any]) -> Float32:
        self.seen.append(observation)
        if observation["data_format_version"] != "v1.0":
            raise ValueError(f"data_format_version {observation['data_format_version']!r}; expected 'v1.0'")
        return answer(
            self._joints(observation["state"]),
            self._pictures(observation["vision"]),
            observation["instruction"],
        )

    def _joints(self, state: dict[str, Any]) -> Float64:
        q = np.zeros(self._robot.dim)
        for key, dims in self._keys(self._lab.single).items():
            if np.shape(state[key]) != (len(dims),):
                raise ValueError(f"{key} is {np.shape(state[key])}, expected ({len(dims)},)")
            q[dims] = state[key]
        return q

    def _pictures(self, vision: dict[str, Any]) -> dict[str, UInt8]:
        unknown = [slot for slot in vision if slot not in self._views]
        if unknown:
            raise KeyError(f"vision/{unknown[0]}; there are {', '.join(self._views)}")
        for slot, view in vision.items():
            color = view["color"]
            if color.dtype != np.uint8 or color.ndim != 3 or color.shape[-1] != 3:
                raise ValueError(
                    f"vision/{slot}/color is {color.dtype} {color.shape}, expected uint8 [H, W, 3]"
                )
        return {self._views[slot]: view["color"] for slot, view in vision.items()}

    def _keys(self, single: str) -> dict[str, list[int]]:
        """Return the keys of the joints and grippers, with their indices in the robot's vector."""
        keys: dict[str, list[int]] = {}
        for prefix, arm in zip(self._prefixes, self._robot.arms, strict=True):
            keys[f"{prefix}arm_joint_state" if prefix else single] = arm.joint_dims.tolist()
            if arm.gripper_dim is not None:
                keys[f"{prefix}ee_joint_state"] = [arm.gripper_dim]
        return keys

    def _pose_keys(self) -> dict[str, list[int]]:
        keys: dict[str, list[int]] = {}
        for place, (prefix, arm) in enumerate(zip(self._prefixes, self._robot.arms, strict=True)):
            start = EEF_WIDTH * place
            keys[f"{prefix}ee_pose"] = list(range(start, start + _POSE))
            if arm.gripper is not None:
                keys[f"{prefix}ee_joint_state"] = [start + _POSE]
        return keys

    def _actions(self, rows: Float32) -> Any:
        """Return the rows as a list of steps, modified by the fault."""
        fault = self._lab.fault.name
        if fault == "nan":
            rows[min(3, len(rows) - 1), 2] = np.nan
        keys = self._pose_keys() if self._in_poses else self._keys(self._lab.single)
        steps: list[Any] = [{key: row[dims] for key, dims in keys.items()} for row in rows]
        first = next(iter(keys))
        for step in steps:
            if fault == "missing_key":
                del step[first]
            elif fault == "wrong_dim":
                step[first] = step[first][:-1]
            elif fault == "object_array":
                step[first] = wire.Pickled()
            elif fault == "unknown_key":
                step["gripper"] = step[first][:1]
            elif fault == "delta_key":
                step[f"{self._prefixes[0]}delta_ee_pose"] = np.zeros(_POSE, np.float32)
        forms: dict[str, Any] = {"empty": [], "two_batches": [steps, steps]}
        return forms.get(fault, steps)


def _frame(pose: object) -> object:
    return pose.get("frame") if isinstance(pose, Mapping) else None


def _prefixes(robot: Robot) -> list[str]:
    """Return the prefixes of the keys of the robot's arms, in their order.

    Two are left and right unless their names say that the first is right.
    """
    names = [arm.name for arm in robot.arms]
    if not 1 <= len(names) <= 2:
        raise SetupError(f"{robot.name} has {len(names)} arms; allowed for xpolicylab: one or two")
    if len(names) == 1:
        return [""]
    reverse = names[0].startswith("right") or names[1].startswith("left")
    return ["right_", "left_"] if reverse else ["left_", "right_"]


def _usual_views(robot: Robot) -> dict[str, str]:
    """Return the robot's camera for each slot: the cameras above in order, and those at the wrists."""
    above = [camera.key for camera in robot.cameras if camera_arm(robot, camera) is None]
    views = dict(zip(("cam_head", "cam_third_view"), above, strict=False))
    prefixes = _prefixes(robot)
    for camera in robot.cameras:
        arm = camera_arm(robot, camera)
        if arm is not None:
            views.setdefault(f"cam_{prefixes[robot.arms.index(arm)]}wrist", camera.key)
    return views


def _envelope(request: Frames) -> dict[str, Any] | None:
    """Return the envelope of a frame; None for what the original ignores or only logs."""
    if isinstance(request, str):
        return None
    try:
        message = wire.unpacked(request, npy=False)
    except (ValueError, TypeError, KeyError, msgpack.exceptions.UnpackException):
        return None
    if not isinstance(message, dict) or any(not isinstance(message.get(key), str) for key in _REQUIRED):
        return None
    known = message["message_type"] in (*_REPLIES, "close") and isinstance(message.get("payload"), dict)
    return message if known else None


def _enveloped(message: Mapping[str, Any], kind: str, payload: dict[str, Any]) -> dict[str, Any]:
    echoed = {key: message.get(key) for key in _ECHOED}
    return {"message_type": kind, **echoed, "sent_at": datetime.now(UTC).isoformat(), "payload": payload}


def _error(message: Mapping[str, Any], code: str, text: str) -> dict[str, Any]:
    return _enveloped(message, "error", {"code": code, "message": text, "details": {}})
