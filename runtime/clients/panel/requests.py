"""Requests to the panel: who may send them, and their answers.

| request | needs the PIN |
|---|---|
| GET / and the files that it loads | no |
| POST /estop | no |
| POST /pin, which sends the PIN; POST /leave, which ends the access that the PIN gave | no |
| GET /state, GET /camera/NAME; POST /stop | yes |

A request for a host other than the panel's names is refused (DNS rebinding). A POST from another origin is refused,
too. A POST without an Origin is refused unless it has our header, which a page of another origin cannot send (CSRF).
"""

from __future__ import annotations

import json
import logging
import time
import uuid
from dataclasses import dataclass
from functools import partial
from html import escape
from http import HTTPStatus
from http.cookies import CookieError, SimpleCookie
from http.server import BaseHTTPRequestHandler
from pathlib import Path
from string import Template
from typing import Any
from urllib.parse import parse_qs, unquote, urlsplit

from runtime.clients.panel.pin import PinFile
from runtime.clients.panel.server import REQUEST_S, Connection, PanelServer
from runtime.clients.panel.sessions import LASTS_S, Refusal, Sessions
from runtime.clients.panel.settings import PanelPlace
from runtime.clients.panel.stops import StopResult, Stops
from runtime.clients.panel.watch import Watch

log = logging.getLogger(__name__)
HEADER = "X-EVA-Panel"
_LARGEST, _DROPPED = 1024, 65536  # largest body [bytes]; bytes that are read of a larger body
_PRESS_S = 0.5  # wait for the body of a press [s]
_PAGE = Path(__file__).parent / "page"
_FILES = {"/panel.css": "text/css; charset=utf-8", "/panel.js": "text/javascript; charset=utf-8"}
_HEADERS = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob:; "
    "connect-src 'self'; form-action 'self'; base-uri 'none'; frame-ancestors 'none'",
    "X-Frame-Options": "DENY",  # no other page can cover the buttons (clickjacking)
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "same-origin",  # without a referrer browsers send no usable Origin
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cache-Control": "no-store",
}


@dataclass(frozen=True, slots=True)
class Panel:
    """Everything that requests use: address, PIN, sessions, stops and displayed state of one station."""

    station: str
    place: PanelPlace
    pin: PinFile
    sessions: Sessions
    stops: Stops
    watch: Watch

    def server(self) -> PanelServer:
        """Return a new server that listens at the panel's address. Raises: TransportError, ConfigurationError."""
        return PanelServer(self.place, partial(PanelRequests, self))  # type: ignore[arg-type]

    @property
    def cookie(self) -> str:
        """Name of the session cookie; with TLS, browsers restrict it to this host and to encrypted requests."""
        return "__Host-eva-panel" if self.place.certificate else "eva-panel"


class PanelRequests(BaseHTTPRequestHandler):
    """Handler of the requests of one connection."""

    protocol_version = "HTTP/1.1"
    server_version, sys_version = "eva-panel", ""

    def __init__(self, panel: Panel, connection: Connection, address: Any, server: PanelServer) -> None:
        self._panel, self._connection = panel, connection
        super().__init__(connection.socket, address, server)

    def handle_one_request(self) -> None:
        """Handle one request within its deadline."""
        self._connection.until = time.monotonic() + REQUEST_S
        self._connection.presses = False
        super().handle_one_request()

    # --- requests ----------------------------------------------------------------------------------------------

    def do_GET(self) -> None:
        """Serve the page, its files, the state and images."""
        path = urlsplit(self.path).path
        if not self._known_host():
            return
        if path == "/":
            self._page()
        elif path in _FILES:
            self._answer(HTTPStatus.OK, (_PAGE / path[1:]).read_bytes(), _FILES[path])
        elif path == "/state" and self._has_pin():
            self._panel.watch.note_viewer()
            self._json(HTTPStatus.OK, self._panel.watch.status())
        elif path.startswith("/camera/") and self._has_pin():
            self._picture(unquote(path.removeprefix("/camera/")))
        elif path == "/state" or path.startswith("/camera/"):
            self._refuse(HTTPStatus.UNAUTHORIZED, "give the PIN first")
        else:
            self._refuse(HTTPStatus.NOT_FOUND, "there is no such page")

    def do_POST(self) -> None:
        """Handle stops and the PIN."""
        path = urlsplit(self.path).path
        self._connection.presses = path == "/estop"
        if not self._known_host() or not self._own_origin():
            return
        fields = self._posted_fields()
        if path == "/estop":
            self._send_result(self._panel.stops.press(self._connection.source, _uuid(fields)))
        elif path == "/stop" and self._has_pin():
            self._send_result(self._panel.stops.stop(self._connection.source, _uuid(fields)))
        elif path == "/stop":
            self._refuse(HTTPStatus.UNAUTHORIZED, "give the PIN first: the E-STOP needs none")
        elif path == "/pin":
            self._enter(str(fields.get("pin") or ""))
        elif path == "/leave":
            self._panel.sessions.end(self._secret())
            self._json(HTTPStatus.OK, {}, self._cookie("", 0))
        else:
            self._refuse(HTTPStatus.NOT_FOUND, "there is no such page")

    def _page(self) -> None:
        values = {
            "station": escape(self._panel.station),
            "entered": "yes" if self._has_pin() else "no",
            "pin": "set" if self._panel.pin.version != (0, 0) else "unset",
        }
        page = Template((_PAGE / "panel.html").read_text("utf-8")).substitute(values)
        self._answer(HTTPStatus.OK, page.encode(), "text/html; charset=utf-8")

    def _picture(self, camera: str) -> None:
        self._panel.watch.note_viewer()
        picture = self._panel.watch.picture(camera)
        displayed = parse_qs(urlsplit(self.path).query).get("seen", [""])[0]
        if picture is None or displayed == str(picture.number):
            self._answer(HTTPStatus.NO_CONTENT, b"")
        else:
            self._answer(HTTPStatus.OK, picture.jpeg, "image/jpeg", {"X-Number": str(picture.number)})

    def _enter(self, pin: str) -> None:
        source = self._connection.source
        try:
            secret = self._panel.sessions.begin(pin, source)
        except Refusal as refusal:
            log.warning("a PIN from %s is not taken: %s", source, refusal)
            status = HTTPStatus.TOO_MANY_REQUESTS if refusal.wait_s else HTTPStatus.FORBIDDEN
            self._json(status, {"text": str(refusal), "wait_s": refusal.wait_s})
            return
        log.info("the PIN was given from %s", source)
        self._json(HTTPStatus.OK, {}, self._cookie(secret, int(LASTS_S)))

    def _send_result(self, result: StopResult) -> None:
        """Answer with JSON to our script, with text to a form that is used without the script."""
        status = HTTPStatus.OK if result.done else HTTPStatus.BAD_GATEWAY
        if HEADER in self.headers:
            self._json(status, {"done": result.done, "text": result.text})
        else:
            self._answer(status, f"{result.text}\n".encode(), "text/plain; charset=utf-8")

    # --- permission ----------------------------------------------------------------------------------------------

    def _known_host(self) -> bool:
        hosts = self.headers.get_all("Host", [])
        if len(hosts) == 1 and self._panel.place.knows(hosts[0]):
            return True
        self._refuse(
            HTTPStatus.MISDIRECTED_REQUEST,
            "this panel has no such name: open it by its address in numbers, or list the name in panel.names",
        )
        return False

    def _own_origin(self) -> bool:
        origins = self.headers.get_all("Origin", [])
        own = f"{self._panel.place.scheme}://{self.headers['Host'].strip()}".lower()
        site = self.headers.get("Sec-Fetch-Site", "same-origin")
        is_trusted = origins == [] and HEADER in self.headers
        if (is_trusted or [origin.lower() for origin in origins] == [own]) and site == "same-origin":
            return True
        self._refuse(HTTPStatus.FORBIDDEN, "a page of another origin may not do this: open the panel itself")
        return False

    def _has_pin(self) -> bool:
        return self._panel.sessions.holds(self._secret())

    def _secret(self) -> str:
        try:
            morsel = SimpleCookie(self.headers.get("Cookie", "")).get(self._panel.cookie)
        except CookieError:
            return ""
        return morsel.value if morsel is not None else ""

    def _posted_fields(self) -> dict[str, Any]:
        """Return the posted object, {} if it is unreadable: no press is lost because of its content."""
        length = self.headers.get("Content-Length", "0")
        if "Transfer-Encoding" in self.headers or not length.isascii() or not length.isdigit():
            self.close_connection = True
            return {}
        if (size := int(length[:9])) > _LARGEST:
            self.close_connection = True
        if self._connection.presses:
            self.connection.settimeout(_PRESS_S)  # a press with an incomplete body counts all the same
        try:
            body = self.rfile.read(
                min(size, _DROPPED)
            )  # a client whose body is not read may not receive the answer
            self.connection.settimeout(REQUEST_S)
            parsed = json.loads(body) if size <= _LARGEST else {}
        except (ValueError, RecursionError):
            return {}
        except OSError:
            self.close_connection = True
            return {}
        return parsed if isinstance(parsed, dict) else {}

    # --- answers -----------------------------------------------------------------------------------------------

    def _cookie(self, secret: str, seconds: int) -> dict[str, str]:
        secure = "; Secure" if self._panel.place.certificate else ""
        value = f"{self._panel.cookie}={secret}; Path=/; Max-Age={seconds}; HttpOnly; SameSite=Strict{secure}"
        return {"Set-Cookie": value}

    def _refuse(self, status: HTTPStatus, reason: str) -> None:
        self.close_connection = True  # the body has not been read
        self._json(status, {"done": False, "text": reason})

    def _json(self, status: HTTPStatus, content: Any, more: dict[str, str] | None = None) -> None:
        self._answer(status, json.dumps(content).encode(), "application/json", more)

    def _answer(
        self, status: HTTPStatus, content: bytes, kind: str = "", more: dict[str, str] | None = None
    ) -> None:
        self.send_response(status)
        for name, value in {**_HEADERS, **(more or {})}.items():
            self.send_header(name, value)
        if kind:
            self.send_header("Content-Type", kind)
        if status != HTTPStatus.NO_CONTENT:
            self.send_header("Content-Length", str(len(content)))
        if self.close_connection:
            self.send_header("Connection", "close")
        self.end_headers()
        self.wfile.write(content)

    def send_error(self, code: int, message: str | None = None, explain: str | None = None) -> None:
        """Answer an unreadable request in the same form as other requests, and close the connection."""
        self._refuse(HTTPStatus(code), message or HTTPStatus(code).phrase)

    def log_message(self, format: str, *args: Any) -> None:
        """Log the request at debug level."""
        log.debug("%s %s", self._connection.source, format % args)


def _uuid(fields: dict[str, Any]) -> str:
    """Return the uuid that the page sent, so that a repetition is not a second press; else a new uuid."""
    try:
        return str(uuid.UUID(str(fields.get("uuid"))))
    except ValueError:
        return str(uuid.uuid4())
