"""Policies on StarVLA websocket servers.

A request is an envelope with a type, which carries the camera views as a list in a declared order. Frames and arrays
are encoded as by openpi. Source: starVLA's websocket policy server and its policy wrapper.

The server's process ends after a while without requests, so a ping is sent when there is no other traffic.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from pydantic import Field

from runtime.core import msgpack_arrays
from runtime.core.clock import Clock
from runtime.core.errors import (
    ActionSpaceError,
    ConfigurationError,
    ContradictionError,
    PolicyError,
    ServerReportedError,
    WrongProtocolError,
)
from runtime.core.types import ActionChunk, Conditioning, Observation
from runtime.policies.action_layout import ActionLayoutSettings
from runtime.policies.action_rows import parse_action_rows
from runtime.policies.base import PolicyInfo
from runtime.policies.idle_pings import IdlePingPolicy
from runtime.policies.normalization import Statistics
from runtime.policies.request_layout import PIXELS, RequestLayout, Size
from runtime.policies.websocket import ServerSettings
from runtime.policies.websocket_link import error_headline

if TYPE_CHECKING:
    from robots import Robot

_ENVIRONMENTS = (
    "starvla_policy_server",
    "simpler_env",
)  # the second was used until May 2026, without further keys


class Config(ServerSettings, ActionLayoutSettings):
    """A policy server of StarVLA."""

    kind: Literal["starvla"] = "starvla"
    url: Annotated[str, Field(pattern=r"^wss?://.+")] = "ws://127.0.0.1:10093"
    """Address of the server: ws:// or wss://, with a path if it has one."""
    cameras: list[str] = Field(default_factory=list)
    """Observation keys of the views, in the order in which the policy was trained with them."""
    image_size: Size | None = None
    """Height and width of the views [pixels]; absent: the training size in the server's metadata, else unchanged. If
    both are given, they must agree."""
    state: bool = True
    """Whether the state is sent, [1, D]; false for checkpoints that were trained without it."""
    unnorm_key: str | None = None
    """Key of the statistics with which the server converts actions to the robot's values; absent: the server's
    default."""
    statistics: Statistics | None = None
    """The same statistics, for servers that return only `normalized_actions`, whose responses are otherwise refused."""
    ping_every: Annotated[float, Field(ge=0, allow_inf_nan=False)] = 60.0
    """Longest silence before a ping is sent [s], because a server without requests ends by itself. 0: no pings."""


def build(config: Config, robot: Robot, clock: Clock, control_rate: float) -> StarvlaPolicy:
    """Create the policy, not yet connected. Raises ConfigurationError if a setting does not fit the robot."""
    return StarvlaPolicy(config, robot)


class StarvlaPolicy(IdlePingPolicy):
    """Policy with one example per request; a connection that the server closed between requests is opened again.

    On connect it sends a ping, which only StarVLA's server answers.
    """

    PROTOCOL = "StarVLA"

    def __init__(self, config: Config, robot: Robot) -> None:
        super().__init__(config, config.ping_every)
        if not config.cameras or len(set(config.cameras)) != len(config.cameras):
            raise ConfigurationError(
                f"policy.cameras = {config.cameras}; allowed: the views in the order of the training, each once of "
                f"{', '.join(camera.key for camera in robot.cameras)}"
            )
        self._config = config
        self._robot = robot
        _, self._width = config.widths(robot)
        if config.statistics is not None:
            config.statistics.require_width(self._width)
        self._layout = self._layout_for(config.image_size)
        self.observation_eef = config.observation_eef
        self.uses_poses = config.uses_poses
        self._unnorm_key = config.unnorm_key
        self._number = 0

    def infer(self, observation: Observation, conditioning: Conditioning | None = None) -> ActionChunk:
        """Return the chunk; `timing` contains our `round_trip_ms`.

        Raises PolicyLostError if the server is absent or does not respond: the next call opens another connection.
        """
        if conditioning is not None:
            raise PolicyError("the StarVLA protocol has no real-time chunking; choose another strategy")
        with self._lock:
            self._reopen()
            envelope = self._envelope("infer") | {"payload": self.payload(observation)}
            answer, round_trip = self._exchange(msgpack_arrays.pack(envelope))
            self._spoken = time.monotonic()
            reply = self._decode(answer, "an answer")
            self._check_reply(reply, envelope)
        return self._chunk(reply.get("data"), round_trip)

    def reset(self) -> None:
        """Do nothing, because the protocol has no reset, and no response depends on an earlier request."""

    def payload(self, observation: Observation) -> dict[str, Any]:
        """Return the content of a request: one example, and the key of the model's statistics if there is one."""
        inputs = self._layout.build(observation)
        example: dict[str, Any] = {"image": list(inputs["images"].values()), "lang": observation.prompt}
        if self._config.state:
            example["state"] = inputs["state"][None]
        return {"examples": [example]} | ({"unnorm_key": self._unnorm_key} if self._unnorm_key else {})

    def _layout_for(self, size: list[int] | None) -> RequestLayout:
        sized = self._config.model_copy(update={"image_size": size})
        return sized.layout(self._robot, {key: key for key in self._config.cameras})

    def _check_metadata(self, metadata: dict[str, Any]) -> PolicyInfo:
        environment = metadata.get("env")
        if environment not in _ENVIRONMENTS and not {"available_unnorm_keys", "ckpt_path"} & set(metadata):
            keys = ", ".join(map(str, metadata)) or "nothing"
            raise WrongProtocolError(
                f"the server's metadata have env = {environment!r} and {keys}; expected env = {_ENVIRONMENTS[0]!r} or "
                f"{_ENVIRONMENTS[1]!r}: it is no StarVLA server; correct policy.kind or policy.url"
            )
        self._unnorm_key = _unnorm_key(metadata, self._config.unnorm_key)
        self._layout = self._layout_for(self._agreed_size(metadata.get("training_obs_image_size")))
        self._ping(self._config.connect_deadline)
        horizon = metadata.get("action_chunk_size")
        return PolicyInfo(
            name=str(metadata.get("ckpt_path", "starvla")),
            horizon=horizon if type(horizon) is int else None,
            rate=self._config.action_rate,
            metadata=metadata,
        )

    def _agreed_size(self, claimed: Any) -> list[int] | None:
        """Return height and width of the views. Raises ContradictionError if both sides state different sizes."""
        trained = _size(claimed)
        own = self._config.image_size
        if own is not None and trained is not None and own != trained:
            raise ContradictionError(
                f"the server's metadata has training_obs_image_size = {claimed!r}, policy.image_size = {own}; correct "
                "the one that is wrong"
            )
        return own or trained

    def _envelope(self, kind: str) -> dict[str, Any]:
        self._number += 1
        return {"type": kind, "request_id": f"{kind}-{self._number}"}

    def _ping(self, seconds: float) -> None:
        envelope = self._envelope("ping")
        reply = self._decode(
            self._link.exchange(msgpack_arrays.pack(envelope), seconds), "an answer to a ping"
        )
        self._check_reply(reply, envelope)
        self._spoken = time.monotonic()

    def _check_reply(self, reply: Mapping[str, Any], envelope: Mapping[str, Any]) -> None:
        """Raise PolicyError if the reply reports an error, or belongs to another request; then the connection is also
        closed.
        """
        requested_id, answered_id = envelope["request_id"], reply.get("request_id")
        if answered_id != requested_id:
            self._link.close_gracefully()
            raise WrongProtocolError(
                f"the answer has request_id {answered_id!r}, asked was {requested_id!r}: it is another "
                "request's, or no StarVLA server answers here"
            )
        if reply.get("ok") is not True or reply.get("status") != "ok":
            error = reply.get("error")
            message = error.get("message") if isinstance(error, Mapping) else error
            raise ServerReportedError(f"the policy server reports an error: {error_headline(str(message))}")

    def _chunk(self, data: Any, round_trip: float) -> ActionChunk:
        if not isinstance(data, Mapping):
            raise WrongProtocolError(f"the answer has data that are a {type(data).__name__}; expected a map")
        return self._config.chunk(self._rows(data), {"round_trip_ms": round_trip})

    def _rows(self, data: Mapping[str, Any]) -> np.ndarray[Any, np.dtype[np.float32]]:
        if "actions" in data:
            return parse_action_rows("actions", data["actions"], self._width)
        if "normalized_actions" not in data:
            raise WrongProtocolError(
                "the answer has neither 'actions' nor 'normalized_actions'; it has "
                f"{', '.join(map(str, data)) or 'nothing'}"
            )
        rows = parse_action_rows("normalized_actions", data["normalized_actions"], self._width)
        if self._config.statistics is None:
            raise ActionSpaceError(
                "the server returned normalized_actions; allowed: a server that "
                "un-normalises them, or its statistics in policy.statistics (low, high, mask)"
            )
        return self._config.statistics.denormalize(rows)


def _unnorm_key(metadata: Mapping[str, Any], own: str | None) -> str | None:
    """Return the key of the statistics to use: `own`, else the server's default or only key, None if it has none.

    Raises ContradictionError if the server lacks `own`, or has several keys and no default.
    """
    available = metadata.get("available_unnorm_keys")
    keys = [str(key) for key in available] if isinstance(available, list) else []
    if own is not None:
        if keys and own not in keys:
            raise ContradictionError(
                f"policy.unnorm_key = {own!r}, the server's metadata has available_unnorm_keys = {', '.join(keys)}"
            )
        return own
    default = metadata.get("default_unnorm_key")
    if isinstance(default, str) and default:
        return default
    if len(keys) > 1:
        raise ContradictionError(
            f"the server has statistics of {', '.join(keys)} and no default; policy.unnorm_key has to name one"
        )
    return keys[0] if keys else None


def _size(value: Any) -> list[int] | None:
    """Return height and width from one number (a square), two numbers, or three with the channels; None if `value` is
    None.
    """
    if value is None:
        return None
    numbers = [value, value] if type(value) is int else value
    if isinstance(numbers, list) and len(numbers) in (2, 3) and all(type(n) is int for n in numbers):
        sides = numbers[1:] if len(numbers) == 3 and numbers[0] == 3 else numbers[:2]
        if all(side in PIXELS for side in sides):
            return sides
    raise WrongProtocolError(
        f"the server's metadata have training_obs_image_size = {value!r}; expected height and width, "
        f"{PIXELS[0]} to {PIXELS[-1]} each"
    )
