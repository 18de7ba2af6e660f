"""What the panel shows: the station's newest state and pictures, heard while somebody looks at the page."""

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

from runtime.core.errors import CodecError, TransportError
from runtime.ipc.bus import Endpoints, Subscriber
from runtime.ipc.session_state import complete_state_meaning
from runtime.link.uplink import read_uplink

log = logging.getLogger(__name__)
_LOOKED_AT_S = 5.0  # for which it is listened after somebody looked
_TURN_S, _FIND_S = 0.1, 0.5
SILENT_S = 1.5
# Of these families reasons are shown: what a person at the robot needs, and nothing of the policy, which a blind plan
# hides. A sentence that is an argument is looked at likewise.
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
    """A camera's newest picture, JPEG, numbered from 1."""

    number: int
    jpeg: bytes


class Watch:
    """Hears the station in a thread of its own while it is looked at, and nothing else."""

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
        """Somebody looks just now."""
        self._looked = self._clock()
        self._wanted.set()

    def status(self) -> dict[str, Any]:
        """What the page shows, for JSON; `silent_s`: for how long nothing was heard [s], 0 where it is."""
        silent = self._clock() - self._heard
        told = displayed_state(self._state) if self._state else {}
        told["silent_s"] = 0.0 if silent < SILENT_S else round(min(silent, 1e6), 1)
        told["cameras"] = {name: picture.number for name, picture in sorted(self._pictures.items())}
        return told | {"station": self._station_dir.name, "lab": read_uplink(self._endpoints)}

    def picture(self, camera: str) -> Picture | None:
        """The newest of a camera, None where there is none."""
        return self._pictures.get(camera)

    def end(self) -> None:
        """End the thread."""
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
            ):  # whatever a station publishes: e-stop and stop go on, and the next look tries again
                log.exception("what the station publishes cannot be shown")

    def _follow(self) -> None:
        """Listen until nobody has looked for a while."""
        state, cameras = _Ear(self._context, "state"), _Ear(self._context, "camera/")
        found = -float("inf")
        try:
            while not self._ended.is_set() and self._clock() - self._looked < _LOOKED_AT_S:
                if self._clock() - found >= _FIND_S:
                    found = self._clock()
                    state.turn_to(self._place("coordinator", "state"))
                    cameras.turn_to(self._place("media", "cameras"))
                for name, jpeg in cameras.receive(0.0).items():
                    camera = name.removeprefix("camera/")
                    before = self._pictures.get(camera)
                    self._pictures[camera] = Picture(before.number + 1 if before else 1, bytes(jpeg))
                said = state.receive(_TURN_S)
                if "state" in said:
                    self._state, self._heard = complete_state_meaning(said["state"]), self._clock()
        finally:
            state.turn_to("")
            cameras.turn_to("")
            self._state, self._pictures = {}, {}  # old pictures are never shown as new ones

    def _place(self, process: str, socket: str) -> str:
        try:
            return str(self._endpoints.read(process)[socket])
        except (TransportError, KeyError):
            return ""


class _Ear:
    """A stream, wherever it is published."""

    def __init__(self, context: zmq.Context[Any], stream: str) -> None:
        self._context, self._stream = context, stream
        self._place = ""
        self._subscriber: Subscriber | None = None

    def turn_to(self, place: str) -> None:
        if place == self._place:
            return
        if self._subscriber is not None:
            self._subscriber.close()
        self._place = place
        self._subscriber = Subscriber(self._context, place, self._stream) if place else None

    def receive(self, seconds: float) -> dict[str, Any]:
        if self._subscriber is None:
            time.sleep(seconds)
            return {}
        with suppress(CodecError):
            return self._subscriber.receive(seconds)
        return {}


def displayed_state(snapshot: Mapping[str, Any]) -> dict[str, Any]:
    """Of a snapshot what somebody at the robot needs: state, reason, who commands, how long it runs, the e-stop."""
    meaning, run = snapshot["state_is"], snapshot.get("run") or {}
    lease = snapshot.get("lease") or {}
    told: dict[str, Any] = {
        "state": str(meaning["label"]),
        "tone": str(meaning["tone"]),
        "reason": _reason(snapshot),
        "holder": str(lease.get("by") or lease.get("holder") or ""),
        "stoppable": "stop" in snapshot.get("allowed", ()),
        "latched": bool(meaning["latched"]),
    }
    if meaning["run_open"] and run.get("number"):
        told |= {"elapsed_s": float(run["elapsed"]), "limit_s": run.get("duration_s")}
    return told


def _reason(snapshot: Mapping[str, Any]) -> str:
    reason = str(snapshot.get("reason") or "")
    said = (snapshot.get("sentences") or {}).get("reason")
    return reason if not reason or _open(said) else _ELSEWHERE


def _open(said: Any) -> bool:
    """True if a sentence, as it travels, and all sentences within it, are of families that are shown."""
    if not isinstance(said, Mapping) or str(said.get("id")).split(".")[0] not in _SHOWN:
        return False
    within = said.get("arguments") or {}
    return all(_open(value) for value in within.values() if isinstance(value, Mapping))
