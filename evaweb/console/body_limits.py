"""Limits of request bodies, enforced before a view is called.

Twisted passes a request to Daphne, and Daphne to Django, after the whole body has arrived: too late for a view to
refuse it. Therefore a long body is refused here, by the length in its headers or as soon as it exceeds the limit, and
never stored.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any
from urllib.parse import unquote_to_bytes

import daphne.server  # noqa: F401  first: it decides which reactor there is

# isort: split
from daphne.http_protocol import WebRequest
from django.db import connections
from twisted.internet import reactor
from twisted.internet.threads import deferToThread

from evaweb.accounts.cookies import session_keys
from evaweb.accounts.roles import Role
from evaweb.console.early_refusals import is_stop, raw_refusal, refusal
from evaweb.console.viewers import current_role
from evaweb.plans.references import LARGEST
from evaweb.results.crates.limits import MOST_UPLOAD
from evaweb.serving.body_limits import body_limit_for
from runtime.ipc import estop_requests as pressing

log = logging.getLogger(__name__)
ANONYMOUS_LIMIT = 64 * 1024  # [bytes] a login, or an e-stop press
USER_LIMIT = 2 * 1024 * 1024  # [bytes] a form; for REST see `body_limit_for`
_UPLOADS = {  # files from administrators
    b"/admin/plans/plan/import/": LARGEST + ANONYMOUS_LIMIT,
    b"/result/crates/import": MOST_UPLOAD + ANONYMOUS_LIMIT,
}
_ESTOP = re.compile(rb"/api/v1/stations/[^/]+/estop")
_REST = b"/api/"
_LINGER_S = (
    5.0  # time in which a refused client's further data is read and discarded, so that it reads the answer
)


@dataclass(frozen=True, slots=True)
class BodyBound:
    """Limit of a request body, and the refusal of a longer one.

    Attributes:
        largest: Limit [bytes].
        status: HTTP status of the refusal. 0 means no refusal: a longer body is dropped and the request continues.
        sentence: Message of the refusal.
        sure: Limit [bytes] for users other than administrators, and for bodies of unknown length. To find out who
            sends a longer body, the sessions in `keys` are looked up in order. The sender is the user of the first
            session that has a user.
        keys: Keys of the sessions that the request names.
        may_press: Whether the request may be an e-stop press. If the first `largest` bytes of a longer body are indeed
            a press, the rest of the body is dropped, and the body is not refused.
    """

    largest: int
    status: int
    sentence: str
    sure: int
    keys: tuple[str, ...] = ()
    may_press: bool = False


def body_bound(path: bytes, cookies: Iterable[bytes], authorized: bool) -> BodyBound:
    """Return the bound for a request with these headers; the validity of its session or token is not checked yet."""
    if _ESTOP.fullmatch(path):
        return BodyBound(ANONYMOUS_LIMIT, 0, "", ANONYMOUS_LIMIT)
    keys = tuple(session_keys(cookie.decode("latin-1") for cookie in cookies))
    if keys or authorized:
        sure = body_limit_for(path.decode("latin-1")).largest if path.startswith(_REST) else USER_LIMIT
        largest = _UPLOADS.get(path, sure) if keys else sure
        sentence = f"the body is too long; allowed here: {largest} bytes"
        return BodyBound(largest, 413, sentence, sure, keys, is_stop(path))
    allowed = f"the body is too long; allowed without a login: {ANONYMOUS_LIMIT} bytes"
    return BodyBound(ANONYMOUS_LIMIT, 401 if path.startswith(_REST) else 413, allowed, ANONYMOUS_LIMIT)


def stop_bound_of(path: bytes, cookies: Iterable[bytes], authorized: bool) -> BodyBound:
    """Return the bound for a request to the process for stops, which accepts no long bodies."""
    if is_stop(path):
        return body_bound(path, (), True)
    return BodyBound(
        ANONYMOUS_LIMIT, 413, f"the body is too long; allowed here: {ANONYMOUS_LIMIT} bytes", ANONYMOUS_LIMIT
    )


class BoundedRequest(WebRequest):
    """Daphne's request, with a limit on its body.

    An e-stop is also executed if the connection is lost before the end of its body: station and credentials are in the
    headers.
    """

    bound_of = staticmethod(body_bound)
    _bound: BodyBound
    _whole = False
    _got = 0
    _over = False

    def __init__(self, *given: Any, **named: Any) -> None:
        """Create the request without Twisted's parsing of forms, which would refuse unreadable forms before
        the view can.
        """
        super().__init__(*given, parsePOSTFormSubmission=False, **named)

    def gotLength(self, length: int | None) -> None:
        """Check the length that the headers declare; refuse a body that is too long, or look up its sender."""
        self._path = unquote_to_bytes(self.channel._path.partition(b"?")[0])
        headers = self.requestHeaders
        cookies = headers.getRawHeaders(b"cookie", [])
        bound = self.bound_of(self._path, cookies, headers.hasHeader(b"authorization"))
        self._bound = bound if length is not None else replace(bound, largest=bound.sure)
        over = length is not None and length > bound.largest
        super().gotLength(bound.largest if over and bound.may_press else 0 if over else length)
        if over and not bound.may_press:
            self._leave_out()
        elif length is not None and length > bound.sure and not bound.may_press:
            self._look_up_sender(bound.keys)

    def handleContentChunk(self, data: bytes) -> None:
        """Receive a part of the body."""
        room = self._bound.largest - self._got
        self._got += len(data)
        if self._over:
            return
        if len(data) <= room or self._bound.may_press:
            super().handleContentChunk(data[:room])
        if len(data) > room:
            self._too_long()

    def requestReceived(self, command: bytes, path: bytes, version: bytes) -> None:
        """Pass the complete request to the application, unless it was refused already."""
        self._whole = True
        if not (self._over and self._bound.status):
            super().requestReceived(command, path, version)

    def basic_error(self, status: int, status_text: bytes, body: str) -> None:
        """Send Daphne's own answers, to invalid headers and addresses and after faults, in our format."""
        headers, content = refusal(status, body, self.path or b"")
        self.handle_reply({"type": "http.response.start", "status": status, "headers": headers})
        self.handle_reply({"type": "http.response.body", "body": content})

    def connectionLost(self, reason: object) -> None:
        """End the request because its connection is lost; first execute it if it is an e-stop with complete headers."""
        headed = not self._whole and hasattr(self, "_bound")
        presses = headed and (_ESTOP.fullmatch(self._path) or (self._over and not self._bound.status))
        if presses and self.channel._command == b"POST":
            self.requestReceived(self.channel._command, self.channel._path, self.channel._version)
        super().connectionLost(reason)

    def admitted(self) -> None:
        """Do nothing; a subclass overrides this to react when a client is allowed to send a long body.

        Such a body may take time to arrive.
        """

    def _too_long(self) -> None:
        if self._bound.may_press:
            self.content.seek(0)
            if pressing.parse_json_press(self.content.read(), "kind") is not None:
                self._bound, self._over = replace(self._bound, status=0), True
                return
        self._leave_out()

    def _leave_out(self) -> None:
        self._over = True
        self.content.seek(0)
        self.content.truncate()
        self.requestHeaders.setRawHeaders(b"content-length", [b"0"])
        if self._bound.status:
            self.requestHeaders.removeHeader(b"expect")
            self._refuse(self.channel.transport)

    def _look_up_sender(self, keys: tuple[str, ...]) -> None:
        """Pause reading until the database has named the user of the session."""
        self.channel.transport.pauseProducing()
        deferToThread(_role, keys).addCallback(self._known).addErrback(self._unknown)

    def _known(self, role: Role | None) -> None:
        sentence = (
            "log in first"
            if role is None
            else f"you are {role.with_article}; this needs {Role.ADMIN.with_article}"
        )
        self._go_on(0 if role is Role.ADMIN else 403, sentence)

    def _unknown(self, failure: Any) -> None:
        log.error("the database does not say who sends %s: %s", self._path, failure.value)
        self._go_on(503, "the database does not answer: try again")

    def _go_on(self, status: int, sentence: str) -> None:
        if self._disconnected:
            return
        if status:
            self._bound = replace(self._bound, status=status, sentence=sentence)
            self._leave_out()
        else:
            self.admitted()
        self.channel.transport.resumeProducing()

    def _refuse(self, transport: Any) -> None:
        transport.write(raw_refusal(self._bound.status, self._bound.sentence, self._path))
        transport.loseWriteConnection()
        events: Any = reactor
        events.callLater(_LINGER_S, transport.abortConnection)


def _role(keys: tuple[str, ...]) -> Role | None:
    try:
        return next(filter(None, map(current_role, keys)), None)
    finally:
        connections.close_all()
