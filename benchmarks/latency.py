"""Latency from end to end while everything runs: control at 30 Hz, cameras, recording, five pages.

`command_ms`: a page presses Halt over its websocket, until it has the acknowledgement, given when the
order is on its way to control and the answer is in its journal. `node_ms`: from the same press until control hands
the first changed command to the socket towards the node; at 30 Hz a tick comes every 33 ms, so about half of that is
waiting for the next one. `renew_ms`: the same way there and back, 20 times a second, without a change of state.
`rest_ms`: Resume over REST, with its row in the database. `observation_ms`: from the node's stamp until the policy is
asked about it. `muxed_ms`: from the node's stamp until the frame's packet went to the muxer.

The runtime maps the node's clock onto ours such that the fastest message took no time (runtime.core.clock.ClockMap).
Here both are one clock: the shortest way is measured, and added to what counts from the node's stamp.
"""

from __future__ import annotations

import tempfile
import threading
import time
import uuid
from collections.abc import Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import zmq

from benchmarks.labs import STATION, ProcessorUsage, RunningLab, busy_lab, only_episode, set_up, watch
from benchmarks.report import Figure, Report
from evaweb.lab.patience import DemoFailed
from evaweb.lab.visitor import LivePage, RestClient
from runtime.core import msgpack_arrays
from runtime.recording.reader import Episode

SECONDS = 60.0
VIEWERS = 5
_MARGIN_S = 4.0
_RENEWALS_HZ = 20.0
_RUNS_S = 0.4  # between a resume and the next halt
_ACK_S = 5.0
_LISTENED_S = 2.0
_WANTED = {
    "command_ms.p50": "<= 4",
    "command_ms.p99": "<= 20",
    "muxed_ms.p99": "<= 60",
}


class PressingPage(LivePage):
    """A page that knows when it pressed and when it had the answer, on the monotonic clock [s]."""

    def __init__(self, visitor: RestClient, station: str) -> None:
        self._answers: dict[str, tuple[float, str]] = {}  # when, and the status, by uuid
        self._answered = threading.Condition()
        self._renewed = threading.Event()
        self.renewals: list[float] = []
        super().__init__(visitor, station)

    def press(self, kind: str) -> tuple[float, float]:
        """Stop or halt through the socket: when it was pressed and when the acknowledgement was here."""
        identity = str(uuid.uuid4())
        pressed = time.monotonic()
        self._send({"type": kind, "uuid": identity, "epoch": self.epoch})
        with self._answered:
            if not self._answered.wait_for(lambda: identity in self._answers, _ACK_S):
                raise DemoFailed(f"{kind}: no answer within {_ACK_S:g} s")
            answered, status = self._answers[identity]
        if status not in ("accepted", "done"):
            raise DemoFailed(f"{kind} was {status}")
        return pressed, answered

    def _on_message(self, message: Mapping[str, Any]) -> None:
        now = time.monotonic()
        if message.get("type") == "ack":
            with self._answered:
                self._answers[message["uuid"]] = now, message["status"]
                self._answered.notify_all()
        elif message.get("type") == "renewed":
            self._renewed_at = now
            self._renewed.set()
        super()._on_message(message)

    def _renew(self) -> None:
        """More often than a page does, and each only when the one before was answered."""
        while not self._failure:
            time.sleep(1.0 / _RENEWALS_HZ)
            if not self.epoch:
                continue
            self._renewed.clear()
            begun = time.monotonic()
            self._send({"type": "renew", "epoch": self.epoch})
            if self._renewed.wait(_ACK_S):
                self.renewals.append(self._renewed_at - begun)


def measure(seconds: float, assignments: Sequence[str] = ()) -> Report:
    """Percentiles of every way, in ms."""
    with tempfile.TemporaryDirectory() as folder:
        settings = ["control.rate=30.0", "recording.fps=30.0", *assignments]
        with busy_lab(Path(folder), settings) as lab:
            transit = _shortest_way(lab.announced["node"])
            found, presses, percent = _run(lab, seconds)
            episode = only_episode(lab.data)
        measured = {**found, **_from(episode, presses, transit)}
    figures = [
        Figure(name, value, "ms", _WANTED.get(name, ""))
        for way, values in measured.items()
        for name, value in _percentiles(way, values)
    ]
    figures += [
        Figure("halts", len(presses), ""),
        Figure("lab_cpu_percent", percent["lab"], "%"),
        Figure("other_cpu_percent", percent["others"], "%"),
    ]
    return Report("latency", figures, [{"node_to_us_ms": transit * 1000.0, "cpu_percent": percent}])


def _run(lab: RunningLab, seconds: float) -> tuple[dict[str, Any], list[float], dict[str, float]]:
    """Halt and resume for so long; the ways measured by the page [ms], when it pressed, processor time."""
    commands, resumes, presses = [], [], []
    with closing(PressingPage(lab.visitor, STATION)) as page:
        set_up(page)
        watching = watch(lab.visitor, seconds + 2 * _MARGIN_S, reading=VIEWERS)
        page.command("run")
        page.wait(lambda state: state["state_is"]["going"], 10.0, "starting the run")
        time.sleep(_MARGIN_S)
        page.renewals.clear()
        processors, end = ProcessorUsage(lab.process), time.monotonic() + seconds
        while time.monotonic() < end:
            pressed, answered = page.press("halt")
            presses.append(pressed)
            commands.append(answered - pressed)
            page.wait(lambda state: state["state_is"]["held"], 10.0, "halting")
            resumes.append(_resume(page))
            time.sleep(_RUNS_S)
        percent, renewals = processors.percent(), list(page.renewals)
        page.command("stop")
        page.wait(lambda state: state["state_is"]["ready"], 20.0, "stopping")
        watching.communicate()
    ways = {"command_ms": commands, "renew_ms": renewals, "rest_ms": resumes}
    return {name: _ms(values) for name, values in ways.items()}, presses, percent


def _resume(page: LivePage) -> float:
    begun = time.monotonic()
    page.command("resume")
    taken = time.monotonic() - begun
    page.wait(lambda state: state["state_is"]["going"], 10.0, "resuming")
    return taken


def _shortest_way(endpoint: str) -> float:
    """The shortest time from the node's stamp to a process that listens to it [s]."""
    ways = []
    with zmq.Context() as context, context.socket(zmq.SUB) as socket:
        socket.setsockopt(zmq.SUBSCRIBE, b"")
        socket.setsockopt(zmq.RCVHWM, 2)
        socket.setsockopt(zmq.LINGER, 0)
        socket.connect(endpoint)
        end = time.monotonic() + _LISTENED_S
        while (left := end - time.monotonic()) > 0:
            if socket.poll(int(left * 1000)):
                payload = socket.recv()
                arrived = time.monotonic()
                ways.append(arrived - float(msgpack_arrays.unpack(payload)["t"]))
    if not ways:
        raise SystemExit(f"the node at {endpoint} says nothing")
    return min(ways)


def _from(episode: Episode, presses: Sequence[float], transit: float) -> dict[str, Any]:
    """Figures from the recording [ms]: arrays, and percentiles where it keeps only these."""
    assert episode.outcome is not None
    outcome: Mapping[str, Any] = episode.outcome
    muxed = outcome["muxed_ms"].values()
    ages = outcome["policy"]["observation_age_ms"]
    shift = transit * 1000.0
    return {
        "node_ms": _ms(_to_the_node(episode, presses)),
        "observation_ms": {name: value + shift for name, value in ages.items()},
        "muxed_ms": {name: max(camera[name] for camera in muxed) + shift for name in ("p50", "p99", "max")},
    }


def _to_the_node(episode: Episode, presses: Sequence[float]) -> list[float]:
    """From each press until the first command that is not the policy's was handed to the socket [s]."""
    ticks = episode.ticks
    sent = ticks.column("sent").to_numpy() + episode.manifest["started_monotonic"]
    ours = np.array(ticks.column("control_source").to_pylist()) != "policy"
    changed = sent[ours]
    return [float(changed[np.searchsorted(changed, pressed)] - pressed) for pressed in presses]


def _ms(seconds: Sequence[float]) -> np.ndarray:
    return np.array(seconds) * 1000.0


def _percentiles(way: str, values: Any) -> list[tuple[str, float]]:
    if isinstance(values, Mapping):
        return [(f"{way}.{name}", float(value)) for name, value in values.items()]
    return [
        (f"{way}.{name}", float(np.percentile(values, q)))
        for name, q in (("p50", 50.0), ("p99", 99.0), ("max", 100.0))
    ]
