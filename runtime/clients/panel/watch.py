"""State and images that the panel displays; the station's streams are received only while the page is in use."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import zmq

from runtime.core.errors import CodecError
from runtime.ipc.bus import Endpoints, Subscriber
from runtime.ipc.session_state import complete_state_meaning
from runtime.link.uplink import read_uplink

log = logging.getLogger(__name__)
_LOOKED_AT_S = 5.0  # reception after the last use of the page [s]
_TURN_S, _FIND_S = 0.1, 0.5
SILENT_S = 1.5
# Families of sentences whose reasons are shown: a person at the robot needs them, and they reveal nothing of the
# policy, which a blind plan hides. Sentences inside arguments are checked in the same manner.
_SHOWN = frozenset(
    [
        "cameras",
        "control",
        "drives",
        "estop",
        "guard",
        "health",
        "lease",
        "media",
        "node",
        "observation",
        "reception",
        "recording",
        "runs",
        "safety",
        "session",
        "shared",
        "state",
    ]
)
_ELSEWHERE = "the console and the station's log say why"


@dataclass(frozen=True, slots=True)
class Picture:
    """Newest image of a camera.

    `jpeg` is the encoded image. `number` counts the images of the camera from 1.
    """

    number: int
    jpeg: bytes


class Watch:
    """Thread that receives the station's streams while the page is in use."""

    def __init__(
        self, context: zmq.Context[Any], station_dir: Path, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._context, self._station_dir, self._clock = context, station_dir, clock
        self._endpoints = Endpoints(station_dir)
        self._looked = self._heard = -float("inf")
        self._wanted, self._ended = threading.Event(), threading.Event()
        self._state: dict[str, Any] = {}
        self._pictures: dict[str, Picture] = {}
        self._thread = threading.Thread(target=self._run, name="watch", daemon=True)
        self._thread.start()

    def note_viewer(self) -> None:
        """Record that the page is in use now."""
        self._looked = self._clock()
        self._wanted.set()

    def status(self) -> dict[str, Any]:
        """Return the content of the page, for JSON.

        `silent_s` is the time without a new state [s], 0 if it is below SILENT_S.
        """
        silent = self._clock() - self._heard
        fields = displayed_state(self._state) if self._state else {}
        fields["silent_s"] = 0.0 if silent < SILENT_S else round(min(silent, 1e6), 1)
        fields["cameras"] = {name: picture.number for name, picture in sorted(self._pictures.items())}
        return fields | {"station": self._station_dir.name, "lab": read_uplink(self._endpoints)}

    def picture(self, camera: str) -> Picture | None:
        """Return the newest image of a camera, None if there is none."""
        return self._pictures.get(camera)

    def end(self) -> None:
        """Stop the thread."""
        self._ended.set()
        self._wanted.set()
        self._thread.join()

    def _run(self) -> None:
        while self._wanted.wait() and not self._ended.is_set():
            self._wanted.clear()
            try:
                self._follow()
            except (
                Exception
            ):  # no published message may affect stops; the next request of the page tries again
                log.exception("what the station publishes cannot be shown")

    def _follow(self) -> None:
        """Receive the streams until the page has not been used for `_LOOKED_AT_S`."""
        state, cameras = StreamReader(self._context, "state"), StreamReader(self._context, "camera/")
        searched_at = -float("inf")
        try:
            while not self._ended.is_set() and self._clock() - self._looked < _LOOKED_AT_S:
                if self._clock() - searched_at >= _FIND_S:
                    searched_at = self._clock()
                    state.turn_to(self._place("coordinator", "state"))
                    cameras.turn_to(self._place("media", "cameras"))
                for name, jpeg in cameras.receive(0.0).items():
                    camera = name.removeprefix("camera/")
                    before = self._pictures.get(camera)
                    self._pictures[camera] = Picture(before.number + 1 if before else 1, bytes(jpeg))
                message = state.receive(_TURN_S)
                if "state" in message:
                    self._state, self._heard = complete_state_meaning(message["state"]), self._clock()
        finally:
            state.turn_to("")
            cameras.turn_to("")
            self._state, self._pictures = {}, {}  # old images are never shown as new

    def _place(self, process: str, socket: str) -> str:
        return self._endpoints.address(process, socket)


class StreamReader:
    """Subscription to a stream, which follows the stream's endpoint if that changes."""

    def __init__(self, context: zmq.Context[Any], stream: str) -> None:
        self._context, self._stream = context, stream
        self._place = ""
        self._subscriber: Subscriber | None = None

    def turn_to(self, place: str) -> None:
        """Read the stream at this endpoint from now on; "" reads nothing."""
        if place == self._place:
            return
        if self._subscriber is not None:
            self._subscriber.close()
        self._place = place
        self._subscriber = Subscriber(self._context, place, self._stream) if place else None

    def receive(self, seconds: float) -> dict[str, Any]:
        """Return the newest content by stream, waiting at most `seconds`; {} without any, or if it is unreadable."""
        if self._subscriber is None:
            time.sleep(seconds)
            return {}
        with suppress(CodecError):
            return self._subscriber.receive(seconds)
        return {}

    def receive_all(self) -> list[tuple[str, Any]]:
        """Return (stream, content) of every message that has arrived, in order; [] if one is unreadable."""
        with suppress(CodecError):
            return [] if self._subscriber is None else self._subscriber.receive_all(0.0)
        return []


def displayed_state(snapshot: Mapping[str, Any]) -> dict[str, Any]:
    """Return the part of a snapshot that a person at the robot needs.

    It has state, reason, lease holder, running time, and whether the e-stop is latched.
    """
    meaning, run = snapshot["state_is"], snapshot.get("run") or {}
    lease = snapshot.get("lease") or {}
    fields: dict[str, Any] = {
        "state": str(meaning["label"]),
        "tone": str(meaning["tone"]),
        "reason": _reason(snapshot),
        "holder": str(lease.get("by") or lease.get("holder") or ""),
        "stoppable": "stop" in snapshot.get("allowed", ()),
        "latched": bool(meaning["latched"]),
    }
    if meaning["run_open"] and run.get("number"):
        fields |= {"elapsed_s": float(run["elapsed"]), "limit_s": run.get("duration_s")}
    return fields


def _reason(snapshot: Mapping[str, Any]) -> str:
    reason = str(snapshot.get("reason") or "")
    sentence = (snapshot.get("sentences") or {}).get("reason")
    return reason if not reason or is_shown(sentence) else _ELSEWHERE


def is_shown(sentence: Any) -> bool:
    """Return True if the panel may display a sentence, because it reveals nothing of a policy that a blind plan hides.

    The ids of the sentence and of all sentences in its arguments must begin with a permitted group.
    """
    if not isinstance(sentence, Mapping) or str(sentence.get("id")).split(".")[0] not in _SHOWN:
        return False
    within = sentence.get("arguments") or {}
    return all(is_shown(value) for value in within.values() if isinstance(value, Mapping))
