"""Stops over REST, answered in front of Django: without waiting for the database or for a thread that serves pages.

The gateway answers e-stop, stop and halt of a station. It also answers the requests by which a page tests whether such
a stop would be answered. All other requests are passed to the application. The requests are documented in
evaweb.api.stations. The gateway runs in front of the web, and alone in the process for stops (`stop_application`).
"""

from __future__ import annotations

import asyncio
import json
import logging
import re
from collections.abc import Awaitable, Callable, Mapping, Sequence
from io import BytesIO
from typing import Any
from uuid import uuid4

from django.conf import settings
from django.core.exceptions import DisallowedHost
from django.core.handlers.asgi import ASGIRequest
from django.http.request import split_domain_port, validate_host
from django.utils import timezone
from ninja.utils import check_csrf
from pydantic import ValidationError

from evaweb.accounts import login_audit
from evaweb.accounts.client_addresses import client_address, client_key
from evaweb.accounts.cookies import MOST, cookie_values, session_keys
from evaweb.accounts.credentials import (
    RETRY_AFTER_S,
    SESSION,
    TOKEN,
    UNVERIFIED,
    Credential,
    Login,
    LookupOverload,
    Unverifiable,
    credentials,
)
from evaweb.accounts.roles import Role
from evaweb.api.auth import NOT_LOGGED_IN
from evaweb.api.responses import describe_errors
from evaweb.api.stations import HTTP_OF, CommandIn, EStopIn
from evaweb.api.tokens import UNKNOWN
from evaweb.core.errors import EvaError, NotAllowed, refusal
from evaweb.serving.headers import DEFAULT_HEADERS
from evaweb.serving.origins import is_own_origin, scheme_of
from evaweb.stations import commands, stops
from evaweb.stations import redaction as veil
from evaweb.stations.models import Station
from runtime.core.sentences import Pattern, fixed, identity
from runtime.ipc import estop_requests as pressing

log = logging.getLogger(__name__)
_UNKNOWN_TOKEN = Pattern(
    "api.door.unknown_token",
    "the token {unknown}: make one with manage.py api_token USER NAME",
)
_CSRF_CHECK_FAILED = fixed("api.door.csrf_check_failed", "CSRF check Failed")
_PATH = re.compile(r"/api/v1/stations/([^/]+)/(estop|commands)")
_LARGEST = 64 * 1024  # [bytes] of a stop; longer bodies are other commands, except e-stop presses
_ASKED = {
    ("POST", "estop"),
    ("POST", "commands"),
    ("GET", "estop"),
    ("OPTIONS", "estop"),
    ("OPTIONS", "commands"),
}
_PREFLIGHT = [  # CORS answer: what pages of the web's port may send to another port, cached for 7200 s
    (b"access-control-allow-methods", b"GET, POST"),
    (b"access-control-allow-headers", b"content-type, x-csrftoken"),
    (b"access-control-max-age", b"7200"),
]
_BUSY = (b"retry-after", b"%d" % RETRY_AFTER_S)
_MOST_TOKENS = 4  # per request
_STOP_AGAIN = Pattern("api.door.stop_again", "{why}: stop again; the e-stop works")
_STOPS_ALONE = Pattern(
    "api.door.stops_alone",
    "this process answers stop, halt and e-stop alone; the web is at port {port}",
)
_UNKNOWN_HOST = Pattern(
    "api.door.unknown_host",
    "the host {host!r} is none of this lab's: EVA_ALLOWED_HOSTS names them",
)
_Receive = Callable[[], Awaitable[Any]]
_Headers = Sequence[tuple[bytes, bytes]]
Answered = tuple[int, dict[str, Any]]


class Refused(EvaError):
    """Refusal with an HTTP status."""

    def __init__(self, sentence: str, status: int) -> None:
        super().__init__(sentence)
        self.status = status


class StopGateway:
    """ASGI application that answers stops, and passes all other requests to `application`.

    In the separate process for stops, `web_port` is the port of the web, whose pages send their stops to this process.
    In the web itself it is None.
    """

    def __init__(self, application: Callable[..., Awaitable[Any]], web_port: int | None = None) -> None:
        self._application, self._web_port = application, web_port

    async def __call__(self, scope: dict[str, Any], receive: _Receive, send: Any) -> None:
        match = _PATH.fullmatch(scope["path"])
        if match is None or (scope["method"], match[2]) not in _ASKED:
            await self._application(scope, receive, send)
            return
        presses = (scope["method"], match[2]) == ("POST", "estop")
        if not presses and self._web_port is not None and not _is_known(_header(scope, b"host")):
            await _send(send, 400, refusal(_UNKNOWN_HOST(host=_header(scope, b"host")[:200])))
            return
        body = await _body(receive)
        if body is None:
            return
        headers = list(self._cors_headers(scope))
        if scope["method"] == "OPTIONS":
            await _send(send, 200, {}, [*headers, *_PREFLIGHT])
            return
        try:
            answer = await self._answered(scope, match, body)
        except EvaError as fault:
            answer = (fault.status, refusal(str(fault)))
        except LookupOverload as fault:
            answer = (503, refusal(_STOP_AGAIN(why=fault)))
            headers.append(_BUSY)
        except Exception as fault:  # whatever fails, the caller must get an answer
            log.exception("a stop at %s was not answered", scope["path"][:200])
            answer = (500, refusal(f"{stops.HARDWARE_STOP}: {fault.__class__.__name__}"))
        if answer is None:
            await self._application(scope, _replay_body(body, receive), send)
        else:
            await _send(send, *answer, headers)

    async def _answered(self, scope: dict[str, Any], match: re.Match[str], body: bytes) -> Answered | None:
        if scope["method"] == "GET":
            return await self._ready(scope)
        return await _answered(self._as_of_here(scope), match[1], match[2], body)

    async def _ready(self, scope: dict[str, Any]) -> Answered:
        """Return the caller's name.

        This also caches the credentials, so that the first press needs no lookup.
        """
        try:
            user = (await _resolve_presser(scope)).username
        except Unverifiable:
            user = UNVERIFIED
        return 200, {"user": user, "alone": self._web_port is not None}

    def _cors_headers(self, scope: dict[str, Any]) -> _Headers:
        """Return the CORS headers that allow only our own pages to read the answer."""
        origin, host = _header(scope, b"origin"), _header(scope, b"host")
        if not _is_known(host) or not is_own_origin(origin, host, scheme_of(scope), self._web_port):
            return [(b"vary", b"origin")]
        return [
            (b"vary", b"origin"),
            (b"access-control-allow-origin", origin.encode("latin-1")),
            (b"access-control-allow-credentials", b"true"),
        ]

    def _as_of_here(self, scope: dict[str, Any]) -> dict[str, Any]:
        """Return `scope`; if one of the web's pages sent the request, its Origin header is replaced by this server's
        origin.

        Django's CSRF check accepts only one origin, that of the port where the request arrives.
        """
        host = _header(scope, b"host")
        origin = _header(scope, b"origin")
        if self._web_port is None or not is_own_origin(origin, host, scheme_of(scope), self._web_port):
            return scope
        further = [(name, value) for name, value in scope["headers"] if name != b"origin"]
        own_origin = f"{scope['scheme']}://{host}".encode("latin-1")
        return {**scope, "headers": [*further, (b"origin", own_origin)]}


def stop_application(web_port: int) -> StopGateway:
    """Return the application of the process for stops, for pages of the web at that port."""
    answer = refusal(_STOPS_ALONE(port=web_port))

    async def nothing_else(scope: dict[str, Any], receive: _Receive, send: Any) -> None:
        await _send(send, 404, answer)

    return StopGateway(nothing_else, web_port)


async def _answered(scope: dict[str, Any], station: str, action: str, body: bytes) -> Answered | None:
    """Carry out a stopping command, and return the HTTP status and the answer.

    Return None for a command that is no e-stop, stop or halt.
    """
    if action == "estop":
        return await _estop(scope, station, _parse_body(body))
    press = pressing.parse_json_press(body, "kind")
    if press is not None:
        return await _estop(scope, station, press)
    fields = _parse_body(body) if len(body) <= _LARGEST else {}
    return await _stop(scope, station, fields, body) if fields.get("kind") in commands.STOPPING else None


async def _estop(scope: dict[str, Any], station: str, fields: Mapping[str, Any]) -> Answered:
    parsed, at = EStopIn(uuid=fields.get("uuid"), why=pressing.json_reason(fields)), timezone.now()
    unverified, username, user = "", UNVERIFIED, None
    try:
        login = await _resolve_presser(scope)
    except (Unverifiable, LookupOverload) as fault:  # overload must not refuse an e-stop
        unverified = str(fault)
        login_audit.estop_unverified(station, fault)
    else:
        username, user = login.username, login.account
    uuid = parsed.uuid or uuid4()
    press = stops.press_estop(station=station, username=username, why=parsed.why, uuid=uuid)
    answer = await asyncio.wrap_future(press)
    place = Station(name=station)
    commands.record_estop(
        user=user, station=place, why=parsed.why, uuid=uuid, answer=answer, at=at, unverified=unverified
    )
    return HTTP_OF[answer.status], _answer_body(str(uuid), answer, answer.data)


async def _stop(scope: dict[str, Any], station: str, fields: Mapping[str, Any], body: bytes) -> Answered:
    at = timezone.now()
    kind, login = await _resolve_stopper(scope)
    if kind == SESSION:
        _require_csrf(scope, body)
    if login.role is Role.VIEWER:
        raise NotAllowed(stops.refused_to_a_viewer(login.username))
    try:
        parsed = CommandIn(**fields)
    except ValidationError as fault:
        raise Refused(describe_errors(fault.errors(include_url=False)), 422) from None
    named = {"kind": parsed.kind, "page": parsed.page, "epoch": parsed.epoch, "uuid": parsed.uuid}
    order = stops.stop_command(username=login.username, **named)
    answer = await asyncio.wrap_future(stops.request_stop(order, station))
    commands.record_stop(user=login.account, station=Station(name=station), answer=answer, at=at, **named)
    return HTTP_OF[answer.status], _answer_body(str(parsed.uuid), answer, veil.redact_answer(answer.data))


def _answer_body(uuid: str, answer: stops.Answer, data: Mapping[str, Any]) -> dict[str, Any]:
    fields = {"status": answer.status.value, "reason": answer.reason, **identity(answer.reason)}
    return {"uuid": uuid, **fields, "allowed": answer.allowed, "data": data}


async def _resolve_presser(scope: dict[str, Any]) -> Login:
    """Return the login of the client that presses the e-stop, by any of its credentials.

    Raises:
        Refused: If the credentials are missing or unknown.
        Unverifiable: If the database does not answer.
        LookupOverload: If lookups of this client are dropped or wait too long.
    """
    candidates = _credentials(scope)
    login = await credentials.resolve_presser(candidates, client_key(scope))
    if login is None:
        raise _unknown_credentials(candidates, scope)
    return login


async def _resolve_stopper(scope: dict[str, Any]) -> tuple[str, Login]:
    """Return the kind of credential and the login of the client that sends a stop or halt.

    Raises:
        Refused: If the credentials are missing, unknown, or cannot be verified.
        LookupOverload: If lookups of this client are dropped or wait too long.
    """
    candidates = _credentials(scope)
    try:
        stopper = await credentials.resolve_stopper(candidates, client_key(scope))
    except Unverifiable as fault:
        raise Refused(stops.UNKNOWN_STOPPER(why=fault), 503) from None
    if stopper is None:
        raise _unknown_credentials(candidates, scope)
    return stopper


def _unknown_credentials(candidates: list[Credential], scope: dict[str, Any]) -> Refused:
    if all(kind != TOKEN for kind, _ in candidates):
        return Refused(NOT_LOGGED_IN, 401)
    login_audit.log_token_refused(client_address(ASGIRequest(scope, BytesIO())), UNKNOWN)
    return Refused(_UNKNOWN_TOKEN(unknown=UNKNOWN), 401)


def _credentials(scope: dict[str, Any]) -> list[Credential]:
    """Return (kind, secret) of all credentials, tokens first; a proxy's header or a foreign cookie must not
    hide a session.
    """
    candidates = []
    for header in _headers(scope, b"authorization")[:_MOST_TOKENS]:
        scheme, _, secret = header.strip().partition(" ")
        candidates.append((TOKEN, secret.strip() if scheme.lower() == "bearer" else header))
    candidates += [(SESSION, key) for key in session_keys(_headers(scope, b"cookie"))]
    if not candidates:
        raise Refused(NOT_LOGGED_IN, 401)
    return candidates


def _require_csrf(scope: dict[str, Any], body: bytes) -> None:
    """Check CSRF; of several cookies any valid one is accepted."""
    name = settings.CSRF_COOKIE_NAME
    try:
        for token in cookie_values(_headers(scope, b"cookie"), name)[:MOST] or [""]:
            request = ASGIRequest(scope, BytesIO(body))
            request.COOKIES[name] = token
            if check_csrf(request) is None:
                return
    except DisallowedHost as fault:
        raise Refused(str(fault), 400) from None
    raise Refused(_CSRF_CHECK_FAILED, 403)


def _parse_body(body: bytes) -> dict[str, Any]:
    try:
        fields = json.loads(body)
    except (ValueError, RecursionError):
        return {}
    return fields if isinstance(fields, dict) else {}


async def _body(receive: _Receive) -> bytes | None:
    """Return the complete body, which the server has already received; None if the client has disconnected."""
    parts, more = [], True
    while more:
        message = await receive()
        if message["type"] == "http.disconnect":
            return None
        parts.append(message.get("body", b""))
        more = message.get("more_body", False)
    return b"".join(parts)


def _replay_body(body: bytes, receive: _Receive) -> _Receive:
    """Return a receiver that repeats the body that was read, then continues with `receive`."""
    first = [{"type": "http.request", "body": body, "more_body": False}]

    async def read() -> Any:
        return first.pop() if first else await receive()

    return read


def _is_known(host: str) -> bool:
    """Return True if `host` is a name of this lab.

    A request with another host name may come from a page of someone else whose domain leads to this server. An e-stop
    is never refused because of the host name.
    """
    return validate_host(split_domain_port(host)[0], settings.ALLOWED_HOSTS)


def _header(scope: dict[str, Any], key: bytes) -> str:
    return next(iter(_headers(scope, key)), "")


def _headers(scope: dict[str, Any], key: bytes) -> list[str]:
    return [value.decode("latin-1") for name, value in scope["headers"] if name == key]


async def _send(send: Any, status: int, answer: Mapping[str, Any], more: _Headers = ()) -> None:
    body = json.dumps(answer).encode()
    headers = [(b"content-type", b"application/json; charset=utf-8"), (b"content-length", b"%d" % len(body))]
    headers += [*DEFAULT_HEADERS, *more]
    await send({"type": "http.response.start", "status": status, "headers": headers})
    await send({"type": "http.response.body", "body": body})
