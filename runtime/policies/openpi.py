"""The openpi websocket protocol: metadata on connect, then one observation map, one map of actions.

Source: openpi's websocket_policy_server and openpi-client. The request's layout is declared in the
configuration, so that the ALOHA, DROID and LIBERO layouts are settings and not code.
"""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Mapping
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from pydantic import Field

from runtime import codecs
from runtime.clock import Clock
from runtime.errors import CodecError, ConfigurationError, PolicyError
from runtime.formats import PoseFormat
from runtime.policies.agreement import Declared, agreed
from runtime.policies.base import Policy, PolicyInfo
from runtime.policies.link import WebsocketLink
from runtime.policies.request import RequestLayout, RequestSettings, poses_of
from runtime.policies.rows import action_rows
from runtime.policies.rtc.async_rtc import AsyncRtc, Schedule
from runtime.policies.rtc.base import Dialect, Plain
from runtime.policies.rtc.prev_action import PrevAction
from runtime.types import ActionChunk, ActionMode, Conditioning, Observation, RelativeFrame, Space

if TYPE_CHECKING:
    from robots import Robot

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Rate = Annotated[float, Field(ge=1, le=1000)]

ANSWER_LIMIT = 64 * 1024 * 1024  # bytes; a chunk of 50 rows is some kilobytes


class Config(RequestSettings):
    """A policy server that speaks the openpi websocket protocol."""

    kind: Literal["openpi"] = "openpi"
    url: Annotated[str, Field(pattern=r"^wss?://.+")] = "ws://127.0.0.1:8000"
    """Where the server listens."""
    api_key_env: str | None = None
    """Environment variable with the API key; the key itself would end up in every recording's manifest."""
    connect_deadline: Positive = 5.0
    """For the connection and the server's metadata [s]."""
    first_inference_deadline: Positive = 120.0
    """For the first answer after set-up [s]: the server may have to compile its model."""
    inference_deadline: Positive = 2.0
    """For every later answer [s], also of a server that came back; after it the connection is dropped."""
    action_space: Space = "joint"
    """What the rows of the answer are: joint targets, or poses."""
    action_pose: PoseFormat = PoseFormat()
    """How poses are written in the answer, where action_space is "eef"."""
    action_mode: ActionMode = "absolute"
    """What their numbers are: targets; "relative" to the observation; or "delta", each to the row before.

    Grippers are absolute in every mode. A server's own metadata key action_mode names the space, not this."""
    relative_frame: RelativeFrame = "base"
    """Axes of relative poses: those of the frame that poses are declared in, or the tool as observed."""
    action_rate: Rate | None = None
    """Rows per second of the answer [Hz]; the control rate where it is not given."""
    rtc: Literal["none", "prev_action", "async_rtc"] = "none"
    """How the server is told what the robot is committed to: flat keys, or the openpi-async-rtc envelope."""
    prefix_attention_schedule: Schedule = "exp"
    """With async_rtc: how the weight of the rows before falls after the predicted delay."""
    max_guidance_weight: Positive = 10.0
    """With async_rtc: most that those rows may bend an inference."""


def build(config: Config, robot: Robot, clock: Clock, control_rate: float) -> OpenpiPolicy:
    """The policy, not yet connected; ConfigurationError where the request's layout does not fit the robot."""
    return OpenpiPolicy(config, robot, control_rate)


class OpenpiPolicy(Policy):
    """One connection; a timed-out one is dropped, and the next `infer` opens another.

    Deadlines are real seconds whatever the clock, because a server on a wire knows no other. The long first
    deadline holds once after `connect`: later no `infer` takes longer than the deadlines of connection and
    inference together, so that a server that came back mute, or compiles again, is found out quickly.
    """

    def __init__(self, config: Config, robot: Robot, control_rate: float) -> None:
        self._config = config
        self._layout = RequestLayout(config, robot)
        poses = poses_of(config.action_space, config.action_pose, robot, "action_pose")
        self._width = robot.dim if poses is None else poses.width
        self._declared = Declared(
            config,
            config.action_space,
            config.action_mode,
            config.relative_frame,
            config.action_pose,
            self._width,
            config.action_rate or control_rate,
        )
        self.observation_eef = config.observation_eef
        self.sees_poses = config.observation_space == "eef" or (
            config.action_space == "eef" and config.action_mode != "absolute"
        )
        self._headers = _headers(config)
        self._dialect = _dialect(config)
        self._link = self._new_link()
        self._lock = threading.Lock()  # of the wire: held through every wait
        self._turning = threading.Lock()  # between open and closed: held for a moment
        self._closed = False
        self._warm = False

    def connect(self) -> PolicyInfo:
        """Reach the server and read its metadata; an open connection is replaced."""
        with self._lock:
            self._warm = False
            self._link.drop()
            with self._turning:
                self._closed = False
                self._link = self._new_link()
            return self._open()

    def infer(self, observation: Observation, conditioning: Conditioning | None = None) -> ActionChunk:
        """The chunk; `timing` has the server's figures [ms] and our `round_trip_ms`.

        PolicyLostError where the server is not there or does not answer: the next call opens another connection.
        PolicyError for conditioning that the dialect `policy.rtc` cannot carry.
        """
        shown = self.request(observation)
        with self._lock:
            request = codecs.pack(self._dialect.request(shown, conditioning))
            if self._closed:
                raise PolicyError(f"the policy at {self._config.url} is closed; connect first")
            if not self._link.is_open:
                self._open()
            started = time.monotonic()
            reply = self._unpacked(self._exchange(request), "an answer")
            round_trip = 1e3 * (time.monotonic() - started)
            result = self._result(reply)
        return self._chunk(result, round_trip)

    def reset(self) -> None:
        """Nothing to forget: the protocol has no reset, and no answer depends on an earlier one."""

    def close(self) -> None:
        """Cut the connection and return at once; a call that waits in another thread raises PolicyError.

        What is left of the connection is dropped by whoever uses it, now or at the next `connect`.
        """
        with self._turning:
            self._closed = True
            self._link.abort()

    def request(self, observation: Observation) -> dict[str, object]:
        """The request map for an observation, in the declared layout, without what a dialect adds."""
        return self._layout.of(observation)

    def _new_link(self) -> WebsocketLink:
        return WebsocketLink(self._config.url, self._headers, self._config.connect_deadline)

    def _open(self) -> PolicyInfo:
        metadata = self._unpacked(self._link.open(), "metadata")
        try:
            space = agreed(metadata, self._declared, "metadata")
            supports_rtc = self._dialect.supported(metadata)
        except PolicyError:
            self._link.drop()
            raise
        horizon = metadata.get("action_horizon")
        return PolicyInfo(
            name=str(metadata.get("name", "openpi")),
            action_space=space,
            horizon=horizon if type(horizon) is int else None,
            supports_rtc=supports_rtc,
            metadata=metadata,
        )

    def _exchange(self, request: bytes) -> bytes:
        config = self._config
        seconds = config.inference_deadline if self._warm else config.first_inference_deadline
        self._warm = True
        return self._link.exchange(request, seconds)

    def _result(self, reply: dict[str, Any]) -> dict[str, Any]:
        try:
            return self._dialect.result(reply)
        except PolicyError:
            self._link.drop()  # after an error the server closes, after another's answer all would be another's
            raise

    def _unpacked(self, payload: bytes, what: str) -> dict[str, Any]:
        try:
            message = codecs.unpack(payload, ANSWER_LIMIT)
        except CodecError as error:
            self._link.drop()
            raise PolicyError(
                f"{self._config.url} sent {what} that is not the openpi protocol: {error}"
            ) from error
        if not isinstance(message, dict):
            self._link.drop()
            raise PolicyError(
                f"{self._config.url} sent {what} that is a {type(message).__name__}; expected a map"
            )
        return message

    def _chunk(self, reply: Mapping[str, Any], round_trip: float) -> ActionChunk:
        if "actions" not in reply:
            raise PolicyError(
                f"the answer has no 'actions'; it has {', '.join(map(str, reply)) or 'nothing'}"
            )
        agreed(reply, self._declared, "answer")
        origin = reply.get("origin_actions")
        return ActionChunk(
            actions=action_rows("actions", reply["actions"], self._width),
            space=self._config.action_space,
            rate=self._config.action_rate,
            mode=self._config.action_mode,
            frame=self._config.relative_frame,
            pose=self._config.action_pose,
            model_actions=None if origin is None else action_rows("origin_actions", origin),
            timing=_timing(reply) | {"round_trip_ms": round_trip},
        )


def _dialect(config: Config) -> Dialect:
    if config.rtc == "async_rtc":
        return AsyncRtc(config.prefix_attention_schedule, config.max_guidance_weight)
    return PrevAction() if config.rtc == "prev_action" else Plain()


def _headers(config: Config) -> dict[str, str]:
    if config.api_key_env is None:
        return {}
    key = os.environ.get(config.api_key_env)
    if not key:
        raise ConfigurationError(
            f"policy.api_key_env names {config.api_key_env}, which is not set in the environment"
        )
    return {"Authorization": f"Api-Key {key}"}


def _timing(reply: Mapping[str, Any]) -> dict[str, float]:
    """The server's figures [ms] as "server.infer_ms", "policy.infer_ms"; what is no number is left out."""
    timing: dict[str, float] = {}
    for group in ("server", "policy"):
        figures = reply.get(f"{group}_timing")
        for name, figure in figures.items() if isinstance(figures, dict) else ():
            if isinstance(figure, int | float | np.number):
                timing[f"{group}.{name}"] = float(figure)
    return timing
