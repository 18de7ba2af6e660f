"""Stand-in for a GR00T policy server: the protocol of three versions, a script as policy, faults on demand."""

from __future__ import annotations

import hmac
import json
import os
import threading
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import zmq

from runtime.core.errors import SetupError
from runtime.core.types import Float32, Float64, UInt8
from runtime.simulation.scripts.script import Answer, Script, WavingScript
from runtime.standins import gr00t_wire as wire
from runtime.standins.faults import NONE, TOO_LARGE, Fault

if TYPE_CHECKING:
    from robots import Robot

Version = Literal["n1.5", "n1.6", "n1.7", "n1.7-early", "starvla"]

_LATE = 3.0  # [s] default delay of the fault "late_reply"
_SPELL_MS = 20  # between two checks for the end
_REBIND = 5.0  # [s] limit for binding the port again
LANGUAGE = "annotation.human.task_description"


@dataclass(frozen=True, slots=True)
class Gr00tBehaviour:
    """Behaviour of the server: rows per chunk, their rate [Hz], duration of an inference [s], fault.

    `flat` is the option --use-sim-policy-wrapper of N1.6 and N1.7. `seen` are the time steps of the images that a
    request must have. "n1.7-early" is the early access of N1.7, which reads arrays of msgpack_numpy only; "starvla" is
    StarVLA's server of this protocol, which has no modality configurations.
    """

    version: Version = "n1.6"
    flat: bool = False
    horizon: int = 50
    rate: float = 30.0
    latency: float = 0.0
    fault: Fault = NONE
    seed: int = 0
    token: str = ""
    seen: tuple[int, ...] = (0,)


class Gr00tServer:
    """Server on loopback in a thread of its own; plays `script`, or a gesture by default.

    The model's video keys are the robot's cameras; its state and action keys are the robot's groups, or the single
    action "poses" if the script answers in poses.
    """

    def __init__(
        self, robot: Robot, behaviour: Gr00tBehaviour, port: int = 0, script: Script | None = None
    ) -> None:
        self._robot = robot
        self._behaviour = behaviour
        self._port = port
        self._script = script or WavingScript(robot, behaviour.horizon, behaviour.rate, behaviour.seed)
        self._in_poses = self._script.metadata.get("action_space") == "eef"
        self._answer: Answer | None = None
        self._asked = 0
        self._ended = threading.Event()
        self._thread: threading.Thread | None = None
        self.requests: list[dict[str, Any]] = []  # the last hundred, newest last
        self.failures: list[str] = []

    def start(self) -> dict[str, object]:
        """Listen; return the address.

        Raises:
            SetupError: If the port is in use.
        """
        self._wire = self._bound()
        self._thread = threading.Thread(target=self._serve, name="gr00t", daemon=True)
        self._thread.start()
        return {"url": f"tcp://127.0.0.1:{self._port}", "port": self._port}

    def close(self) -> None:
        """Stop listening; safe to call twice."""
        self._ended.set()
        if self._thread is not None:
            self._thread.join()
        self._thread = None

    def _bound(self, patience: float = 0.0) -> zmq.Socket[bytes]:
        bound: zmq.Socket[bytes] = zmq.Context.instance().socket(zmq.REP)
        bound.setsockopt(zmq.LINGER, 0)
        deadline = time.monotonic() + patience
        while True:
            try:
                bound.bind(f"tcp://127.0.0.1:{self._port or '*'}")
                break
            except zmq.ZMQError as error:
                if time.monotonic() > deadline:
                    bound.close(linger=0)
                    raise SetupError(f"cannot listen at 127.0.0.1:{self._port}: {error}") from error
                time.sleep(_SPELL_MS / 1e3)
        address = bound.getsockopt(zmq.LAST_ENDPOINT)
        assert isinstance(address, bytes)
        self._port = int(address.rstrip(b"\0").rpartition(b":")[2])
        return bound

    def _serve(self) -> None:
        while not self._ended.is_set():
            if not self._wire.poll(_SPELL_MS):
                continue
            frames = self._replies(self._wire.recv())
            if frames is None:  # a REP socket must answer before it can receive again: replace it
                self._wire.close(linger=0)
                self._wire = self._bound(_REBIND)  # ZMQ releases the port asynchronously
            else:
                self._wire.send_multipart(frames)
        self._wire.close(linger=0)

    def _replies(self, payload: bytes) -> Sequence[bytes] | None:
        """Return the frames that answer a request; None if the connection has to end without an answer."""
        fault = self._behaviour.fault
        try:
            message = wire.unpacked(payload, self._behaviour.version != "n1.7-early", self._modern)
            endpoint, reply = str(message.get("endpoint", "get_action")), self._result(message)
        except Exception as error:  # errors are sent to the client, as by GR00T
            self.failures.append(str(error))
            endpoint, reply = "error", {"error": str(error)}
        if endpoint == "get_modality_config" and fault.name == "mute_on_connect":
            self._ended.wait()
            return None
        if endpoint == "get_action":
            spoilt = self._spoilt_frames()
            if spoilt is not _RIGHT:
                return spoilt
        return [wire.packed(reply, self._modern, fault.name == "bad_array_dialect")]

    @property
    def _modern(self) -> bool:
        """Whether the server accepts arrays as msgpack_numpy encodes them; it then also answers with such arrays."""
        return self._behaviour.version.startswith("n1.7")

    def _spoilt_frames(self) -> Sequence[bytes] | None:
        """Return the frames that the fault sends in place of the right answer; None if the fault sends nothing.

        If the fault does not affect this answer, return `_RIGHT`: the right answer is then sent.
        """
        fault, number = self._behaviour.fault, self._asked
        self._asked += 1
        due = number >= fault.number(0)
        if fault.name == "die" and due:
            os._exit(1)
        if fault.name == "mute_on_infer" and due:
            self._ended.wait()
            return None
        if fault.name == "close_mid_reply" and due:
            return None
        if fault.name == "late_reply" and number == 1:
            self._ended.wait(fault.number(_LATE))
        if fault.name == "too_large":
            return [bytes(TOO_LARGE)]
        frames = {"error_bytes": [b"ERROR"], "malformed": [b"\x93\xc1"], "two_frames": [b"\x80", b"\x80"]}
        return frames.get(fault.name, _RIGHT)

    def _result(self, message: Mapping[str, Any]) -> object:
        behaviour = self._behaviour
        if behaviour.token and not hmac.compare_digest(str(message.get("api_token", "")), behaviour.token):
            return {"error": "Unauthorized: Invalid API token"}
        endpoint = message.get("endpoint", "get_action")
        endpoints = {"ping", "get_action", "get_modality_config"} | (
            {"reset"} if behaviour.version != "n1.5" else set()
        )
        if endpoint not in endpoints or behaviour.fault.name == "unknown_endpoint":
            return {"error": f"Unknown endpoint: {endpoint}"}
        if endpoint == "ping":
            return {"status": "ok", "message": "Server is running"}
        if endpoint == "get_modality_config":
            return self._contract() if behaviour.version == "starvla" else self._modalities()
        if endpoint == "reset":
            self._answer = None
            return {"ok": True} if behaviour.version == "starvla" else {}
        self.requests = [*self.requests[-99:], dict(message)]
        return self._action(message["data"])

    def _contract(self) -> dict[str, object]:
        """Return the reply of a StarVLA server: state and action keys with prefix and width, without images."""
        groups: dict[str, object] = {group.name: len(group.joints) for group in self._robot.groups}
        actions = {"poses": self._script.metadata["action_dim"]} if self._in_poses else groups
        contract: dict[str, object] = {"unnorm_key": "stand_in"}
        for name, widths in (("state", groups), ("action", actions)):
            prefixed = {f"{name}.{key}": width for key, width in widths.items()}
            contract |= {f"{name}_keys": list(prefixed), f"{name}_key_dims": prefixed}
        return contract

    def _modalities(self) -> dict[str, object]:
        cameras = [camera.key for camera in self._robot.cameras]
        groups = [group.name for group in self._robot.groups]
        actions = ["poses"] if self._in_poses else groups
        prefixed = self._behaviour.version == "n1.5"
        return {
            name: self._modality([f"{name}.{key}" if prefixed and own else key for key in keys], steps)
            for name, keys, steps, own in (
                ("video", cameras, self._behaviour.seen, True),
                ("state", groups, (0,), True),
                ("action", actions, range(self._behaviour.horizon), True),
                ("language", [LANGUAGE], (0,), False),
            )
        }

    def _modality(self, keys: list[str], steps: Any) -> dict[str, object]:
        fields: dict[str, object] = {"delta_indices": list(steps), "modality_keys": keys}
        if self._behaviour.version == "n1.5":
            return {"__ModalityConfig_class__": True, "as_json": json.dumps(fields)}
        mark = "__ModalityConfig_class__" if self._behaviour.version == "n1.6" else "__ModalityConfig__"
        more = dict.fromkeys(("sin_cos_embedding_keys", "mean_std_embedding_keys", "action_configs"))
        return {mark: True, "as_json": fields | more}

    def _action(self, data: Mapping[str, Any]) -> object:
        started = time.monotonic()
        behaviour = self._behaviour
        if behaviour.fault.name == "exception":
            raise RuntimeError("CUDA out of memory (on purpose)")
        pictures, joints, prompt = self._read(data)
        self._answer = self._answer or self._script.begin()
        rows = self._answer(joints, pictures, prompt)
        self._ended.wait(max(0.0, behaviour.latency - (time.monotonic() - started)))
        parts = self._parts(rows)
        if behaviour.version == "n1.5":
            return {f"action.{key}": part for key, part in parts.items()}
        batched = {key: self._batched(part) for key, part in parts.items()}
        named = {f"action.{key}": part for key, part in batched.items()} if behaviour.flat else batched
        return [named, {}]

    def _read(self, data: Mapping[str, Any]) -> tuple[dict[str, UInt8], Float64, str]:
        """Return images, joints [D] and instruction of a request, checked as strictly as in GR00T's server.

        Raises:
            AssertionError: If a part is missing, or has another type or shape.
        """
        early, flat = (
            self._behaviour.version == "n1.5",
            self._behaviour.flat or self._behaviour.version == "n1.5",
        )
        observation = data if early else data["observation"]
        if not flat:
            for name in ("video", "state", "language"):
                assert name in observation, f"Observation must contain a '{name}' key"
        lead = () if early else (1,)
        pictures = {}
        for camera in self._robot.cameras:
            value = _value(observation, "video", camera.key, flat)
            _require(value, "Video", camera.key, np.uint8, (*lead, len(self._behaviour.seen)), 3)
            pictures[camera.key] = value.reshape(-1, *value.shape[-3:])[-1]
        joints = np.empty(self._robot.dim)
        for group in self._robot.groups:
            value = _value(observation, "state", group.name, flat)
            _require(value, "State", group.name, np.float32, (*lead, 1), 1)
            joints[group.slice] = value.reshape(-1)
        spoken = observation[LANGUAGE] if flat else observation["language"][LANGUAGE][0]
        assert isinstance(spoken, list), f"Language must be a list. Got {type(spoken)}"
        assert all(isinstance(text, str) for text in spoken), f"Language must be text. Got {spoken}"
        return pictures, joints, str(spoken[0])

    def _parts(self, rows: Float32) -> dict[str, Any]:
        """Return the answer's rows by action key, modified by the fault."""
        fault = self._behaviour.fault.name
        if fault == "nan":
            rows[min(3, len(rows) - 1), 2] = np.nan
        parts: dict[str, Any] = (
            {"poses": rows}
            if self._in_poses
            else {group.name: rows[:, group.slice] for group in self._robot.groups}
        )
        first = next(iter(parts))
        if fault == "missing_key":
            del parts[first]
        elif fault == "wrong_dim":
            parts[first] = parts[first][:, :-1]
        elif fault == "object_array":
            parts[first] = wire.Pickled()
        elif fault == "uneven":
            parts[first] = parts[first][:-1]
        return {key: part[:0] for key, part in parts.items()} if fault == "empty" else parts

    def _batched(self, part: Any) -> Any:
        if isinstance(part, wire.Pickled):
            return part
        return np.stack([part, part]) if self._behaviour.fault.name == "two_batches" else part[None]


_RIGHT: tuple[bytes, ...] = ()


def _value(observation: Mapping[str, Any], name: str, key: str, flat: bool) -> Any:
    parts, spoken = (observation, f"{name}.{key}") if flat else (observation[name], key)
    assert spoken in parts, f"{name.capitalize()} key '{spoken}' must be in observation"
    return parts[spoken]


def _require(value: Any, name: str, key: str, dtype: Any, lead: tuple[int, ...], axes: int) -> None:
    assert isinstance(value, np.ndarray), f"{name} key '{key}' must be a numpy array. Got {type(value)}"
    assert value.dtype == dtype, f"{name} key '{key}' must be a numpy array of {dtype}. Got {value.dtype}"
    expected = (*lead, *("C" * axes))
    shaped = value.ndim == len(expected) and value.shape[: len(lead)] == lead
    assert shaped, f"{name} key '{key}' must have shape {expected}. Got {value.shape}"
