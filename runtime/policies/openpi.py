"""Policies on openpi websocket servers: metadata on connect, then one map of actions for each map of an observation.

Source: openpi's websocket_policy_server and openpi-client. The layout of requests is declared in the configuration, so
that the layouts of ALOHA, DROID and LIBERO are settings and not code.
"""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from pydantic import Field

from runtime.core import msgpack_arrays
from runtime.core.clock import Clock
from runtime.core.errors import CodecError, ConfigurationError, PolicyError, WrongProtocolError
from runtime.core.types import ActionChunk, Conditioning, Float32, Observation
from runtime.policies.action_layout import ActionFormatSettings
from runtime.policies.action_rows import parse_action_rows
from runtime.policies.base import PolicyInfo
from runtime.policies.gripper_convention import Convention, GripperConvention
from runtime.policies.request_layout import RequestLayout, RequestSettings, pose_rows_for
from runtime.policies.rtc.async_rtc import AsyncRtc, Schedule
from runtime.policies.rtc.base import Dialect, NoRtc
from runtime.policies.rtc.kai0 import Kai0
from runtime.policies.rtc.openpi_rtc import EnvelopeKeys, OpenpiRtc, Rows
from runtime.policies.rtc.prev_action import PrevAction
from runtime.policies.server_claims import DeclaredPolicy, check_server_claims
from runtime.policies.websocket import Positive, ServerSettings, WebsocketPolicy
from runtime.policies.websocket_link import ANSWER_LIMIT

if TYPE_CHECKING:
    from robots import Robot

_SOONER = 0.95  # tolerance on the inference time that the server states: clocks differ by less

# Metadata keys that identify servers of other protocols, with their kind.
_MARKS = {
    "needs_wrist_camera": "roboarena",
    "n_external_cameras": "roboarena",
    "available_unnorm_keys": "starvla",
}


class Config(ServerSettings, RequestSettings, ActionFormatSettings):
    """A policy server that speaks the openpi websocket protocol."""

    kind: Literal["openpi"] = "openpi"
    gripper: Convention = "robot"
    """Gripper convention in state and responses: "robot": the robot's own values; "droid": 0 is open and 1 is
    closed."""
    action_scale: Annotated[list[float], Field(min_length=1)] | None = None
    """Factor of each number of a row, in the order of the row. DROID's joint velocities are shares of 0.2 rad per row:
    0.2 for every joint and 1 for the gripper, with action_mode "delta"."""
    rtc: Literal["none", "prev_action", "openpi_rtc", "kai0", "async_rtc"] = "none"
    """Protocol that sends the committed actions to the server: flat keys ("prev_action"), the envelope of openpi-rtc
    and its forks, kai0's flat keys, or the openpi-async-rtc envelope ("async_rtc"); "none" sends none."""
    rtc_envelope: EnvelopeKeys = EnvelopeKeys()
    """With openpi_rtc: keys of the envelope, and number of rows that the server removes from the previous chunk."""
    rtc_rows: Rows = "aligned"
    """With openpi_rtc and kai0: "aligned" sends the previous chunk so that the server continues from the first row that
    the robot has not consumed; "whole" sends it from its first row on, as these dialects' own clients do, which is
    correct only if the robot has consumed as many rows as the server assumes."""
    rtc_model_rows: Literal["absolute", "relative"] | None = None
    """Reference of the model's own rows that an RTC server returns besides its actions. Rows "relative" to the state in
    the request (openpi's delta joint actions) mean something else at the next observation and are not continued.
    Absent: they are treated as absolute, and a preflight reports that this is unknown."""
    prefix_attention_schedule: Schedule = "exp"
    """With async_rtc: decay of the previous rows' weight after the predicted delay."""
    max_guidance_weight: Positive | None = None
    """Largest influence of the previous rows on an inference; absent: 10 with async_rtc, 0.5 with kai0 (whose server
    ignores it)."""


def build(config: Config, robot: Robot, clock: Clock, control_rate: float) -> OpenpiPolicy:
    """Create the policy, not yet connected.

    Raises ConfigurationError if the request's layout does not fit the robot.
    """
    return OpenpiPolicy(config, robot, control_rate)


class OpenpiPolicy(WebsocketPolicy):
    """Policy with openpi's messages, and the additions of a dialect of real-time chunking."""

    PROTOCOL = "openpi"

    def __init__(self, config: Config, robot: Robot, control_rate: float) -> None:
        super().__init__(config)
        self._config = config
        self._layout = RequestLayout(config, robot)
        poses = pose_rows_for(config.action_space, config.action_pose, robot, "action_pose")
        self._width = robot.dim if poses is None else poses.width
        self._grip = GripperConvention(config.gripper, robot, poses)
        self._scale = _scale(config.action_scale, self._width)
        self._declared = DeclaredPolicy(
            config,
            config.action_space,
            config.action_mode,
            config.relative_frame,
            config.action_pose,
            self._width,
            config.action_rate or control_rate,
        )
        self.observation_eef = config.observation_eef
        self.uses_poses = config.observation_space == "eef" or (
            config.action_space == "eef" and config.action_mode != "absolute"
        )
        self._dialect = _dialect(config)
        self._absolute = config.action_mode == "absolute"
        self._converts = self._scale is not None or config.gripper != "robot"
        self._own_relative = None if config.rtc_model_rows is None else config.rtc_model_rows == "relative"

    def infer(self, observation: Observation, conditioning: Conditioning | None = None) -> ActionChunk:
        """Return the chunk; `timing` contains the durations [ms] that the server states and our `round_trip_ms`.

        Raises:
            PolicyLostError: The server is absent or does not respond. The next call opens another connection.
            PolicyError: The dialect `policy.rtc` cannot carry the conditioning.
        """
        fields, continued = self.request(observation), self._as_served(conditioning)
        with self._lock:
            request = msgpack_arrays.pack(self._dialect.wrap(fields, continued))
            self._require_open()
            answer, round_trip = self._exchange(request)
            result = self._result(self._decode(answer, "an answer"))
        return self._chunk(result, round_trip)

    def reset(self) -> None:
        """Do nothing, because the protocol has no reset, and no response depends on an earlier request."""

    def request(self, observation: Observation) -> dict[str, object]:
        """Return the request map for an observation in the declared layout, without the dialect's additions."""
        return self._layout.build(self._grip.convert_observation(observation))

    def _check_metadata(self, metadata: dict[str, Any]) -> PolicyInfo:
        _check_protocol(metadata)
        space = check_server_claims(metadata, self._declared, "metadata")
        supports_rtc = self._dialect.check_supported(metadata)
        horizon = metadata.get("action_horizon")
        return PolicyInfo(
            name=str(metadata.get("name", "openpi")),
            action_space=space,
            horizon=horizon if type(horizon) is int else None,
            rate=self._config.action_rate,
            supports_rtc=supports_rtc,
            metadata=metadata,
        )

    def _result(self, reply: dict[str, Any]) -> dict[str, Any]:
        try:
            return self._dialect.unwrap(reply)
        except PolicyError:
            # After an error the server closes; after a wrong response all later ones would be wrong, too.
            self._link.close_gracefully()
            raise

    def _mismatch_reason(self, request: bytes, answer: bytes, took: float) -> str:
        """Return the reason to suspect that this response belongs to an earlier request, "" if there is none.

        The response is suspicious if it arrived sooner than the inference time that it states allows, or if the check
        that all policies share finds a reason.
        """
        with contextlib.suppress(CodecError):  # reported by `infer`
            reply = msgpack_arrays.unpack(answer, ANSWER_LIMIT)
            infer_ms = _timing(reply).get("server.infer_ms", 0.0) if isinstance(reply, dict) else 0.0
            if took < _SOONER * infer_ms:
                return "the answer came sooner than the server says that its inference took"
        return super()._mismatch_reason(request, answer, took)

    def _chunk(self, reply: Mapping[str, Any], round_trip: float) -> ActionChunk:
        if "actions" not in reply:
            raise WrongProtocolError(
                f"the answer has no 'actions'; it has {', '.join(map(str, reply)) or 'nothing'}"
            )
        check_server_claims(reply, self._declared, "answer")
        rows = parse_action_rows("actions", reply["actions"], self._width)
        own = self._model_rows(reply)
        return ActionChunk(
            actions=self._grip.to_robot(rows if self._scale is None else rows * self._scale),
            space=self._config.action_space,
            rate=self._config.action_rate,
            mode=self._config.action_mode,
            frame=self._config.relative_frame,
            pose=self._config.action_pose,
            model_actions=rows if own is None and self._converts and self._absolute else own,
            model_relative=False if own is None else self._own_relative,
            timing=_timing(reply) | {"round_trip_ms": round_trip},
        )

    def _model_rows(self, reply: Mapping[str, Any]) -> Float32 | None:
        origin = reply.get("origin_actions") if self._dialect.continues_model_rows else None
        return None if origin is None else parse_action_rows("origin_actions", origin)

    def _as_served(self, conditioning: Conditioning | None) -> Conditioning | None:
        """Return the conditioning with its rows converted to the server's values.

        Rows in absolute mode are unchanged, because they were stored as the server sent them.
        """
        if conditioning is None or self._absolute or not self._converts:
            return conditioning
        rows = self._grip.served(conditioning.previous)
        if self._scale is not None:
            rows = np.divide(rows, self._scale, out=np.zeros_like(rows), where=self._scale != 0)
        return replace(conditioning, previous=rows)


def _check_protocol(metadata: Mapping[str, Any]) -> None:
    """Raise WrongProtocolError if the metadata show that the server speaks another protocol.

    Some other servers send metadata first too, as openpi servers do, but then expect other requests.
    """
    kind = next((kind for mark, kind in _MARKS.items() if mark in metadata), None)
    if kind is not None:
        keys = ", ".join(map(str, metadata))
        raise WrongProtocolError(
            f'the server\'s metadata have {keys}: it is a server for policy.kind = "{kind}"; correct policy.kind or '
            "policy.url"
        )


def _scale(factors: list[float] | None, width: int) -> Float32 | None:
    if factors is not None and len(factors) != width:
        raise ConfigurationError(
            f"policy.action_scale has {len(factors)} numbers; the rows of this robot have {width}"
        )
    return None if factors is None else np.array(factors, np.float32)


def _dialect(config: Config) -> Dialect:
    weight = config.max_guidance_weight
    if config.rtc == "async_rtc":
        return AsyncRtc(config.prefix_attention_schedule, 10.0 if weight is None else weight)
    if config.rtc == "kai0":
        return Kai0(config.rtc_rows, 0.5 if weight is None else weight)
    if config.rtc == "openpi_rtc":
        return OpenpiRtc(config.rtc_envelope, config.rtc_rows)
    return PrevAction() if config.rtc == "prev_action" else NoRtc()


def _timing(reply: Mapping[str, Any]) -> dict[str, float]:
    """Return the server's durations [ms] as "server.infer_ms", "policy.infer_ms"; other values are dropped."""
    timing: dict[str, float] = {}
    for group in ("server", "policy"):
        figures = reply.get(f"{group}_timing")
        for name, figure in figures.items() if isinstance(figures, dict) else ():
            if isinstance(figure, int | float | np.number):
                timing[f"{group}.{name}"] = float(figure)
    return timing
