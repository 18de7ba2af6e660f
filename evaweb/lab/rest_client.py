"""Client in Python that logs in, uses REST and watches over the websocket, exactly like a browser."""

from __future__ import annotations

import json
import re
import threading
import time
import uuid
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from http.client import InvalidURL
from http.cookiejar import CookieJar
from typing import Any
from urllib.error import HTTPError, URLError
from urllib.parse import urlencode, urlsplit
from urllib.request import (
    HTTPCookieProcessor,
    HTTPRedirectHandler,
    OpenerDirector,
    ProxyHandler,
    Request,
    build_opener,
)

from websockets.exceptions import ConnectionClosed, InvalidHandshake
from websockets.sync.client import ClientConnection, connect

from evaweb.core.binary_frames import decode
from evaweb.core.errors import EvaError
from evaweb.lab.stall_detection import DemoFailed, NoReply, ProgressTimeout

_RENEW_S = 1.0
_LOOK_S = 1.0  # period of progress checks
_TIMEOUT_S = 30.0
_LARGEST_FRAME = 16 * 1024 * 1024
_TOKEN = re.compile(r'name="csrfmiddlewaretoken" value="([^"]+)"')


class StateTimeout(DemoFailed):
    """Error if no state satisfied the condition in time."""


class _NoRedirect(HTTPRedirectHandler):
    """Redirect handler that stops: a successful login answers with a redirect, a failed one with the form."""

    def redirect_request(self, *args: Any, **kwargs: Any) -> None:
        return None


class RestClient:
    """Logged-in session over HTTP."""

    def __init__(self, url: str) -> None:
        self.url = url.rstrip("/")
        self._cookies = CookieJar()
        self._opener: OpenerDirector = build_opener(
            ProxyHandler({}),  # the lab is on this machine or in the local network
            HTTPCookieProcessor(self._cookies),
            _NoRedirect(),
        )

    def login(self, username: str, password: str) -> None:
        """Log in with the form.

        Raises:
            DemoFailed: If name or password is wrong.
        """
        self.username = username
        page = self._open(self._request("login/")).decode()
        match = _TOKEN.search(page)
        if not match:
            raise DemoFailed(f"{self.url}/login/ has no login form")
        form = {"username": username, "password": password, "csrfmiddlewaretoken": match[1]}
        request = Request(f"{self.url}/login/", urlencode(form).encode(), {"Referer": f"{self.url}/login/"})
        try:
            self._opener.open(request, timeout=_TIMEOUT_S).close()
        except HTTPError as answer:
            answer.close()
            if answer.code == 302:
                return
            raise DemoFailed(f"login as {username}: HTTP {answer.code}") from None
        raise DemoFailed(f"login as {username}: name or password is wrong")

    def get(self, path: str) -> Any:
        """Return the JSON of `path` under /api/v1."""
        return json.loads(self._open(self._request(f"api/v1/{path}")))

    def post(self, path: str, content: Mapping[str, Any]) -> Any:
        """Send JSON to `path` under /api/v1, and return the answer.

        Raises:
            DemoFailed: If it is refused; with the sentence of the answer.
        """
        headers = {
            "Content-Type": "application/json",
            "X-CSRFToken": self.csrf_token,
            "Referer": self.url,
        }
        return json.loads(self._open(self._request(f"api/v1/{path}", json.dumps(content).encode(), headers)))

    @property
    def csrf_token(self) -> str:
        """CSRF token for requests with changes, "" if there is none."""
        tokens = (cookie.value for cookie in self._cookies if cookie.name.startswith("eva_csrf_"))
        return next(tokens, None) or ""

    @property
    def session_name(self) -> str:
        """Name of the session cookie, whose suffix differs by lab; "" if there is none."""
        names = (cookie.name for cookie in self._cookies if cookie.name.startswith("eva_session_"))
        return next(names, "")

    @property
    def cookies(self) -> str:
        """Header `Cookie`, as a browser sends it."""
        return "; ".join(f"{cookie.name}={cookie.value}" for cookie in self._cookies)

    def _request(
        self, path: str, data: bytes | None = None, headers: Mapping[str, str] | None = None
    ) -> Request:
        try:
            return Request(f"{self.url}/{path}", data, dict(headers or {}))
        except ValueError:
            raise DemoFailed(f"{self.url!r:.200} is no address of a lab; allowed: http://HOST:PORT") from None

    def _open(self, request: Request) -> bytes:
        try:
            with self._opener.open(request, timeout=_TIMEOUT_S) as answer:
                return bytes(answer.read())
        except HTTPError as refusal:
            with refusal:
                body = refusal.read().decode("utf-8", "replace")
            raise DemoFailed(
                f"{request.get_method()} {request.selector}: HTTP {refusal.code}: {_sentence(body)}"
            ) from None
        except (InvalidURL, UnicodeError):
            raise DemoFailed(
                f"{request.full_url!r:.200} is no address; allowed: http://HOST:PORT, and names of plans and stations"
            ) from None
        except (
            URLError,
            TimeoutError,
            ConnectionError,
        ) as error:  # ConnectionError occurs while the body is read
            reason = error.reason if isinstance(error, URLError) else error
            raise NoReply(f"{self.url} does not answer: {reason}") from None


def _sentence(body: str) -> str:
    """Return the sentence in the body of an error."""
    try:
        fields = json.loads(body)
    except ValueError:
        return body[:300]
    if isinstance(fields, dict):
        return str(fields.get("error") or fields.get("reason") or fields.get("detail") or fields)
    return str(fields)


def _words(state: Mapping[str, Any]) -> str:
    return f"{state.get('state')}: {state.get('reason')}" if state else "no state"


class LivePage:
    """Open page at a station: newest state, renewal of a held lease, and credits for frames.

    `page` is the id of an earlier page that is continued; "" creates a new one.
    """

    def __init__(self, visitor: RestClient, station: str, page: str = "") -> None:
        self.page = page or uuid.uuid4().hex
        self.station = station
        self.epoch = 0  # epoch of our lease; 0: none
        self.frames = 0
        self._visitor = visitor
        self._state: Mapping[str, Any] = {}
        self._decided = ("", 0)  # boot and sequence of the state on which our last command was based
        self._failure = ""
        self._changed = threading.Condition()
        self._open = ExitStack()
        self._socket = self._open.enter_context(self._connected())
        self._send({"type": "watch", "streams": ["state"]})
        self._threads = [threading.Thread(target=work, daemon=True) for work in (self._read, self._renew)]
        for thread in self._threads:
            thread.start()

    def _connected(self) -> ClientConnection:
        address = urlsplit(self._visitor.url)
        try:
            return connect(
                f"ws://{address.netloc}/ws/stations/{self.station}?page={self.page}",
                origin=self._visitor.url,  # type: ignore[arg-type]
                additional_headers={"Cookie": self._visitor.cookies},
                max_size=_LARGEST_FRAME,
                proxy=None,
            )
        except (OSError, InvalidHandshake, ConnectionClosed) as error:  # closed while it was being opened
            raise DemoFailed(f"the live connection to {self.station} does not open: {error}") from error

    def wait(
        self, reached: Callable[[Mapping[str, Any]], bool], seconds: float, what: str
    ) -> Mapping[str, Any]:
        """Return the first state that satisfies `reached`.

        After a command only newer states count: a state "ready" from before is not an answer to the command "setup".

        Raises:
            StateTimeout: If there is none within `seconds` [s].
            DemoFailed: If the connection or the lease was lost.
        """
        deadline = time.monotonic() + seconds
        with self._changed:
            while not (self._state and self._is_news() and reached(self._state)):
                if self._failure:
                    raise DemoFailed(f"{what}: {self._failure}")
                if not self._changed.wait(deadline - time.monotonic()) and time.monotonic() >= deadline:
                    raise StateTimeout(
                        f"{what}: not within {seconds:g} s; the station is {_words(self._state)}"
                    )
            return self._state

    def wait_with_progress(
        self,
        reached: Callable[[Mapping[str, Any]], bool],
        what: str,
        mark: Callable[[Mapping[str, Any]], object],
    ) -> Mapping[str, Any]:
        """Return the first state that satisfies `reached`; wait as long as `mark` of the state keeps changing.

        `mark` returns facts of a state that change with any progress.
        """
        patience = ProgressTimeout(what)
        while True:
            try:
                return self.wait(reached, _LOOK_S, what)
            except StateTimeout:
                state = self._state
                patience.update(mark(state) if state else None, _words(state))

    def claim(self) -> None:
        """Claim the station; the lease is renewed from then on."""
        path = f"stations/{self.station}/lease"
        self.epoch = 0  # answers to renewals of an earlier lease do not concern this one
        self.epoch = int(self._visitor.post(path, {"action": "claim", "page": self.page})["epoch"])

    def command(self, kind: str, trial: int | None = None) -> Mapping[str, Any]:
        """Send one command, based on the newest state.

        Raises:
            DemoFailed: If it is refused; with the reason.
        """
        state = self._state
        content = {
            "uuid": str(uuid.uuid4()),
            "kind": kind,
            "page": self.page,
            "epoch": self.epoch,
            "boot": state.get("boot", ""),
            "sequence": state.get("sequence", 0),
        }
        if trial is not None:
            content["trial"] = trial
        decided = (content["boot"], content["sequence"])
        answer: Mapping[str, Any] = self._visitor.post(f"stations/{self.station}/commands", content)
        self._decided = decided
        return answer

    def _is_news(self) -> bool:
        boot, sequence = self._decided
        return self._state["boot"] != boot or self._state["sequence"] > sequence

    def close(self) -> None:
        """Close the page; the lease then expires."""
        self.epoch = 0
        self._open.close()

    def _read(self) -> None:
        try:
            for message in self._socket:
                if isinstance(message, bytes):
                    self._frame(message)
                else:
                    self._on_message(json.loads(message))
        except (ConnectionClosed, EvaError, ValueError) as error:
            self._fail(f"the live connection broke: {error}")
        else:
            self._fail("the live connection was closed")

    def _frame(self, message: bytes) -> None:
        streams = decode(message).header["streams"]
        with self._changed:
            self.frames += 1
            if "state" in streams:
                self._state = streams["state"]["json"]
            self._changed.notify_all()
        self._send({"type": "credit"})

    def _on_message(self, message: Mapping[str, Any]) -> None:
        if message.get("type") == "renewed" and message.get("lost") and message.get("epoch") == self.epoch:
            self._fail(f"the lease was lost: {message.get('reason')}")

    def _fail(self, reason: str) -> None:
        with self._changed:
            self._failure = self._failure or reason
            self._changed.notify_all()

    def _renew(self) -> None:
        while not self._failure:
            time.sleep(_RENEW_S)
            if self.epoch:
                self._send({"type": "renew", "epoch": self.epoch})

    def _send(self, message: Mapping[str, Any]) -> None:
        try:
            self._socket.send(json.dumps(message))
        except ConnectionClosed as error:
            self._fail(f"the live connection broke: {error}")
