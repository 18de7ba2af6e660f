"""Stand-in for an openpi policy server: the real protocol, a script as policy, faults on demand."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from runtime.core.types import UInt8
from runtime.simulation.scripts.script import Answer, Script, WavingScript
from runtime.standins.arrays import packed, unpacked
from runtime.standins.continuing import ModelSpace, continue_prefix
from runtime.standins.faults import NONE, Fault
from runtime.standins.rtc_wires import WIRES, Name, ParsedRequest
from runtime.standins.websocket_server import (
    Answering,
    Frames,
    WebsocketServer,
    apply_fault,
)

if TYPE_CHECKING:
    from robots import Robot


@dataclass(frozen=True, slots=True)
class Behaviour:
    """Behaviour of the server: rows per chunk, their rate [Hz], duration of an inference [s], fault.

    `rtc` is the format in which requests contain committed rows; "prev_action" accepts plain requests, too.
    """

    horizon: int = 50
    rate: float = 30.0
    latency: float = 0.0
    fault: Fault = NONE
    seed: int = 0
    rtc: Name = "prev_action"


class OpenpiServer(WebsocketServer):
    """Server on loopback in threads of its own; plays `script`, or a gesture by default."""

    says_well = True

    def __init__(
        self, robot: Robot, behaviour: Behaviour, port: int = 0, script: Script | None = None
    ) -> None:
        super().__init__("openpi", behaviour.fault, port)
        self._robot = robot
        self._behaviour = behaviour
        self._script = script or WavingScript(robot, behaviour.horizon, behaviour.rate, behaviour.seed)
        self._space = ModelSpace(robot)
        self._wire = WIRES[behaviour.rtc](self._space, behaviour.horizon, behaviour.fault)

    def greeting(self) -> Frames | None:
        """Return the metadata, which are the first frame of a connection."""
        metadata = dict(self._script.metadata) | self._wire.metadata()
        if self._behaviour.fault.name == "action_mode":
            metadata["action_mode"] = self._behaviour.fault.argument
        return packed(metadata)

    def begin(self) -> Answering:
        """Return the object that answers the requests of a new connection."""
        return _Conversation(self, self._script.begin())

    def on_answered(self, answer: Answering, seconds: float) -> None:
        """Store how long the answer took; the next answer on the same connection reports it."""
        assert isinstance(answer, _Conversation)
        answer.previous_ms = 1e3 * seconds

    def failure(self, traceback: str, request: Frames) -> Frames:
        """Return the frame that reports an error: the traceback as text.

        If the server uses the RTC format with envelopes, it is an envelope with the traceback and the request's number.
        """
        try:
            message = unpacked(request) if isinstance(request, bytes) else None
        except ValueError:
            message = None
        return self._wire.failure(traceback, message)

    def reply(self, request: Frames, answer: Answer, previous_ms: float | None) -> bytes:
        """Return the frame that answers a request. Raises an exception if the request cannot be answered."""
        if isinstance(request, str):
            raise TypeError("the request is a text frame; expected a binary one")
        parsed = self._wire.read(unpacked(request))
        return self._wire.answer(self._result(answer, parsed, previous_ms), parsed)

    def _result(self, answer: Answer, request: ParsedRequest, previous_ms: float | None) -> dict[str, object]:
        started = time.monotonic()
        observation = request.observation
        state, pictures = self._state(observation), self._pictures(observation)
        actions = answer(state, pictures, str(observation.get("prompt", "")))
        if request.prefix is not None:
            actions = continue_prefix(actions, request.prefix, self._robot.binary_dims)
        took = 1e3 * self._took(started)
        timing = {"infer_ms": took} | ({} if previous_ms is None else {"prev_total_ms": previous_ms})
        own = {"origin_actions": self._space.encode(actions)} if self._behaviour.rtc != "none" else {}
        return {
            "actions": apply_fault(self._behaviour.fault, actions),
            **own,
            "policy_timing": {"infer_ms": took},
            "server_timing": timing,
        }

    def _took(self, started: float) -> float:
        """Return the duration [s] of an answer that was begun at `started` [s].

        This waits until the configured latency has passed since `started`.
        """
        time.sleep(max(0.0, self._behaviour.latency - (time.monotonic() - started)))
        return time.monotonic() - started

    def _state(self, observation: Any) -> np.ndarray[Any, Any]:
        state = np.asarray(observation["state"], dtype=np.float64)
        if state.shape != (self._robot.dim,):
            raise ValueError(f"state has shape {state.shape}, expected ({self._robot.dim},)")
        return state

    def _pictures(self, observation: Any) -> dict[str, UInt8]:
        pictures: dict[str, UInt8] = observation.get("images", {})
        for key, picture in pictures.items():
            if picture.dtype != np.uint8 or picture.ndim != 3:
                raise ValueError(
                    f"images[{key!r}] is {picture.dtype} {picture.shape}, expected uint8, 3 axes"
                )
        return pictures


@dataclass(slots=True)
class _Conversation:
    """Function that answers the requests of one connection; `previous_ms` is the duration of its previous answer."""

    server: OpenpiServer
    answer: Answer
    previous_ms: float | None = None

    def __call__(self, request: Frames) -> Frames:
        return self.server.reply(request, self.answer, self.previous_ms)
