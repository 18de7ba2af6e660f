"""Stand-in for LeRobot's policy server: gRPC with the same rules and empty answers, a script as policy, faults on
demand.
"""

from __future__ import annotations

import os
import queue
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import grpc
import numpy as np

from runtime.core.errors import SetupError
from runtime.core.types import Float32
from runtime.simulation.scripts.script import Answer, Script, WavingScript
from runtime.standins import lerobot_wire as wire
from runtime.standins.faults import NONE, TOO_LARGE, Fault

if TYPE_CHECKING:
    from robots import Robot

_LATE = 3.0  # [s] default delay of the fault "late_reply"
_SIMILAR = 1.0  # [rad] distance below which an observation is skipped, unless it is marked `must_go`
_KINDS = ("act", "smolvla", "diffusion", "tdmpc", "vqbet", "pi0", "pi05", "groot")


@dataclass(frozen=True, slots=True)
class LerobotBehaviour:
    """Behaviour of the server: rows per chunk, their rate [Hz], duration of an inference [s], fault.

    `patience` [s] is the time that it waits for an observation before it sends an empty answer.
    """

    horizon: int = 50
    rate: float = 30.0
    latency: float = 0.0
    fault: Fault = NONE
    seed: int = 0
    patience: float = 2.0


class LerobotServer:
    """Server on loopback in threads of its own; plays `script`, or a gesture by default."""

    def __init__(
        self, robot: Robot, behaviour: LerobotBehaviour, port: int = 0, script: Script | None = None
    ) -> None:
        self._behaviour = behaviour
        self._robot = robot
        self._port = port
        self._script = script or WavingScript(robot, behaviour.horizon, behaviour.rate, behaviour.seed)
        self._waiting: queue.Queue[Any] = queue.Queue(maxsize=1)
        self._told: Any = None
        self._answer: Answer | None = None
        self._last: Any = None
        self._predicted: set[int] = set()
        self._asked = 0
        self._ended = threading.Event()
        self._server: Any = None
        self.failures: list[str] = []  # errors that the real server writes only to its log
        self.loads = 0

    def start(self) -> dict[str, object]:
        """Listen; return the address.

        Raises:
            SetupError: If the port is in use.
        """
        options = [("grpc.so_reuseport", 0)]
        self._workers = ThreadPoolExecutor(8, "lerobot")
        self._server = grpc.server(self._workers, options=options)
        self._server.add_generic_rpc_handlers([self._handlers()])
        try:
            self._port = self._server.add_insecure_port(f"127.0.0.1:{self._port}")
        except RuntimeError as error:
            raise SetupError(f"cannot listen at 127.0.0.1:{self._port}: {error}") from error
        self._server.start()
        return {"url": f"grpc://127.0.0.1:{self._port}", "port": self._port}

    def close(self) -> None:
        """Stop listening; safe to call twice."""
        self._ended.set()
        if self._server is not None:
            self._server.stop(0).wait()
            self._workers.shutdown(wait=False)
        self._server = None

    def _handlers(self) -> Any:
        def one(handler: Any, call: Any, takes: str, gives: str) -> Any:
            return handler(
                call,
                request_deserializer=wire.MESSAGES[takes].FromString,
                response_serializer=wire.MESSAGES[gives].SerializeToString,
            )

        plain = grpc.unary_unary_rpc_method_handler
        return grpc.method_handlers_generic_handler(
            "transport.AsyncInference",
            {
                "Ready": one(plain, self._ready, "Empty", "Empty"),
                "SendPolicyInstructions": one(plain, self._instructed, "PolicySetup", "Empty"),
                "SendObservations": one(
                    grpc.stream_unary_rpc_method_handler, self._observed, "Observation", "Empty"
                ),
                "GetActions": one(plain, self._act, "Empty", "Actions"),
            },
        )

    def _ready(self, request: Any, context: Any) -> Any:
        if self._behaviour.fault.name == "mute_on_connect":
            self._ended.wait()
        self._waiting = queue.Queue(maxsize=1)
        self._predicted = set()
        self._answer = None if self._told is None else self._script.begin()
        return wire.MESSAGES["Empty"]()

    def _instructed(self, request: Any, context: Any) -> Any:
        fault = self._behaviour.fault.name
        instructions = wire.unpickle(
            request.data, "lerobot.scripts.server.helpers" if fault == "no_name" else wire.HELPERS
        )
        if instructions.policy_type not in _KINDS:
            raise ValueError(
                f"Policy type {instructions.policy_type} not supported. Supported policies: {list(_KINDS)}"
            )
        if fault == "load_fails":
            raise FileNotFoundError(
                f"{instructions.pretrained_name_or_path} is not a folder with a config.json (on purpose)"
            )
        self._told, self._answer = instructions, self._script.begin()
        self.loads += 1
        return wire.MESSAGES["Empty"]()

    def _observed(self, messages: Iterator[Any], context: Any) -> Any:
        data = b""
        for message in messages:
            # Transfer state 1 begins an observation, the others continue it.
            data = message.data if message.transfer_state == 1 else data + message.data
        observation = wire.unpickle(data)
        if observation.must_go or self._last is None or self._is_news(observation):
            if self._waiting.full():
                self._waiting.get_nowait()
            self._waiting.put(observation)
        return wire.MESSAGES["Empty"]()

    def _is_news(self, observation: Any) -> bool:
        away = np.linalg.norm(self._state(observation) - self._state(self._last))
        return observation.timestep not in self._predicted and bool(away >= _SIMILAR)

    def _state(self, observation: Any) -> np.ndarray[Any, Any]:
        names = self._told.lerobot_features["observation.state"]["names"]
        return np.array([observation.observation[name] for name in names], np.float32)

    def _act(self, request: Any, context: Any) -> Any:
        """Return the actions for the pending observation.

        The message is empty if no observation arrives in time, and after any error.
        """
        try:
            observation = self._waiting.get(timeout=self._behaviour.patience)
            self._predicted.add(observation.timestep)
            data = self._data(observation)
        except queue.Empty:
            data = b""
        except Exception as error:  # the real server only logs it
            self.failures.append(f"{type(error).__name__}: {error}")
            data = b""
        return wire.MESSAGES["Actions"](data=data)

    def _data(self, observation: Any) -> bytes:
        number, self._asked = self._asked, self._asked + 1
        fault = self._behaviour.fault
        due = number >= fault.number(0)
        if fault.name == "die" and due:
            os._exit(1)
        if fault.name == "mute_on_infer" and due:
            self._ended.wait()
        if fault.name == "close_mid_reply" and due:
            self._server.stop(0)
            self._ended.wait()
        if fault.name == "late_reply" and number == 1:
            self._ended.wait(fault.number(_LATE))
        if fault.name == "too_large":
            return bytes(TOO_LARGE)
        if fault.name == "malformed":
            return b"\x80\x04]\x93."
        if fault.name == "foreign_name":
            return wire.command_pickle("touch unpickled")
        return self._actions(observation, self._rows(observation))

    def _rows(self, observation: Any) -> Float32:
        started = time.monotonic()
        if self._told is None or self._answer is None:
            raise RuntimeError("No policy loaded")
        if self._behaviour.fault.name == "exception":
            raise RuntimeError("CUDA out of memory (on purpose)")
        images = {
            key.removeprefix("observation.images."): feature["dtype"]
            for key, feature in self._told.lerobot_features.items()
            if key.startswith("observation.images.")
        }
        pictures = {name: observation.observation[name] for name in images}
        for name, picture in pictures.items():
            assert picture.dtype == np.uint8, f"{name} is {picture.dtype}"
            assert picture.ndim == 3, f"{name} has shape {picture.shape}"
        state = self._state(observation).astype(np.float64)
        rows = self._answer(state, pictures, str(observation.observation["task"]))
        self._last = observation
        self._ended.wait(max(0.0, self._behaviour.latency - (time.monotonic() - started)))
        return rows[: self._told.actions_per_chunk]

    def _actions(self, observation: Any, rows: Float32) -> bytes:
        """Return the pickled actions for the rows of an answer, modified by the fault."""
        fault = self._behaviour.fault.name
        if fault == "nan":
            rows[min(3, len(rows) - 1), 2] = np.nan
        rows = rows[:, :-1] if fault == "wrong_dim" else rows[:0] if fault == "empty" else rows
        first = observation.timestep + (1000 if fault == "other_step" else 0)
        apart = 1.0 / self._behaviour.rate / (2 if fault == "other_rate" else 1)
        order = range(len(rows))[:: -1 if fault == "shuffled" else 1]
        return wire.timed_actions(
            rows[::-1] if fault == "shuffled" else rows,
            [first + index for index in order],
            [observation.timestamp + index * apart for index in order],
        )
