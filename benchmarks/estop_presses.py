"""E-stop presses by pages and programs, and the time until each is executed."""

from __future__ import annotations

import http.client
import json
import queue
import threading
import time
from collections.abc import Mapping
from contextlib import closing
from dataclasses import dataclass
from typing import Any
from urllib.parse import urlsplit
from uuid import uuid4

from benchmarks.estop_lab import PRESSED
from evaweb.lab.rest_client import LivePage, RestClient
from evaweb.lab.stall_detection import DemoFailed, NoReply

PATIENCE_S = 10.0
_DONE = "done"


@dataclass(frozen=True, slots=True)
class Press:
    """Press of the e-stop with its status ("" without an answer), reason, and duration [ms]."""

    status: str
    reason: str
    took_ms: float

    @property
    def ms(self) -> float:
        """Time until the press was executed [ms]; the whole timeout if it was not."""
        return self.took_ms if self.status == _DONE else PATIENCE_S * 1000.0

    @property
    def failed(self) -> bool:
        """Whether the press was answered but not executed."""
        return self.status not in (_DONE, "")


class _Page(LivePage):
    """Page that receives the acknowledgements of its presses."""

    def __init__(self, visitor: RestClient, station: str) -> None:
        self._acks: dict[str, queue.SimpleQueue[tuple[float, Mapping[str, Any]]]] = {}  # by uuid
        super().__init__(visitor, station)

    @property
    def broken(self) -> str:
        return self._failure

    def press(self, why: str, identity: str) -> Press:
        begun, acks = time.monotonic(), queue.SimpleQueue[tuple[float, Mapping[str, Any]]]()
        self._acks[identity] = acks
        self._send({"type": "estop", "uuid": identity, "why": why})
        while (left := begun + PATIENCE_S - time.monotonic()) > 0 and not self.broken:
            try:
                at, ack = acks.get(timeout=min(left, 0.2))
            except queue.Empty:
                continue
            return Press(ack["status"], ack["reason"], (at - begun) * 1000.0)
        return Press("", self.broken or "no answer", (time.monotonic() - begun) * 1000.0)

    def _on_message(self, message: Mapping[str, Any]) -> None:
        if message.get("type") == "ack" and message["uuid"] in self._acks:
            self._acks[message["uuid"]].put((time.monotonic(), message))
        super()._on_message(message)


class OpenPage:
    """Operator's page at the station, which presses over its websocket and at the process for stops, as in a browser.

    A broken connection is reopened.
    """

    def __init__(self, visitor: RestClient, stops: str, station: str = PRESSED) -> None:
        self._visitor, self._station = visitor, station
        self._page, self._opening = _Page(visitor, station), threading.Lock()
        self._way = RestPresser(stops, {"Cookie": visitor.cookies}, station)
        self._way.ready()

    def press(self, why: str) -> Press:
        """Press in both ways with one uuid; return the first press that was executed, or a failed one."""
        identity, answers = str(uuid4()), queue.SimpleQueue[Press]()
        senders = (self.over_the_socket, self._way.press)
        for sender in senders:
            requests = lambda sender=sender: answers.put(sender(why, identity))  # noqa: E731
            threading.Thread(target=requests, daemon=True).start()
        pressed = [answers.get()]
        while pressed[-1].status != _DONE and len(pressed) < len(senders):
            pressed.append(answers.get())
        return next((press for press in pressed if press.status == _DONE), pressed[0])

    def over_the_socket(self, why: str, identity: str = "") -> Press:
        """Press over the websocket alone, and wait for the answer."""
        with self._opening:
            if self._page.broken:
                self.close()
                try:
                    self._page = _Page(self._visitor, self._station)
                except DemoFailed as fault:
                    return Press("", str(fault), 0.0)
            page = self._page
        return page.press(why, identity or str(uuid4()))

    def close(self) -> None:
        self._page.close()


class RestPresser:
    """Program that presses over HTTP with the given headers, with a new connection for each press."""

    def __init__(self, url: str, headers: Mapping[str, str], station: str = PRESSED) -> None:
        self._address, self._station = urlsplit(url).netloc, station
        self._headers = {**headers, "Content-Type": "application/json"}

    def ready(self) -> None:
        """Request the state of the e-stop once.

        A page does the same when it opens, to test whether presses can be sent by this way.
        """
        self.post("GET", "estop")

    def press(self, why: str, identity: str = "") -> Press:
        """Press and wait for the answer."""
        begun = time.monotonic()
        try:
            reply = self.post("POST", "estop", json.dumps({"uuid": identity or str(uuid4()), "why": why}))
        except (OSError, http.client.HTTPException, ValueError) as fault:
            return Press("", f"{type(fault).__name__}: {fault}", (time.monotonic() - begun) * 1000.0)
        took = time.monotonic() - begun
        in_time = took <= PATIENCE_S
        return Press(reply.get("status", "refused") if in_time else "", str(reply)[:200], took * 1000.0)

    def post(self, method: str, what: str, body: str = "") -> dict[str, Any]:
        """Send an HTTP request to the station's address in the REST interface; return the answer.

        Args:
            method: HTTP method.
            what: Last part of the address, `estop` or `commands`.
            body: Body of the request.
        """
        with closing(http.client.HTTPConnection(self._address, timeout=PATIENCE_S)) as connection:
            connection.request(method, f"/api/v1/stations/{self._station}/{what}", body, self._headers)
            reply: dict[str, Any] = json.loads(connection.getresponse().read())
            return reply


def page_load_time(visitor: RestClient, seconds: float) -> float | None:
    """Return the time until the station's page is loaded [s]; None if not within `seconds`."""
    begun = time.monotonic()
    while time.monotonic() - begun < seconds:
        try:
            _page_of(visitor, seconds - (time.monotonic() - begun))
        except (NoReply, OSError, http.client.HTTPException):
            time.sleep(0.1)
        else:
            return time.monotonic() - begun
    return None


def _page_of(visitor: RestClient, timeout: float) -> None:
    address = urlsplit(visitor.url).netloc
    with closing(http.client.HTTPConnection(address, timeout=max(0.1, timeout))) as connection:
        cookies = {"Cookie": visitor.cookies}
        connection.request("GET", f"/stations/{PRESSED}/debug/", headers=cookies)
        answer = connection.getresponse()
        answer.read()
        if answer.status != 200:
            raise NoReply(f"/stations/{PRESSED}/debug/: HTTP {answer.status}")
