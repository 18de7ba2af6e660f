"""LeRobot's asynchronous inference over gRPC, without the packages lerobot and torch.

Its messages are pickles in both directions, and the server executes them: any peer that reaches its port can run code
there. This policy is therefore for servers on this machine or behind a tunnel, and must be allowed per checkpoint.
Responses are read by our own interpreter of pickles, which executes nothing. An empty response means either that the
server had no observation or that inference failed; it does not say which. Source: lerobot.async_inference of LeRobot
0.4.
"""

from __future__ import annotations

import ipaddress
import threading
import time
from typing import TYPE_CHECKING, Annotated, Literal
from urllib.parse import urlsplit

from pydantic import Field

from runtime.core.clock import Clock
from runtime.core.errors import (
    CodecError,
    ConfigurationError,
    PolicyDisconnected,
    PolicyError,
    PolicyTimeout,
    ServerReportedError,
    WrongProtocolError,
)
from runtime.core.types import ActionChunk, Conditioning, Observation
from runtime.policies.async_inference import messages
from runtime.policies.async_inference.grpc_channel import Channel
from runtime.policies.async_inference.pickles import MODULES, TimedAction, load_actions
from runtime.policies.async_inference.request import AsyncRequest, RequestSettings
from runtime.policies.base import Policy, PolicyInfo
from runtime.policies.response_delay import ResponseDelaySettings
from runtime.policies.tunnel.settings import TunnelSettings

if TYPE_CHECKING:
    from robots import Robot

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]

ANSWER_LIMIT = 8 * 1024 * 1024  # [bytes]; every row carries the whole chunk: 100 rows of 32 values are 1.3 MB
EXCLUSIVE = True  # the server has one checkpoint and one observation, those of its last client
_PAUSES = (0.05, 0.5)  # shortest and longest pause after an empty response [s]


class Config(ResponseDelaySettings, RequestSettings):
    """LeRobot's policy server, which loads the checkpoint that the station names."""

    kind: Literal["lerobot"] = "lerobot"
    url: Annotated[str, Field(pattern=r"^grpc://[^/:]+:\d{1,5}$|^grpc://\[[0-9a-fA-F:]+\]:\d{1,5}$")] = (
        "grpc://127.0.0.1:8080"
    )
    """Address of the server: grpc://HOST:PORT; beyond this machine, or the tunnel's far end, only with
    insecure_link."""
    tunnel: TunnelSettings | None = None
    """SSH tunnel to the server; `url` is then resolved at the tunnel's far end."""
    accept_pickle: bool = False
    """Must be true: a server of this kind executes any code that reaches its port. The station executes nothing from
    its responses."""
    insecure_link: bool = False
    """Allow a server beyond this machine, although anyone on the network path can run code on it and move the robot;
    not needed with an SSH tunnel."""
    connect_deadline: Positive = 5.0
    """Longest time for connecting, and for a reset [s]."""
    load_deadline: Positive = 300.0
    """Longest time for the server to load the checkpoint [s], also after a restart without it."""
    first_inference_deadline: Positive = 120.0
    """Longest time for the first response after set-up [s]."""
    inference_deadline: Positive = 5.0
    """Longest time for every later response [s]. The server waits two seconds for an observation that it has missed."""


def build(config: Config, robot: Robot, clock: Clock, control_rate: float) -> LerobotPolicy:
    """Create the policy, not yet connected. Raises ConfigurationError if it is not allowed, installed or suitable."""
    if not config.accept_pickle:
        raise ConfigurationError(
            'policy.kind = "lerobot" exchanges pickles: whoever reaches the server\'s port can run code there; '
            "allowed: policy.accept_pickle = true, for a server that only this machine reaches"
        )
    host = urlsplit(config.url).hostname or ""
    if not config.insecure_link and not _is_loopback(host):
        left = "this machine" if config.tunnel is None else f"the tunnel's far end {config.tunnel.where}"
        allowed = "[policy.tunnel] to its machine" if config.tunnel is None else "a tunnel to its own machine"
        raise ConfigurationError(
            f"policy.url = {config.url!r} leaves {left} over a plain link; allowed: a loopback address, with {allowed} "
            "where the server is elsewhere, or policy.insecure_link = true on a network you trust"
        )
    return LerobotPolicy(config, robot, control_rate)


class LerobotPolicy(Policy):
    """Policy on one channel, which is replaced at the next `infer` after a timeout or a lost response.

    Every observation has `must_go` set: the server would skip one with nearly unchanged joints. Deadlines are real
    seconds, whatever the clock. The longer first deadline applies to the first request after `connect`.
    """

    def __init__(self, config: Config, robot: Robot, control_rate: float) -> None:
        self._config = config
        self._request = AsyncRequest(config, robot, control_rate)
        self.observation_eef = config.observation_eef
        self.uses_poses = config.uses_poses
        self._link = self._new_link()
        self._lock = threading.Lock()  # for the connection; held through every wait
        self._turning = threading.Lock()  # for the change between open and closed; held briefly
        self._ended = threading.Event()
        self._loaded = False  # whether the server has the checkpoint, as far as known
        self._warm = False
        self._asked = False  # since the last reset
        self._timestep = 0

    def connect(self) -> PolicyInfo:
        """Connect to the server and let it load the checkpoint; an open connection is replaced."""
        with self._lock:
            self._warm = self._loaded = False
            self._link.drop()
            with self._turning:
                self._ended.clear()
                self._link = self._new_link()
            self._open()
        config = self._config
        return PolicyInfo(
            name=config.checkpoint,
            horizon=config.actions_per_chunk,
            rate=config.action_rate,
            metadata={"policy_type": config.policy_type, "checkpoint": config.checkpoint},
        )

    def infer(self, observation: Observation, conditioning: Conditioning | None = None) -> ActionChunk:
        """Return the chunk for an observation; `timing` contains our `round_trip_ms`.

        Raises:
            PolicyLostError: The server is absent or does not respond. The next call opens another connection, and lets
                the server load the checkpoint again if it has lost it.
            PolicyError: All responses were empty.
        """
        if conditioning is not None:
            raise PolicyError(
                "LeRobot's asynchronous inference has no real-time chunking; choose another strategy"
            )
        with self._lock:
            if self._ended.is_set():
                raise PolicyError(f"the policy at {self._config.url} is closed; connect first")
            self._timestep += 1
            request = self._request.build(observation, self._timestep)
            if not self._link.is_open:
                self._open()
            seconds = self._config.inference_deadline if self._warm else self._config.first_inference_deadline
            self._warm = self._asked = True
            started = time.monotonic()
            try:
                answer = self._answer(request, seconds)
            except PolicyDisconnected:
                self._loaded = False
                raise
            round_trip = 1e3 * (time.monotonic() - started)
            rows = self._request.rows(self._read(answer), self._timestep)
        return self._config.chunk(rows, {"round_trip_ms": round_trip})

    def reset(self) -> None:
        """Make the server drop its observation; if there was no request since the last reset, nothing is sent."""
        with self._lock:
            if self._asked and self._link.is_open:  # a new connection starts without an observation anyway
                self._link.call(messages.READY, messages.EMPTY, self._config.connect_deadline)
            self._asked = False

    def close(self) -> None:
        """Abort the connection and return at once; a call that waits in another thread raises PolicyError."""
        with self._turning:
            self._ended.set()
            self._link.abort()
        if self._lock.acquire(blocking=False):  # otherwise the waiting thread drops it
            try:
                self._link.drop()
            finally:
                self._lock.release()

    def _new_link(self) -> Channel:
        return Channel(self._config.url, self._config.connect_deadline, ANSWER_LIMIT, self.address_override)

    def _open(self) -> None:
        left = self._link.open()
        try:
            self._link.call(messages.READY, messages.EMPTY, left)
            if not self._loaded:
                message = messages.encode_setup(self._request.setup_message())
                self._link.call(messages.INSTRUCT, message, self._config.load_deadline)
                self._loaded = True
        except PolicyError as error:
            self._link.drop()
            if "No module named 'lerobot" not in str(error):
                raise
            raise ServerReportedError(
                f"{error}\nThe server's LeRobot has its classes in another place: policy.server_version is "
                f"{self._config.server_version!r}, allowed: {', '.join(MODULES)}"
            ) from error

    def _answer(self, request: bytes, seconds: float) -> bytes:
        """Return the pickled actions for the pickled observation `request`, sent again after an empty response.

        A response is empty after a failed inference, and also if a call that we aborted earlier took the observation
        from the server's queue.
        """
        deadline, pause, attempts = time.monotonic() + seconds, _PAUSES[0], 0
        while True:
            try:
                data = self._asked_once(request, deadline)
            except PolicyTimeout as error:
                if not attempts:
                    raise
                raise self._nothing(attempts, seconds) from error
            if data:
                return data
            attempts += 1
            if time.monotonic() + pause >= deadline:
                raise self._nothing(attempts, seconds)
            if self._ended.wait(pause):
                raise PolicyError(f"the connection to {self._config.url} was closed from our side")
            pause = min(2 * pause, _PAUSES[1])

    def _asked_once(self, request: bytes, deadline: float) -> bytes:
        self._link.call(messages.OBSERVE, messages.encode_observations(request), self._left(deadline))
        answer = self._link.call(messages.ACT, messages.EMPTY, self._left(deadline))
        try:
            return messages.decode_actions(answer)
        except CodecError as error:
            self._link.drop()
            raise WrongProtocolError(
                f"{self._config.url} sent an answer that is not LeRobot's: {error}"
            ) from error

    def _nothing(self, attempts: int, seconds: float) -> PolicyError:
        self._loaded = False  # it may have restarted without the checkpoint
        self._link.drop()
        return ServerReportedError(
            f"{self._config.url} answered with nothing, {attempts} times within {seconds:g} s: its inference fails, "
            "which it tells its own log alone. What fails most: the model has other images, another number of states, "
            "or another kind than policy.images, policy.state and policy.policy_type say"
        )

    def _left(self, deadline: float) -> float:
        left = deadline - time.monotonic()
        if left <= 0:
            self._link.drop()
            raise PolicyTimeout(
                f"{self._config.url} did not answer within the deadline; the connection is dropped"
            )
        return left

    def _read(self, data: bytes) -> list[TimedAction]:
        try:
            return load_actions(data, ANSWER_LIMIT)
        except CodecError as error:
            self._link.drop()
            raise WrongProtocolError(
                f"{self._config.url} sent an answer that is not LeRobot's: {error}"
            ) from error


def _is_loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"
