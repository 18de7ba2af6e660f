"""A stand-in for an openpi policy server: the real wire, a script for a policy, faults on demand."""

from __future__ import annotations

import contextlib
import http
import os
import socket
import threading
import time
import traceback
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from websockets.exceptions import ConnectionClosed
from websockets.frames import Frame, Opcode
from websockets.sync.server import Server, ServerConnection, serve

from runtime import codecs
from runtime.errors import SetupError
from runtime.sim.continuing import ModelSpace, continued
from runtime.sim.faults import NONE, Fault
from runtime.sim.rtc_wires import WIRES, Asked, Name
from runtime.sim.script import Answer, Script, Waving
from runtime.types import UInt8

if TYPE_CHECKING:
    from websockets.http11 import Request, Response

    from robots import Robot

_LATE = 3.0  # s


@dataclass(frozen=True, slots=True)
class Behaviour:
    """How the server answers: rows per chunk, their rate [Hz], time of an inference [s], what goes wrong.

    `rtc` is the dialect in which it is told what the robot is committed to; the flat one takes plain requests too.
    """

    horizon: int = 50
    rate: float = 30.0
    latency: float = 0.0
    fault: Fault = NONE
    seed: int = 0
    rtc: Name = "prev_action"


class OpenpiServer:
    """Serves on loopback in threads of its own; plays `script`, a gesture where none is given."""

    def __init__(
        self, robot: Robot, behaviour: Behaviour, port: int = 0, script: Script | None = None
    ) -> None:
        self._robot = robot
        self._behaviour = behaviour
        self._port = port
        self._script = script or Waving(robot, behaviour.horizon, behaviour.rate, behaviour.seed)
        self._space = ModelSpace(robot)
        self._wire = WIRES[behaviour.rtc](self._space, behaviour.horizon, behaviour.fault)
        self._device = threading.Lock()  # one inference at a time, as on one GPU
        self._asked = 0
        self._server: Server | None = None
        self._thread: threading.Thread | None = None

    def start(self) -> dict[str, object]:
        """Listen, and return the address."""
        try:
            self._server = serve(
                self._converse,
                "127.0.0.1",
                self._port,
                process_request=self._admit,
                compression=None,
                max_size=None,
                ping_interval=None,
                close_timeout=1.0,
            )
        except OSError as error:
            raise SetupError(f"cannot listen at 127.0.0.1:{self._port}: {error}") from error
        self._port = self._server.socket.getsockname()[1]
        self._thread = threading.Thread(target=self._server.serve_forever, name="openpi", daemon=True)
        self._thread.start()
        return {"url": f"ws://127.0.0.1:{self._port}", "port": self._port}

    def close(self) -> None:
        """Stop listening; safe to call twice."""
        if self._server is not None and self._thread is not None:
            self._server.shutdown()
            self._thread.join()
        self._server = self._thread = None

    def _admit(self, connection: ServerConnection, request: Request) -> Response | None:
        if request.path == "/healthz":
            return connection.respond(http.HTTPStatus.OK, "OK\n")
        if self._behaviour.fault.name == "http_404":
            return connection.respond(http.HTTPStatus.NOT_FOUND, "there is no policy here\n")
        return None

    def _converse(self, connection: ServerConnection) -> None:
        """One client: metadata, then an answer for each request, until it leaves."""
        fault = self._behaviour.fault.name
        with contextlib.suppress(ConnectionClosed):
            if fault == "text_first":
                connection.send("the checkpoint could not be loaded")
            elif fault != "mute_on_connect":
                connection.send(codecs.pack(self._metadata()))
            answer, previous = self._script.begin(), None
            while True:
                request = connection.recv()
                started = time.monotonic()
                if not self._answer(connection, answer, request, previous):
                    return
                previous = 1e3 * (time.monotonic() - started)

    def _metadata(self) -> dict[str, object]:
        metadata = dict(self._script.metadata) | self._wire.metadata()
        if self._behaviour.fault.name == "action_mode":
            metadata["action_mode"] = self._behaviour.fault.argument
        return metadata

    def _answer(
        self, connection: ServerConnection, answer: Answer, request: str | bytes, previous: float | None
    ) -> bool:
        """Answer one request, rightly or as the fault has it; False where the conversation is over."""
        with self._device:
            number, self._asked = self._asked, self._asked + 1
            message: Any = None
            try:
                if isinstance(request, str):
                    raise TypeError("the request is a text frame; expected a binary one")
                message = codecs.unpack(request)
                if self._behaviour.fault.name == "exception":
                    raise RuntimeError("CUDA out of memory (on purpose)")
                asked = self._wire.read(message)
                reply = self._wire.answer(self._result(answer, asked, previous), asked)
            except Exception:  # whatever goes wrong in a policy is told to the client, as openpi does it
                connection.send(self._wire.failure(traceback.format_exc(), message))
                connection.close(1011, "Internal server error. Traceback included in previous frame.")
                return False
        return self._send(connection, reply, number)

    def _send(self, connection: ServerConnection, payload: bytes, number: int) -> bool:
        fault = self._behaviour.fault
        due = number >= fault.number(0)
        if fault.name == "die" and due:
            os._exit(1)
        if fault.name == "mute_on_infer" and due:
            return True
        if fault.name == "close_mid_reply" and due:
            _send_half(connection, payload)
            return False
        if fault.name == "late_reply" and number == 1:
            time.sleep(fault.number(_LATE))
        connection.send(payload)
        return True

    def _result(self, answer: Answer, asked: Asked, previous: float | None) -> dict[str, object]:
        started = time.monotonic()
        observation = asked.observation
        state, pictures = self._state(observation), self._pictures(observation)
        actions = answer(state, pictures, str(observation.get("prompt", "")))
        if asked.prefix is not None:
            actions = continued(actions, asked.prefix, self._robot.binary_dims)
        time.sleep(max(0.0, self._behaviour.latency - (time.monotonic() - started)))
        took = 1e3 * (time.monotonic() - started)
        timing = {"infer_ms": took} | ({} if previous is None else {"prev_total_ms": previous})
        own = {"origin_actions": self._space.of(actions)} if self._behaviour.rtc != "none" else {}
        return {
            "actions": self._spoilt(actions),
            **own,
            "policy_timing": {"infer_ms": took},
            "server_timing": timing,
        }

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

    def _spoilt(self, actions: np.ndarray[Any, Any]) -> object:
        """The actions, or what the fault makes of them."""
        name = self._behaviour.fault.name
        if name == "nan":
            actions[min(3, len(actions) - 1), 2] = np.nan
        shapes = {
            "wrong_dim": actions[:, :-1],
            "empty": actions[:0],
            "batched": actions[None],
            "two_batches": np.stack([actions, actions]),
            "single_row": actions[0],
        }
        if name == "bad_array_dialect":
            return _foreign(actions)
        if name == "object_array":
            return {b"__ndarray__": True, b"data": b"\x80\x04N.", b"dtype": "|O", b"shape": [1]}
        return shapes.get(name, actions)


def _foreign(array: np.ndarray[Any, Any]) -> dict[bytes, object]:
    """An array as the package msgpack_numpy writes it."""
    return {
        b"nd": True,
        b"type": array.dtype.str,
        b"kind": b"",
        b"shape": list(array.shape),
        b"data": array.tobytes(),
    }


def _send_half(connection: ServerConnection, payload: bytes) -> None:
    """Half a frame, then the end of the TCP connection: what a killed server leaves."""
    raw = Frame(Opcode.BINARY, payload).serialize(mask=False)
    connection.socket.sendall(raw[: len(raw) // 2])
    connection.socket.shutdown(socket.SHUT_RDWR)
