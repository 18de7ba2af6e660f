"""Policies on XPolicyLab servers: some forty policies behind one websocket protocol.

A connection begins with our hello. Each run is a trial: a reset begins it on the server and a trial_end ends it. The
reply to a message repeats its id, so that a late, repeated or foreign reply is never used. Source: XPolicyLab's
websocket server, client and observation format v1.0.
"""

from __future__ import annotations

import logging
import math
import time
import uuid
from collections.abc import Mapping
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from pydantic import Field

from runtime.core.clock import Clock
from runtime.core.errors import PolicyError, PolicyLostError, WrongProtocolError
from runtime.core.sentences import Pattern
from runtime.core.types import ActionChunk, Conditioning, Observation
from runtime.policies.base import PolicyInfo
from runtime.policies.groot import arrays  # the package msgpack_numpy's form of arrays is also GR00T N1.7's
from runtime.policies.idle_pings import IdlePingPolicy
from runtime.policies.websocket import Positive, ServerSettings
from runtime.policies.websocket_link import ANSWER_LIMIT
from runtime.policies.xpolicy.envelope import Kind, Request
from runtime.policies.xpolicy.layout import Layout, LayoutSettings

if TYPE_CHECKING:
    from robots import Robot

_AN_ANSWER_TO = Pattern("policy.server.an_answer_to", "an answer to {request}")

log = logging.getLogger(__name__)


class Config(ServerSettings, LayoutSettings):
    """A policy server of XPolicyLab."""

    kind: Literal["xpolicylab"] = "xpolicylab"
    url: Annotated[str, Field(pattern=r"^wss?://.+")] = "ws://127.0.0.1:19000"
    """Address of the server: ws:// or wss://, with a path if it has one."""
    evaluation_id: Annotated[str, Field(min_length=1)] = "eva-web"
    """Name of the evaluation in each message, which the server requires and repeats."""
    reset_deadline: Positive = 10.0
    """Longest time for the acknowledgement of the beginning or the end of a trial [s]; beyond it the connection is
    dropped."""
    heartbeat_every: Annotated[float, Field(ge=0, allow_inf_nan=False)] = 20.0
    """Longest silence before a heartbeat is sent [s], so that a lost server is noticed before it is needed. 0: none."""


def build(config: Config, robot: Robot, clock: Clock, control_rate: float) -> XpolicylabPolicy:
    """Create the policy, not yet connected. Raises ConfigurationError if a setting does not fit the robot."""
    return XpolicylabPolicy(config, robot, control_rate)


class XpolicylabPolicy(IdlePingPolicy):
    """Policy with one trial per run; a connection that was lost is opened again, and the trial goes on.

    Each `reset` begins a trial, or else the first `infer`. If the connection is gone at the end of a run, the trial is
    ended before the next one begins. `dropped_replies` is the number of replies that belonged to no pending request.
    """

    PROTOCOL = "XPolicyLab"

    def __init__(self, config: Config, robot: Robot, control_rate: float) -> None:
        super().__init__(config, config.heartbeat_every)
        self._config = config
        self._layout = Layout(config, robot, control_rate)
        self.observation_eef = config.observation_eef
        self.uses_poses = config.uses_poses
        self._trial: str | None = None  # begun on the server
        self._ending: str | None = None  # trial that must still be ended on the server
        self._step = 0  # inferences in this trial
        self.dropped_replies = 0

    def infer(self, observation: Observation, conditioning: Conditioning | None = None) -> ActionChunk:
        """Return the chunk; `timing` contains the server's `latency_ms` and our `round_trip_ms`.

        Raises PolicyLostError if the server is absent or does not respond: the next call opens another connection.
        """
        if conditioning is not None:
            raise PolicyError("the XPolicyLab protocol has no real-time chunking; choose another strategy")
        payload = {"observation": self._layout.observation(observation)}
        with self._lock:
            self._reopen()
            self._begin_trial()
            seconds, started = self._next_deadline(), time.monotonic()
            reply = self._exchange_request("infer", payload, seconds, self._trial, self._step)
            timing = _latency(reply) | {"round_trip_ms": 1e3 * (time.monotonic() - started)}
            self._step += 1
        if "actions" not in reply:
            raise WrongProtocolError(
                f"the answer has no 'actions'; it has {', '.join(map(str, reply)) or 'nothing'}"
            )
        return self._config.chunk(self._layout.rows(reply["actions"]), timing)

    def reset(self) -> None:
        """End the trial on the server and begin the next.

        This is also done for a trial without inferences: other clients may have used the model since it began.
        """
        with self._lock:
            self._leave_trial()
            self._reopen()
            self._begin_trial()

    def end_episode(self) -> None:
        """End the trial, but only over an open connection; otherwise it is ended before the next one begins."""
        with self._lock:
            self._leave_trial()
            if self._link.is_open and not self._link.closed_by_peer and not self._closed:
                self._end_trial()

    def _leave_trial(self) -> None:
        if self._trial is not None:
            self._ending, self._trial, self._step = self._trial, None, 0

    def _begin_trial(self) -> None:
        self._end_trial()
        if self._trial is None:
            trial = str(uuid.uuid4())
            self._exchange_request("reset", {"trial_id": trial}, self._config.reset_deadline, trial)
            self._trial = trial

    def _end_trial(self) -> None:
        trial, self._ending = self._ending, None
        if trial is None:
            return
        try:
            self._exchange_request("trial_end", {"trial_id": trial}, self._config.reset_deadline, trial)
        except PolicyLostError:
            self._ending = trial  # the server may not have heard of it
            raise

    def _read_metadata(self) -> dict[str, Any]:
        return self._exchange_request("hello", {}, self._link.open_silent())

    def _check_metadata(self, metadata: dict[str, Any]) -> PolicyInfo:
        return PolicyInfo(
            name=str(metadata.get("server", "xpolicylab")),
            rate=self._config.action_rate,
            metadata=metadata,
        )

    def _ping(self, seconds: float) -> None:
        self._exchange_request("heartbeat", {}, seconds, self._trial)

    def _leave(self) -> None:
        """Close the connection, which the server does, too, after the message `close`."""
        farewell = Request("close", self._config.evaluation_id, {"reason": "the client leaves"}, self._trial)
        self._link.close_gracefully(arrays.pack(farewell.to_dict(), mnp=True))

    def _exchange_request(
        self, kind: Kind, payload: Mapping[str, Any], seconds: float, trial: str | None = None, step: int = 0
    ) -> dict[str, Any]:
        """Return the payload of the reply to a message; replies to others are dropped and counted.

        Raises PolicyTimeout after `seconds` [s], or the error that the server reports; such errors leave the
        connection.
        """
        request = Request(kind, self._config.evaluation_id, payload, trial, step)
        dropped_before = self.dropped_replies

        def match(answer: bytes) -> dict[str, Any] | None:
            message = self._decode(answer, f"an answer to {kind}")
            if request.is_answered_by(message):
                return message
            self.dropped_replies += 1
            if self.dropped_replies == dropped_before + 1:  # one line per request: there may be thousands
                log.warning(
                    "%s sent a reply (%.80s) to no pending request, it is dropped; %d so far",
                    self._config.url,
                    message.get("message_type"),
                    self.dropped_replies,
                )
            return None

        packed = arrays.pack(request.to_dict(), mnp=True)
        reply = self._link.exchange_matched(packed, seconds, _AN_ANSWER_TO(request=kind), match)
        self._spoken = time.monotonic()
        return request.read(reply)

    def _unpack(self, payload: bytes) -> Any:
        return arrays.unpack(payload, ANSWER_LIMIT)


def _latency(reply: Mapping[str, Any]) -> dict[str, float]:
    """Return the server's own duration [ms], if it states one."""
    latency = reply.get("latency_ms")
    if isinstance(latency, int | float | np.number) and math.isfinite(latency):
        return {"latency_ms": float(latency)}
    return {}
