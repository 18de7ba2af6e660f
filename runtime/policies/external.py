"""Policy that is another program: it sends single rows at its own rate to the station's robot server.

Each request passes the observation on to the robot server (`runtime.clients.robot_server`), over its Unix socket, and
returns the newest row that the program has sent, repeated. Until its first row the robot stays at its command.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
import zmq
from pydantic import Field

from runtime.core import msgpack_arrays
from runtime.core.clock import Clock
from runtime.core.errors import CodecError, PolicyError, PolicyLostError
from runtime.core.host_references import HostReference
from runtime.core.sentences import Pattern
from runtime.core.settings import Settings
from runtime.core.types import ActionChunk, Conditioning, Float64, Observation
from runtime.policies.base import Policy, PolicyInfo

if TYPE_CHECKING:
    from robots import Robot

_NO_ANSWER = Pattern(
    "external.no_answer", "{program}: its robot server has not answered for {seconds:g} s; start it again"
)
_UNREADABLE = Pattern("external.unreadable", "{program}: the answer of its robot server: {why}")
_ROW = Pattern("external.row", "{program}: a row of {given}; expected {dim} finite numbers")

_ROWS = 15  # per answer: a late request leaves the robot at the newest row, and does not starve it
_NEAR = 0.1  # [rad]: a joint whose reading is this near to its command stays at the command
_ANSWER_LIMIT = 64 * 1024  # [bytes]


class Config(Settings):
    """Another program that drives the station through its robot server, which selects this kind itself."""

    kind: Literal["external"] = "external"
    socket_file: Annotated[str, HostReference.FILE] = Field(pattern=r"^/.+")
    """Path of the robot server's Unix socket."""
    client: str = Field(default="another program", min_length=1, max_length=100)
    """Name of the program, for manifests and messages."""
    driver: Literal["policy", "person"] = "policy"
    """Whether a policy or a person drives the robot through the program; episodes of a person are demonstrations."""
    answer_s: float = Field(default=1.0, gt=0, le=10)
    """Longest time until the robot server answers [s]; it answers without waiting for the program."""


def build(config: Config, robot: Robot, clock: Clock, control_rate: float) -> ExternalPolicy:
    """Create the policy, not yet connected."""
    return ExternalPolicy(config, robot)


class ExternalPolicy(Policy):
    """Connection to a robot server, which has the newest row of the program."""

    def __init__(self, config: Config, robot: Robot) -> None:
        self._config = config
        self.is_person = config.driver == "person"
        self._robot = robot
        self._socket: zmq.Socket[bytes] | None = None
        self._are_pictures_wanted = True
        self._sent: dict[str, float] = {}  # capture time of the newest picture that was passed on, by camera

    def connect(self) -> PolicyInfo:
        """Return the program's name, after the robot server has answered. Raises PolicyLostError if it does not."""
        self.close()
        self._request({"do": "hello"})
        return PolicyInfo(self._config.client, action_space="joint", horizon=_ROWS)

    def infer(self, observation: Observation, conditioning: Conditioning | None = None) -> ActionChunk:
        """Pass the observation on and return the newest row, repeated. Raises: PolicyError."""
        answer = self._request({"do": "infer", **self._message(observation)})
        self._are_pictures_wanted = bool(answer.get("pictures"))
        row = answer.get("row")
        if row is None:
            row = self._standstill(observation)
        elif not isinstance(row, np.ndarray) or row.shape != (self._robot.dim,) or row.dtype.kind != "f":
            raise PolicyError(self._row_problem(row))
        elif not np.isfinite(row).all():
            raise PolicyError(_ROW(program=self._config.client, given=f"{row.tolist()}", dim=self._robot.dim))
        return ActionChunk(np.tile(np.asarray(row, np.float32), (_ROWS, 1)))

    def reset(self) -> None:
        """Forget the row of an earlier episode. Raises: PolicyError."""
        self._sent = {}  # what was passed on before is forgotten there too
        self._request({"do": "reset"})

    def close(self) -> None:
        """Close the socket."""
        if self._socket is not None:
            self._socket.close()
        self._socket, self._sent, self._are_pictures_wanted = None, {}, True

    def _message(self, observation: Observation) -> dict[str, Any]:
        """Return an observation for the robot server; of the cameras only pictures that it does not have yet."""
        new = (
            {
                key: picture
                for key, picture in observation.pictures.items()
                if observation.captured[key] != self._sent.get(key)
            }
            if self._are_pictures_wanted
            else {}
        )
        self._sent |= {key: observation.captured[key] for key in new}
        return {
            "step": observation.step,
            "captured": dict(observation.captured),
            "joints": observation.qpos,
            "commanded": observation.commanded,
            "pictures": {key: np.ascontiguousarray(picture) for key, picture in new.items()},
            "environment_state": observation.environment_state,
            "task": observation.prompt,
        }

    def _standstill(self, observation: Observation) -> Float64:
        """Return the row at which the robot stays: its command, for arms only if the reading is near to it."""
        measured = observation.qpos.astype(np.float64)
        if observation.commanded is None:
            return measured
        stays = np.abs(observation.commanded - measured) <= _NEAR
        stays[list(self._robot.gripper_dims)] = True  # closed on an object they read wider than commanded
        return np.where(stays, observation.commanded, measured)

    def _request(self, message: dict[str, Any]) -> dict[str, Any]:
        config = self._config
        if self._socket is None:
            self._socket = zmq.Context.instance().socket(zmq.REQ)
            self._socket.setsockopt(zmq.LINGER, 0)
            self._socket.setsockopt(zmq.MAXMSGSIZE, _ANSWER_LIMIT)
            self._socket.connect(f"ipc://{config.socket_file}")
        self._socket.send(msgpack_arrays.pack(message))
        if not self._socket.poll(round(1000 * config.answer_s)):
            self.close()  # an answer that comes later belongs to no other request
            raise PolicyLostError(_NO_ANSWER(program=config.client, seconds=config.answer_s))
        try:
            answer = msgpack_arrays.unpack(self._socket.recv(), _ANSWER_LIMIT)
        except CodecError as error:
            raise PolicyError(_UNREADABLE(program=config.client, why=str(error))) from error
        if not isinstance(answer, dict) or "error" in answer:
            why = answer["error"] if isinstance(answer, dict) else type(answer).__name__
            raise PolicyError(_UNREADABLE(program=config.client, why=f"{why}"))
        return answer

    def _row_problem(self, row: object) -> str:
        given = f"{list(row.shape)}" if isinstance(row, np.ndarray) else type(row).__name__
        return _ROW(program=self._config.client, given=given, dim=self._robot.dim)
