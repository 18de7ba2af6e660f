"""Stand-in for a policy server of the RoboArena family: RoboArena and DreamZero, or vLLM-Omni."""

from __future__ import annotations

import json
import time
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from websockets.sync.server import ServerConnection

from runtime.simulation.scripts.script import Answer, Script, WavingScript
from runtime.standins.arrays import packed, unpacked
from runtime.standins.droid_robot import DroidRobot
from runtime.standins.faults import NONE, Fault
from runtime.standins.websocket_server import (
    Answering,
    Frames,
    WebsocketServer,
    apply_fault,
)

if TYPE_CHECKING:
    from robots import Robot

VLLM_PATH = "/v1/realtime/robot/openpi"
_IDLE = 30.0  # [s] default of vLLM-Omni


@dataclass(frozen=True, slots=True)
class RoboarenaBehaviour:
    """Behaviour of the server: its requirements, its answers, its fault.

    `reply` is the form of an answer: a map with `actions`, the bare array, or named parts. `numbering` is the number of
    the first exterior view. `idle` [s] is the time without requests after which a connection is closed; None: never, or
    30 s for vllm.
    """

    horizon: int = 24
    rate: float = 30.0
    latency: float = 0.0
    fault: Fault = NONE
    seed: int = 0
    variant: Literal["roboarena", "vllm"] = "roboarena"
    reply: Literal["dict", "bare", "parts"] = "dict"
    resolution: tuple[int, int] | None = (224, 224)
    externals: int = 1
    wrist: bool = True
    stereo: bool = False
    session: bool = True
    space: str = "joint_position"
    numbering: int = 0
    idle: float | None = None


@dataclass
class RequestLog:
    """Requests that the server has received: (endpoint, session) in order, and the number of frames by session."""

    calls: list[tuple[str, str | None]] = field(default_factory=list)
    frames: dict[str | None, int] = field(default_factory=dict)


class RoboarenaServer(WebsocketServer):
    """Stand-in for a RoboArena server, which listens on loopback.

    The server plays `script`; without a script it plays a gesture. `heard` is a log of the requests, for tests.
    """

    def __init__(
        self, robot: Robot, arena: RoboarenaBehaviour, port: int = 0, script: Script | None = None
    ) -> None:
        idle = arena.idle or (_IDLE if arena.variant == "vllm" else None)
        super().__init__("roboarena", arena.fault, port, idle)
        self.heard = RequestLog()
        self._arena = arena
        self._robot = DroidRobot(robot, arena.space, arena.numbering)
        self._script = script or WavingScript(robot, arena.horizon, arena.rate, arena.seed)

    def start(self) -> dict[str, object]:
        """Listen; return the address, with a path for vLLM-Omni."""
        address = super().start()
        path = VLLM_PATH if self._arena.variant == "vllm" else ""
        return address | {"url": f"{address['url']}{path}"}

    def serves_path(self, path: str) -> bool:
        """Return True if a policy is served at the URL path `path`.

        The variant RoboArena serves the policy at every path, the variant vLLM-Omni only at VLLM_PATH.
        """
        return self._arena.variant == "roboarena" or path == VLLM_PATH

    def greeting(self) -> Frames | None:
        """Return the metadata with their six fields; None with the fault "not_loaded"."""
        arena = self._arena
        if arena.fault.name == "not_loaded":
            return None
        space = arena.fault.argument if arena.fault.name == "action_mode" else arena.space
        return packed(
            {
                "image_resolution": arena.resolution,
                "needs_wrist_camera": arena.wrist,
                "n_external_cameras": arena.externals,
                "needs_stereo_camera": arena.stereo,
                "needs_session_id": arena.session,
                "action_space": space,
            }
        )

    def refusal(self) -> Frames:
        """Return the error that a server sends if its model is not for robots."""
        return json.dumps({"type": "error", "error": "Robot policy not available", "code": "unsupported"})

    def begin(self) -> Answering:
        """Return the function that answers the requests of a new connection."""
        answer = self._script.begin()
        return lambda request: self._reply(answer, request)

    def failed(self, connection: ServerConnection, error: Exception, request: Frames) -> bool:
        """Send the error to the client; return False if the connection is closed afterwards.

        A server of vLLM-Omni sends a short binary message and keeps the connection open; this stand-in does the same in
        that variant.
        """
        if self._arena.variant == "roboarena":
            return super().failed(connection, error, request)
        message = "Invalid request payload" if isinstance(error, ValueError) else "Internal inference error"
        connection.send(packed({"type": "error", "message": message}))
        return True

    def _reply(self, answer: Answer, request: str | bytes) -> Frames:
        if isinstance(request, str):
            raise TypeError("a bytes-like object is required, not 'str'")
        message = unpacked(request)
        if not isinstance(message, dict):
            raise ValueError("the request is no map")
        vllm = self._arena.variant == "vllm"
        endpoint = message.get("endpoint", "infer") if vllm else message["endpoint"]
        session = message.get("session_id")
        self.heard.calls.append((endpoint, session))
        if endpoint == "reset":
            self.heard.frames.pop(session, None)
            text = "done" if self._arena.fault.name == "reset_text" else "reset successful"
            return packed({"status": text}) if vllm else text
        return packed(self._formed(self._inferred(answer, message, session)))

    def _inferred(self, answer: Answer, message: dict[str, Any], session: str | None) -> Any:
        started = time.monotonic()
        self._check(message)
        views = [value for key, value in message.items() if "image" in key]
        self.heard.frames[session] = self.heard.frames.get(session, 0) + max(
            (1 if view.ndim == 3 else len(view) for view in views), default=0
        )
        q = self._robot.joints(message)
        rows = self._robot.rows(answer(q, self._robot.pictures(message), message["prompt"]), q)
        time.sleep(max(0.0, self._arena.latency - (time.monotonic() - started)))
        return apply_fault(self._arena.fault, rows)

    def _formed(self, rows: Any) -> object:
        if self._arena.reply == "bare":
            return rows
        if self._arena.reply == "parts" and isinstance(rows, np.ndarray):
            return {"arm": rows[..., :-1], "gripper": rows[..., -1:]}
        return {"actions": rows}

    def _check(self, message: dict[str, Any]) -> None:
        """Raise an exception for mistakes in a request, including those that a real policy would not notice."""
        arena = self._arena
        names = [f"exterior_image_{arena.numbering + n}" for n in range(arena.externals)]
        names += ["wrist_image"] if arena.wrist else []
        sides = ("left", "right") if arena.stereo else ("left",)
        expected = {f"observation/{name}_{side}" for name in names for side in sides}
        pictures = {key for key in message if "image" in key}
        if pictures != expected:
            raise KeyError(f"pictures {sorted(pictures)}; wanted {sorted(expected)}")
        for key in pictures:
            picture = message[key]
            if picture.dtype != np.uint8 or picture.ndim not in (3, 4) or picture.shape[-1] != 3:
                raise TypeError(f"{key} is {picture.dtype} {picture.shape}; expected uint8 [H, W, 3]")
            if arena.resolution is not None and picture.shape[-3:-1] != tuple(arena.resolution):
                raise TypeError(f"{key} is {picture.shape}; expected {arena.resolution}")
        if arena.session and not isinstance(message.get("session_id"), str):
            raise KeyError("session_id")
        if len(message["observation/cartesian_position"]) % 6:
            raise TypeError("cartesian_position has no six numbers per arm")
