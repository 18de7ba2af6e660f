"""Common parts of websocket policies: deadlines, one request at a time, metadata in the first frame."""

from __future__ import annotations

import logging
import threading
import time
from abc import abstractmethod
from typing import Annotated, Any

from pydantic import Field

from runtime.core import msgpack_arrays
from runtime.core.environment import read_secret
from runtime.core.errors import CodecError, PolicyError, WrongProtocolError
from runtime.core.host_references import Variable
from runtime.core.sentences import Pattern, fixed
from runtime.policies.base import Policy, PolicyInfo
from runtime.policies.health import require_healthy
from runtime.policies.response_delay import ResponseDelaySettings
from runtime.policies.tunnel.settings import TunnelSettings
from runtime.policies.websocket_link import ANSWER_LIMIT, WebsocketLink

_POLICY_CLOSED = Pattern("policy.server.policy_closed", "the policy at {url} is closed; connect first")
_NO_MAP = Pattern("policy.server.no_map", "{url} sent {what} that is a {kind}; expected a map")
_OTHER_PROTOCOL = Pattern(
    "policy.server.other_protocol",
    "{url} sent {what} that is not the {protocol} protocol: {error}",
)

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]

log = logging.getLogger(__name__)
_REPEATED = fixed("policy.server.repeated", "the answer is byte for byte the one before, to another request")


class ServerSettings(ResponseDelaySettings):
    """Address and deadlines of a policy server on a websocket."""

    url: Annotated[str, Field(pattern=r"^wss?://.+")] = "ws://127.0.0.1:8000"
    """Address of the server: ws:// or wss://, with a path if it has one."""
    api_key_env: Variable | None = None
    """Environment variable with the API key; the key itself would be copied to every recording's manifest."""
    health_path: Annotated[str, Field(pattern=r"^/")] | None = None
    """Path at which the same port answers an HTTP GET with status 200 while the server is healthy (openpi: "/healthz");
    requested before each connection. Absent: no health check."""
    tunnel: TunnelSettings | None = None
    """SSH tunnel to the server; `url` is then resolved at the tunnel's far end."""
    connect_deadline: Positive = 5.0
    """Longest time for connecting and for the server's metadata [s]."""
    first_inference_deadline: Positive = 120.0
    """Longest time for the first response after set-up [s]; the server may have to compile its model."""
    inference_deadline: Positive = 2.0
    """Longest time for every later response, also after a reconnection [s]; beyond it the connection is dropped."""


class WebsocketPolicy(Policy):
    """Policy on one connection, which is dropped after a timeout; the next `infer` opens another.

    Deadlines are real seconds, whatever the clock, because a remote server does not know a virtual one. The longer
    first deadline applies to the first request after `connect`. Later no `infer` takes longer than the deadlines of
    connection and inference together, so that a server that does not respond after a restart, or compiles again, is
    detected quickly.
    """

    PROTOCOL = ""  # name in messages

    def __init__(self, server: ServerSettings) -> None:
        self._server = server
        self._headers = headers(server)
        self._link = self._new_link()
        self._lock = threading.Lock()  # for the connection; held through every wait
        self._turning = threading.Lock()  # for the change between open and closed; held briefly
        self._closed = False
        self._warm = False
        self._last: tuple[bytes, bytes] | None = None  # last request and its response
        self._excused: set[str] = set()  # suspicions that another connection did not confirm

    @abstractmethod
    def _check_metadata(self, metadata: dict[str, Any]) -> PolicyInfo:
        """Check the server's metadata and return the policy's description.

        Raises PolicyError if it is the wrong server; the connection is then dropped.
        """

    def connect(self) -> PolicyInfo:
        """Connect to the server and read its metadata; an open connection is replaced."""
        with self._lock:
            self._warm, self._last = False, None
            self._excused.clear()
            self._leave()
            with self._turning:
                self._closed = False
                self._link = self._new_link()
            return self._open()

    def close(self) -> None:
        """Abort the connection and return at once; a call that waits in another thread raises PolicyError.

        That thread, or the next `connect`, drops the connection.
        """
        with self._turning:
            self._closed = True
            # With a free lock no call waits, so the server gets a close frame; otherwise `abort` cuts the call.
            if self._lock.acquire(blocking=False):
                try:
                    self._leave()
                finally:
                    self._lock.release()
            self._link.abort()

    def _leave(self) -> None:
        """Close the connection, of which the server is informed."""
        self._link.close_gracefully()

    def _new_link(self) -> WebsocketLink:
        return WebsocketLink(
            self._server.url, self._headers, self._server.connect_deadline, self.address_override
        )

    def _require_open(self) -> None:
        """Open a connection if there is none. Raises PolicyError after `close`."""
        if self._closed:
            raise PolicyError(_POLICY_CLOSED(url=self._server.url))
        if not self._link.is_open:
            self._open()

    def _reopen(self) -> None:
        """Open a connection if there is none, or if the server closed it. Raises PolicyError after `close`."""
        if self._link.closed_by_peer:
            self._link.close_gracefully()
        self._require_open()

    def _open(self) -> PolicyInfo:
        if self._server.health_path is not None:
            deadline = self._server.connect_deadline
            require_healthy(
                self._server.url, self._server.health_path, self._headers, deadline, self.address_override
            )
        self._last = None  # the first response on a connection belongs to its first request
        try:
            return self._check_metadata(self._read_metadata())
        except PolicyError:
            self._link.close_gracefully()
            raise

    def _read_metadata(self) -> dict[str, Any]:
        """Open the link and return the server's metadata, which most servers send first."""
        return self._decode(self._link.open(), "metadata")

    def _next_deadline(self) -> float:
        """Return the time allowed for the next inference [s]; the first after `connect` may take longer."""
        seconds = self._server.inference_deadline if self._warm else self._server.first_inference_deadline
        self._warm = True
        return seconds

    def _exchange(self, request: bytes) -> tuple[bytes, float]:
        """Return the response to `request` and its round trip [ms].

        If a response may belong to an earlier request, the request is sent once more over a new connection, whose first
        response cannot be to an earlier one. If the server responds in the same way there, the reason for the suspicion
        is ignored from then on.
        """
        seconds = self._next_deadline()
        started = time.monotonic()
        answer, took = self._exchange_once(request, seconds)
        doubted, doubt = answer, self._mismatch_reason(request, answer, took)
        if doubt and doubt not in self._excused:
            log.warning("%s: %s: it is asked again over another connection", self._server.url, doubt)
            self._link.close_gracefully()
            self._require_open()
            answer, took = self._exchange_once(request, max(1e-3, seconds - (time.monotonic() - started)))
            if answer == doubted or self._mismatch_reason(request, answer, took) == doubt:
                self._excused.add(doubt)
        elif not doubt:
            self._excused.discard(_REPEATED)  # its responses do differ
        self._last = request, answer
        return answer, took

    def _exchange_once(self, request: bytes, seconds: float) -> tuple[bytes, float]:
        started = time.monotonic()
        answer = self._link.exchange(request, seconds)
        return answer, 1e3 * (time.monotonic() - started)

    def _mismatch_reason(self, request: bytes, answer: bytes, took: float) -> str:
        """Return the reason to suspect that this response belongs to an earlier request, "" if there is none."""
        if self._last is not None and self._last[0] != request and self._last[1] == answer:
            return _REPEATED
        return ""

    def _decode(self, payload: bytes, label: str) -> dict[str, Any]:
        message = self._value(payload, label)
        if not isinstance(message, dict):
            self._link.close_gracefully()
            raise WrongProtocolError(_NO_MAP(url=self._server.url, what=label, kind=type(message).__name__))
        return message

    def _value(self, payload: bytes, label: str) -> Any:
        try:
            return self._unpack(payload)
        except CodecError as error:
            self._link.close_gracefully()
            raise WrongProtocolError(
                _OTHER_PROTOCOL(url=self._server.url, what=label, protocol=self.PROTOCOL, error=error)
            ) from error

    def _unpack(self, payload: bytes) -> Any:
        """Return the value of one message. Raises CodecError."""
        return msgpack_arrays.unpack(payload, ANSWER_LIMIT)


def headers(server: ServerSettings) -> dict[str, str]:
    """Return the request headers. Raises ConfigurationError if the named API key is not in the environment."""
    if server.api_key_env is None:
        return {}
    return {"Authorization": f"Api-Key {read_secret('policy.api_key_env', server.api_key_env)}"}
