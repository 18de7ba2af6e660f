"""gRPC channel to LeRobot's policy server: every call has a deadline and can be aborted by another thread."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

from runtime.core.errors import (
    ConfigurationError,
    PolicyDisconnected,
    PolicyError,
    PolicyTimeout,
    RefusedError,
    ServerReportedError,
    WrongProtocolError,
)
from runtime.policies.connection import Dial, open_connection
from runtime.policies.websocket_link import error_headline

if TYPE_CHECKING:
    import grpc

_LARGEST_MESSAGE = 4 * 1024 * 1024  # [bytes]; largest message that the server accepts


class Channel:
    """gRPC channel that can be opened again until it is aborted.

    `abort` may be called by any thread, all other methods by one thread at a time. Responses of more than `limit` bytes
    are refused. `dial` returns the host and port to connect to, if they differ from those of the url. Raises
    ConfigurationError if gRPC is not installed.
    """

    def __init__(self, url: str, connect_deadline: float, limit: int, dial: Dial | None = None) -> None:
        _grpc()
        self._url = url
        self._dial = dial
        self._connect_deadline = connect_deadline
        self._limit = limit
        self._channel: grpc.Channel | None = None
        self._call: Any = None  # present call
        self._turning = threading.Lock()  # protects the present call; held briefly
        self._aborted = False

    @property
    def is_open(self) -> bool:
        """True if there is a channel; the peer may have left since."""
        return self._channel is not None

    def open(self) -> float:
        """Check that a server listens, and open a channel; return the time left until the connect deadline [s]."""
        self.drop()
        deadline = time.monotonic() + self._connect_deadline
        parts = urlsplit(self._url)
        host, port = self._dial() if self._dial else (parts.hostname or "", parts.port or 0)
        seconds = self._connect_deadline
        open_connection(self._url, host, port, deadline, seconds, self._require_not_aborted).close()
        self._channel = _grpc().insecure_channel(
            f"[{host}]:{port}" if ":" in host else f"{host}:{port}",
            options=[
                ("grpc.max_receive_message_length", self._limit),
                ("grpc.max_send_message_length", _LARGEST_MESSAGE),
                ("grpc.enable_http_proxy", 0),
                ("grpc.enable_retries", 0),  # a retry would send an observation twice
                ("grpc.use_local_subchannel_pool", 1),  # a dropped connection is never reused
            ],
        )
        return max(0.0, deadline - time.monotonic())

    def call(self, method: str, request: bytes | Iterable[bytes], seconds: float) -> bytes:
        """Send one message or several; return the response as bytes.

        Raises:
            PolicyTimeout: No response within `seconds` [s]; the channel is dropped.
            PolicyDisconnected: The server closed the connection; the channel is dropped.
            ServerReportedError: The server's code raised an exception; the server still runs.
        """
        channel = self._channel
        if channel is None:
            raise PolicyError(f"there is no connection to {self._url}; connect first")
        started: Any
        if isinstance(request, bytes):
            started = channel.unary_unary(method).future
        else:
            started, request = channel.stream_unary(method).future, iter(request)
        with self._turning:
            self._require_not_aborted()
            self._call = started(request, timeout=seconds)
        try:
            answer: bytes = self._call.result()
        except _grpc().FutureCancelledError as error:
            self.drop()
            raise PolicyError(f"the connection to {self._url} was closed from our side") from error
        except _grpc().RpcError as error:
            raise self._to_policy_error(error, method, seconds) from error
        finally:
            self._call = None
        return answer

    def abort(self) -> None:
        """Make calls that wait in another thread raise PolicyError, now and later."""
        with self._turning:
            self._aborted = True
            if self._call is not None:
                self._call.cancel()

    def drop(self) -> None:
        """Close the channel and end its pending call. Safe to call twice."""
        channel, self._channel = self._channel, None
        if channel is not None:
            channel.close()

    def _require_not_aborted(self) -> None:
        if self._aborted:
            raise PolicyError(f"the connection to {self._url} was closed from our side")

    def _to_policy_error(self, error: Any, method: str, seconds: float) -> PolicyError:
        """Return the PolicyError for an error of gRPC; unless the server reported it, drop the channel."""
        code, details = error.code(), str(error.details())
        codes, name = _grpc().StatusCode, method.rpartition("/")[2]
        if code is codes.UNKNOWN:  # the server's own code failed; it continues to serve
            text = details.removeprefix("Exception calling application: ")
            return ServerReportedError(
                f"the policy server at {self._url} reports an error in {name}: {error_headline(text)}"
            )
        self.drop()
        if self._aborted:
            return PolicyError(f"the connection to {self._url} was closed from our side")
        if code is codes.DEADLINE_EXCEEDED:
            return PolicyTimeout(
                f"{self._url} did not answer {name} within {seconds:.3g} s; the connection is dropped"
            )
        if code is codes.UNIMPLEMENTED:
            return WrongProtocolError(
                f"{self._url} is a gRPC server without LeRobot's {name} ({details}): check host, port and policy.kind"
            )
        if code is codes.RESOURCE_EXHAUSTED:
            return PolicyError(f"{self._url} and a message that is too large for {name}: {details}")
        if code is codes.UNAVAILABLE and _is_foreign(details):
            return WrongProtocolError(
                f"what listens at {self._url} does not speak gRPC ({details}): check host, port and policy.kind"
            )
        if code is codes.UNAVAILABLE:
            return PolicyDisconnected(
                f"the policy server at {self._url} closed the connection ({details}): "
                "see that it runs, and speaks gRPC: a server of another kind hangs up too; check policy.kind"
            )
        refusal = f"the policy server at {self._url} refuses {name}: {code.name}, {details}"
        if code in (codes.UNAUTHENTICATED, codes.PERMISSION_DENIED):
            return RefusedError(refusal)
        return ServerReportedError(refusal)


def _is_foreign(details: str) -> bool:
    """Return True if the details of a gRPC error show that the peer does not use HTTP/2."""
    return "Failed parsing HTTP/2" in details or "http1.x" in details


def _grpc() -> Any:
    try:
        import grpc
    except ImportError as error:
        raise ConfigurationError(
            'policy.kind = "lerobot" needs the package grpcio, which is not installed: '
            "pip install 'eva-web[lerobot-grpc]'"
        ) from error
    return grpc
