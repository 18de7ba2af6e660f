"""Health check of a policy server through its HTTP page, which some serve on the websocket's port."""

from __future__ import annotations

import contextlib
import http
import re
import ssl
import time
from collections.abc import Mapping
from urllib.parse import urlsplit

from runtime.core.errors import PolicyLostError, PolicyTimeout, RefusedError, TlsError, WrongProtocolError
from runtime.policies.connection import Dial, open_connection

_STATUS = re.compile(rb"HTTP/1\.[01] ([0-9]{3})([^\r\n]*)\r?\n")
_LONGEST = 4096  # longest first line [bytes]


def require_healthy(
    url: str, path: str, headers: Mapping[str, str], seconds: float, dial: Dial | None = None
) -> None:
    """GET `path` from the host and port of the websocket `url` (with TLS for wss); return only if the status is 200.

    `dial` returns the host and port to connect to, if they differ from those of the url.

    Raises:
        PolicyLostError: There is no response within `seconds`, or the server reports that it is not ready (HTTP 5xx).
        PolicyError: Any other response: another server listens there, or the path is wrong.
    """
    try:
        status, reason = _get_status(url, path, headers, time.monotonic() + seconds, seconds, dial)
    except TimeoutError as error:
        raise PolicyTimeout(
            f"{url}: {path} gave no answer within {seconds:g} s: the server is stuck, or no web server"
        ) from error
    except ssl.SSLError as error:
        raise TlsError(
            f"{url}: no encrypted connection ({error}): check host, port and certificate, or use ws://"
        ) from error
    except OSError as error:
        raise PolicyLostError(
            f"the connection to {url} ended while {path} was asked for ({error}): see that the policy server runs"
        ) from error
    if status >= 500:
        raise PolicyLostError(f"the policy server at {url} is not well: {path} says HTTP {status} {reason}")
    if status in (http.HTTPStatus.UNAUTHORIZED, http.HTTPStatus.FORBIDDEN):
        raise RefusedError(
            f"{url}: {path} says HTTP {status} {reason}: it wants an API key; policy.api_key_env names the "
            "environment variable that holds it"
        )
    if status != http.HTTPStatus.OK:
        raise WrongProtocolError(
            f"{url}: {path} says HTTP {status} {reason}, expected 200: another server listens there, or "
            "policy.health_path is wrong"
        )


def _get_status(
    url: str, path: str, headers: Mapping[str, str], deadline: float, seconds: float, dial: Dial | None
) -> tuple[int, str]:
    """Return the HTTP status and its reason phrase.

    Raises TimeoutError at the deadline (monotonic clock), even if single bytes keep arriving.
    """
    place = urlsplit(url)
    secure = place.scheme == "wss"
    host, port = place.hostname or "", place.port or (443 if secure else 80)
    lines = [f"GET {path} HTTP/1.1", f"Host: {place.netloc}", "Connection: close"]
    lines += [f"{name}: {value}" for name, value in headers.items()]
    with contextlib.ExitStack() as stack:
        address = dial() if dial else (host, port)
        wire = stack.enter_context(open_connection(url, *address, deadline, seconds, lambda: None))
        wire.settimeout(_left(deadline))
        if secure:
            wire = stack.enter_context(ssl.create_default_context().wrap_socket(wire, server_hostname=host))
        wire.sendall("\r\n".join([*lines, "", ""]).encode("latin-1"))
        answer = b""
        while b"\n" not in answer and len(answer) < _LONGEST:
            wire.settimeout(_left(deadline))
            piece = wire.recv(_LONGEST)
            if not piece:
                break
            answer += piece
    if not answer:
        raise PolicyLostError(
            f"{url}: {path} gave no answer, the connection was closed at once: see that the policy server runs"
        )
    status = _STATUS.match(answer)
    if status is None:
        raise WrongProtocolError(
            f"{url}: a server listens there that is not a web server, it answers {answer[:40]!r}: check host, "
            "port and policy.kind"
        )
    return int(status[1]), status[2].decode("latin-1").strip()


def _left(deadline: float) -> float:
    left = deadline - time.monotonic()
    if left <= 0:
        raise TimeoutError("the deadline is over")
    return left
