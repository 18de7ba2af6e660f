"""Policies with the RoboArena protocol, which DreamZero, IsaacLab-Arena and vLLM-Omni use, too; arrays as in openpi.

The server's first frame states its requirements. Every request names an endpoint, infer or reset. A text frame in
response to a reset is an acknowledgement if it is exactly "reset successful"; every other text frame is an error.
Source: robo-arena's policy server and clients, and the openpi endpoint of vLLM-Omni.
"""

from __future__ import annotations

import uuid
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Literal

from runtime.core import msgpack_arrays
from runtime.core.clock import Clock
from runtime.core.errors import ContradictionError, PolicyError, ServerReportedError, WrongProtocolError
from runtime.core.types import ActionChunk, Conditioning, Observation
from runtime.policies.arena.actions import ArenaActions, ArenaActionSettings
from runtime.policies.arena.request import ArenaRequest, ArenaRequestSettings
from runtime.policies.arena.requirements import ServerRequirements, parse_requirements
from runtime.policies.base import PolicyInfo
from runtime.policies.websocket import Positive, ServerSettings, WebsocketPolicy

if TYPE_CHECKING:
    from robots import Robot

ACKNOWLEDGED = "reset successful"


class Config(ServerSettings, ArenaRequestSettings, ArenaActionSettings):
    """A policy server of the RoboArena family: RoboArena, DreamZero, or vLLM-Omni with its path in `url`."""

    kind: Literal["roboarena"] = "roboarena"
    first_inference_deadline: Positive = 600.0
    """Longest time for the first response after set-up [s]; DreamZero's first inferences take minutes."""
    inference_deadline: Positive = 10.0
    """Longest time for every later response [s]; beyond it the connection is dropped. DreamZero takes up to three
    seconds."""
    reset_deadline: Positive = 10.0
    """Longest time for the acknowledgement of a reset [s]; beyond it the connection is dropped."""


def build(config: Config, robot: Robot, clock: Clock, control_rate: float) -> RoboarenaPolicy:
    """Create the policy, not yet connected. Raises ConfigurationError if a setting does not fit the robot."""
    return RoboarenaPolicy(config, robot)


class RoboarenaPolicy(WebsocketPolicy):
    """Policy with one session per run.

    The end of the run, or `reset`, ends the session on the server; the next request begins another. A connection that
    the server closed between two requests, as vLLM-Omni does after half a minute, is opened again.
    """

    PROTOCOL = "RoboArena"

    def __init__(self, config: Config, robot: Robot) -> None:
        super().__init__(config)
        self._config = config
        self._shown = ArenaRequest(config, robot)
        self._meant = ArenaActions(config, config.gripper, robot)
        self.observation_eef = config.observation_eef
        self.uses_poses = self._shown.uses_poses or (self._meant.cartesian and self._meant.velocity)
        self._wants: ServerRequirements | None = None
        self.observe_period_s = self._shown.glances_s
        self._session = _new_session()
        self._asked = False  # in this session
        self._ending: dict[str, str] | None = (
            None  # session field of a session that must still be ended on the server
        )

    def infer(self, observation: Observation, conditioning: Conditioning | None = None) -> ActionChunk:
        """Return the chunk.

        `timing` contains only the `round_trip_ms` that we measure, because the protocol does not carry the durations of
        the server.

        Raises PolicyLostError if the server is absent or does not respond. The next call then opens another connection.
        """
        if conditioning is not None:
            raise PolicyError("the RoboArena protocol has no real-time chunking; choose another strategy")
        with self._lock:
            self._reopen()
            self._end_session()
            request = msgpack_arrays.pack(
                self._shown.build(observation) | self._session_field() | {"endpoint": "infer"}
            )
            self._asked = True
            answer, round_trip = self._exchange(request)
            reply = self._value(answer, "an answer")
        _require_no_error(reply)
        return self._meant.chunk(reply, {"round_trip_ms": round_trip})

    def observe(self, observation: Observation) -> None:
        """Store the observation's pictures for later requests."""
        self._shown.observe(observation)

    def reset(self) -> None:
        """End the session on the server and wait for the acknowledgement.

        Nothing is sent for a session without requests. If the call fails, the next `infer` tries again before its
        request, because the server may keep a history.
        """
        with self._lock:
            self._forget_session()
            if self._ending is not None:
                self._reopen()
                self._end_session()

    def end_episode(self) -> None:
        """End the session as `reset` does, but only over an open connection; otherwise the next `infer` ends it."""
        with self._lock:
            self._forget_session()
            if self._link.is_open and not self._link.closed_by_peer and not self._closed:
                self._end_session()

    def _forget_session(self) -> None:
        if self._asked:
            self._ending = self._session_field()
            self._session, self._asked = _new_session(), False
            self._shown.forget()

    def _end_session(self) -> None:
        if self._ending is None:
            return
        request = msgpack_arrays.pack(self._ending | {"endpoint": "reset"})
        answer = self._link.exchange_ack(request, self._config.reset_deadline, ACKNOWLEDGED)
        self._last = None  # after the acknowledgement no earlier answer can arrive
        if answer is not None:
            self._require_acknowledged(self._value(answer, "an acknowledgement"))
        self._ending = None

    def _session_field(self) -> dict[str, str]:
        return {"session_id": self._session} if self._wants is not None and self._wants.session else {}

    def _check_metadata(self, metadata: dict[str, Any]) -> PolicyInfo:
        wants = parse_requirements(metadata)
        own = self._config.image_size
        if own is not None and wants.resolution is not None and own != list(wants.resolution):
            raise ContradictionError(
                f"the server's metadata has image_resolution = {list(wants.resolution)}, policy.image_size = {own}; "
                "correct the one that is wrong"
            )
        self._shown.configure(wants)
        self._meant.configure(wants)
        self._wants = wants
        return PolicyInfo(
            name=str(metadata.get("name", "roboarena")),
            action_space="eef" if self._meant.cartesian else "joint",
            horizon=wants.horizon,
            rate=self._config.action_rate,
            metadata=metadata,
        )

    def _require_acknowledged(self, reply: Any) -> None:
        _require_no_error(reply)
        if not isinstance(reply, Mapping) or reply.get("status") != ACKNOWLEDGED:
            self._link.close_gracefully()  # it is not the response to the reset
            raise WrongProtocolError(
                f"{self._config.url} answered a reset with {_short(reply)}; expected the text or the status "
                f"{ACKNOWLEDGED!r}"
            )


def _require_no_error(reply: Any) -> None:
    """Raise ServerReportedError if the reply is an error, which vLLM-Omni sends as a map without disconnecting."""
    if isinstance(reply, Mapping) and reply.get("type") == "error":
        text = reply.get("message") or reply.get("error") or "nothing more"
        raise ServerReportedError(f"the policy server reports an error: {text}")


def _short(value: Any) -> str:
    text = ", ".join(map(str, value)) if isinstance(value, Mapping) else repr(value)
    kind = f"a {type(value).__name__}"
    return f"{kind} ({text[:80]})"


def _new_session() -> str:
    return str(uuid.uuid4())
