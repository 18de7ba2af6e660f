"""Policies on GR00T servers N1.5, N1.6 and N1.7: one request, one response over a ZMQ REQ socket.

First the server is asked for its modality configuration, i.e. the inputs and outputs of its model. The form of requests
follows from it and from maps in the deployment; arrays are sent in the form that the server reads. The server's `kill`
endpoint is never used. Source: Isaac-GR00T's PolicyServer and PolicyClient; for servers without a modality
configuration, StarVLA.
"""

from __future__ import annotations

import contextlib
import re
import threading
import time
from collections.abc import Mapping
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import Field

from runtime.core.clock import Clock
from runtime.core.environment import read_secret
from runtime.core.errors import (
    CodecError,
    PolicyError,
    RefusedError,
    ServerReportedError,
    WrongProtocolError,
)
from runtime.core.host_references import Variable
from runtime.core.types import ActionChunk, Conditioning, Observation
from runtime.policies.base import Policy, PolicyInfo
from runtime.policies.groot import arrays
from runtime.policies.groot.modality import parse_modalities
from runtime.policies.groot.req_socket import ReqLink
from runtime.policies.groot.request import Gr00tRequest, RequestSettings
from runtime.policies.response_delay import ResponseDelaySettings
from runtime.policies.tunnel.settings import TunnelSettings
from runtime.policies.websocket_link import error_headline

if TYPE_CHECKING:
    from robots import Robot

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]

ANSWER_LIMIT = 64 * 1024 * 1024  # [bytes]
_HINTS = (  # errors of servers of one dialect on requests in another
    (
        r"must contain a '(video|state|language)'|KeyError: '(video|state|language)'",
        'policy.dialect = "nested"',
    ),
    (
        r"'?(video|state)\.\w+'? (key )?(must|is missing)|KeyError: '(video|state)\.",
        '"sim_wrapper" or "n1.5"',
    ),
)


class Config(ResponseDelaySettings, RequestSettings):
    """A policy server of Isaac GR00T."""

    kind: Literal["gr00t"] = "gr00t"
    url: Annotated[str, Field(pattern=r"^tcp://[^/:]+:\d{1,5}$|^tcp://\[[0-9a-fA-F:]+\]:\d{1,5}$")] = (
        "tcp://127.0.0.1:5555"
    )
    """Address of the server: tcp://HOST:PORT."""
    tunnel: TunnelSettings | None = None
    """SSH tunnel to the server; `url` is then resolved at the tunnel's far end."""
    api_token_env: Variable | None = None
    """Environment variable with the server's API token; the token itself would be copied to every manifest."""
    connect_deadline: Positive = 5.0
    """Longest time for connecting and for the server's modality configuration, and for a reset [s]."""
    first_inference_deadline: Positive = 120.0
    """Longest time for the first response after set-up [s]; the server may have to compile its model."""
    inference_deadline: Positive = 2.0
    """Longest time for every later response, also after a reconnection [s]; beyond it the connection is dropped."""


def build(config: Config, robot: Robot, clock: Clock, control_rate: float) -> Gr00tPolicy:
    """Create the policy, not yet connected. Raises ConfigurationError if its maps do not fit the robot."""
    return Gr00tPolicy(config, robot, control_rate)


class UnknownEndpoint(WrongProtocolError):
    """Error that the server does not know the requested endpoint."""


class Gr00tPolicy(Policy):
    """Policy on one REQ socket, which is replaced at the next `infer` after a timeout or a lost reply.

    Deadlines are real seconds, whatever the clock. The longer first deadline applies to the first request after
    `connect`.
    """

    def __init__(self, config: Config, robot: Robot, control_rate: float) -> None:
        self._config = config
        self._token = _token(config)
        self._request = Gr00tRequest(config, robot, control_rate)
        self.observation_eef = config.observation_eef
        self.uses_poses = config.uses_poses
        self._link = self._new_link()
        self._lock = threading.Lock()  # for the connection; held through every wait
        self._turning = threading.Lock()  # for the change between open and closed; held briefly
        self._closed = False
        self._warm = False
        self._mnp = False  # whether arrays are sent as MNP
        self._guessed = False  # whether that is a guess, because the server does not state it
        self._asked = False  # since the last reset

    def connect(self) -> PolicyInfo:
        """Connect to the server and read its modality configuration; an open connection is replaced."""
        with self._lock:
            self._warm = False
            self._link.drop()
            with self._turning:
                self._closed = False
                self._link = self._new_link()
            return self._open()

    def infer(self, observation: Observation, conditioning: Conditioning | None = None) -> ActionChunk:
        """Return the chunk for an observation; `timing` contains our `round_trip_ms`.

        Raises PolicyLostError if the server is absent or does not respond: the next call opens another connection.
        """
        if conditioning is not None:
            raise PolicyError("the GR00T protocol has no real-time chunking; choose another strategy")
        moment = self._request.model_input(observation)
        with self._lock:
            self._require_open()
            data = self._request.build(moment, observation.prompt)
            seconds = self._config.inference_deadline if self._warm else self._config.first_inference_deadline
            self._warm = self._asked = True
            started = time.monotonic()
            reply = self._act(data, seconds)
            round_trip = 1e3 * (time.monotonic() - started)
            rows = self._request.rows(reply)
        return self._config.chunk(rows, {"round_trip_ms": round_trip})

    def reset(self) -> None:
        """Drop earlier observations here and let the server drop its own; N1.5 has no endpoint for that."""
        with self._lock:
            self._request.reset()
            if not self._asked or self._config.dialect == "n1.5":
                return
            self._require_open()
            self._asked = False
            with contextlib.suppress(UnknownEndpoint):  # a server without it has nothing to forget
                self._call("reset", self._config.connect_deadline, {"options": None})

    def close(self) -> None:
        """Abort the connection and return at once; a call that waits in another thread raises PolicyError.

        That thread, or the next `connect`, drops the connection.
        """
        with self._turning:
            self._closed = True
            self._link.abort()
        if self._lock.acquire(blocking=False):  # otherwise the waiting thread drops it
            try:
                self._link.drop()
            finally:
                self._lock.release()

    def _new_link(self) -> ReqLink:
        return ReqLink(self._config.url, self._config.connect_deadline, ANSWER_LIMIT, self.address_override)

    def _require_open(self) -> None:
        if self._closed:
            raise PolicyError(f"the policy at {self._config.url} is closed; connect first")
        if not self._link.is_open:
            self._open()

    def _open(self) -> PolicyInfo:
        left = self._link.open()
        try:
            modalities = parse_modalities(self._call("get_modality_config", left))
            self._request.configure(modalities)
            self._mnp, self._guessed = bool(modalities.reads_mnp), modalities.reads_mnp is None
        except PolicyError:
            self._link.drop()
            raise
        return PolicyInfo(
            name="GR00T N1.5" if modalities.is_n15 else "GR00T",
            action_space=None,
            horizon=self._request.horizon,
            rate=self._config.action_rate,
            metadata={"modality": modalities.to_dict()},
        )

    def _act(self, data: Mapping[str, Any], seconds: float) -> Any:
        """Return the response to get_action.

        If the form of arrays was only guessed and the server fails, the other form is tried once.
        """
        until = time.monotonic() + seconds
        guessed, self._guessed = self._guessed, False
        try:
            return self._call("get_action", seconds, data)
        except ServerReportedError as error:
            if not guessed:
                raise
            self._mnp = not self._mnp
            try:
                return self._call("get_action", max(0.1, until - time.monotonic()), data)
            except ServerReportedError:  # the form was not the problem: restore it and report the first error
                self._mnp = not self._mnp
                raise error from None

    def _call(self, endpoint: str, seconds: float, data: Mapping[str, Any] | None = None) -> Any:
        """Return the response of an endpoint.

        Raises PolicyError if the server reports an error, after which it still runs.
        """
        message: dict[str, Any] = {"endpoint": endpoint}
        message |= {} if data is None else {"data": data}
        message |= {} if self._token is None else {"api_token": self._token}
        reply = self._link.exchange(arrays.pack(message, self._mnp), seconds, f"an answer to {endpoint}")
        if reply == b"ERROR":
            raise ServerReportedError(
                f"{self._config.url} answers {endpoint} with ERROR: see the server's own output"
            )
        try:
            result = arrays.unpack(reply, ANSWER_LIMIT)
        except CodecError as error:
            self._link.drop()
            raise WrongProtocolError(
                f"{self._config.url} sent an answer that is not the GR00T protocol: {error}"
            ) from error
        if isinstance(result, dict) and set(result) == {"error"}:
            raise self._error(endpoint, str(result["error"]))
        return result

    def _error(self, endpoint: str, text: str) -> PolicyError:
        url = self._config.url
        if text.startswith("Unknown endpoint"):
            return UnknownEndpoint(
                f"the policy server at {url} has no endpoint {endpoint!r} ({text}): it is of another version"
            )
        kind = RefusedError if text.startswith("Unauthorized") else ServerReportedError
        return kind(self._error_text(text))

    def _error_text(self, text: str) -> str:
        url = self._config.url
        if text.startswith("Unauthorized"):
            token_state = "a wrong one was given" if self._token else "none was given"
            return (
                f"the policy server at {url} wants an API token, {token_state} ({text}): set policy.api_token_env to "
                "the name of the environment variable that holds it"
            )
        message = f"the policy server at {url} reports an error: {error_headline(text)}"
        for pattern, allowed in _HINTS:
            if re.search(pattern, text):
                return (
                    f"{message}\nIt wants requests in another form: policy.dialect is {self._config.dialect!r}, see "
                    f"{allowed}"
                )
        if "must be a numpy array" in text:
            form, mark = ("MNP", "has") if self._mnp else ("NPY", "lacks")
            return (
                f"{message}\nIt does not read arrays in {form}, although its modality configuration {mark} N1.7's "
                "mark: it is no version of GR00T's server that is known here"
            )
        return message


def _token(config: Config) -> str | None:
    return None if config.api_token_env is None else read_secret("policy.api_token_env", config.api_token_env)
