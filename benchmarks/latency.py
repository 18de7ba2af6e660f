"""End-to-end latency under full load: control at 30 Hz, cameras, recording, five pages.

* `command_ms`: from Halt pressed on a page, over its websocket, to the acknowledgement, which is sent when the order
  is on its way to control and the answer is in its journal.
* `node_ms`: from the same press until control passes the first changed command to the socket towards the node; at 30
  Hz a tick lasts 33 ms, so about half of that is waiting for the next tick.
* `renew_ms`: round trip of a renewal of the lease over the page's websocket, 20 times per second; no state changes.
* `rest_ms`: Resume over REST, with its database row.
* `observation_ms`: from the node's stamp to the policy request with this observation.
* `muxed_ms`: from the node's stamp until the frame's packet is passed to the muxer.

The runtime maps the node's clock to ours such that the fastest message has no delay (runtime.core.clock.ClockMap). Here
both clocks are the same, so the shortest delay can be measured; it is added to durations that begin at the node's
stamp.
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
from evaweb.lab.rest_client import LivePage, RestClient
from evaweb.lab.stall_detection import DemoFailed
from runtime.core import msgpack_arrays
from runtime.recording.reader import Episode

SECONDS = 60.0
VIEWERS = 5
_MARGIN_S = 4.0
_RENEWALS_HZ = 20.0
_RUNS_S = 0.4  # from a resume to the next halt
_ACK_S = 5.0
_LISTENED_S = 2.0
_WANTED = {
    "command_ms.p50": "<= 4",
    "command_ms.p99": "<= 20",
    "muxed_ms.p99": "<= 60",
}


class PressingPage(LivePage):
    """Page that records the times of its presses and of their answers on the monotonic clock [s]."""

    def __init__(self, visitor: RestClient, station: str) -> None:
        self._answers: dict[str, tuple[float, str]] = {}  # by uuid: time and status
        self._answered = threading.Condition()
        self._renewed = threading.Event()
        self.renewals: list[float] = []
        super().__init__(visitor, station)

    def press(self, kind: str) -> tuple[float, float]:
        """Send stop or halt through the socket; return the times of the press and of its acknowledgement."""
        identity = str(uuid.uuid4())
        pressed = time.monotonic()
        self._send({"type": kind, "uuid": identity, "epoch": self.epoch})
        with self._answered:
            if not self._answered.wait_for(lambda: identity in self._answers, _ACK_S):
                raise DemoFailed(f"{kind}: no answer within {_ACK_S:g} s")
            answered_at, status = self._answers[identity]
        if status not in ("accepted", "done"):
            raise DemoFailed(f"{kind} was {status}")
        return pressed, answered_at

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
        """Renew the lease `_RENEWALS_HZ` times per second, which is more often than a page does."""
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
    """Measure percentiles of all latencies [ms]."""
    with tempfile.TemporaryDirectory() as folder:
        settings = ["control.rate=30.0", "recording.fps=30.0", *assignments]
        with busy_lab(Path(folder), settings) as lab:
            transit = _shortest_delay(lab.announced["node"])
            latencies, presses, percent = _run(lab, seconds)
            episode = only_episode(lab.data)
        measured = {**latencies, **_from(episode, presses, transit)}
    figures = [
        Figure(name, value, "ms", _WANTED.get(name, ""))
        for route, values in measured.items()
        for name, value in _percentiles(route, values)
    ]
    figures += [
        Figure("halts", len(presses), ""),
        Figure("lab_cpu_percent", percent["lab"], "%"),
        Figure("other_cpu_percent", percent["others"], "%"),
    ]
    return Report("latency", figures, [{"node_to_us_ms": transit * 1000.0, "cpu_percent": percent}])


def _run(lab: RunningLab, seconds: float) -> tuple[dict[str, Any], list[float], dict[str, float]]:
    """Halt and resume for `seconds`.

    Return the latencies measured by the page [ms], the times of the presses, and the processor load.
    """
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
            pressed, answered_at = page.press("halt")
            presses.append(pressed)
            commands.append(answered_at - pressed)
            page.wait(lambda state: state["state_is"]["held"], 10.0, "halting")
            resumes.append(_resume(page))
            time.sleep(_RUNS_S)
        percent, renewals = processors.percent(), list(page.renewals)
        page.command("stop")
        page.wait(lambda state: state["state_is"]["ready"], 20.0, "stopping")
        watching.communicate()
    by_route = {"command_ms": commands, "renew_ms": renewals, "rest_ms": resumes}
    return {name: _ms(values) for name, values in by_route.items()}, presses, percent


def _resume(page: LivePage) -> float:
    begun = time.monotonic()
    page.command("resume")
    delay = time.monotonic() - begun
    page.wait(lambda state: state["state_is"]["going"], 10.0, "resuming")
    return delay


def _shortest_delay(endpoint: str) -> float:
    """Return the shortest time from the node's stamp to a subscriber in this process [s]."""
    delays = []
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
                delays.append(arrived - float(msgpack_arrays.unpack(payload)["t"]))
    if not delays:
        raise SystemExit(f"the node at {endpoint} says nothing")
    return min(delays)


def _from(episode: Episode, presses: Sequence[float], transit: float) -> dict[str, Any]:
    """Return the latencies [ms] that can be computed from the recording.

    `node_ms` is an array of the single values. The other entries are percentiles, because only these are recorded; the
    shortest time from the node to the station, `transit` [s], is added to them.
    """
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
    """Return the time from each press to the first command after it that does not come from the policy [s]."""
    ticks = episode.ticks
    sent = ticks.column("sent").to_numpy() + episode.manifest["started_monotonic"]
    local = np.array(ticks.column("control_source").to_pylist()) != "policy"
    changed = sent[local]
    return [float(changed[np.searchsorted(changed, pressed)] - pressed) for pressed in presses]


def _ms(seconds: Sequence[float]) -> np.ndarray:
    return np.array(seconds) * 1000.0


def _percentiles(route: str, values: Any) -> list[tuple[str, float]]:
    if isinstance(values, Mapping):
        return [(f"{route}.{name}", float(value)) for name, value in values.items()]
    return [
        (f"{route}.{name}", float(np.percentile(values, q)))
        for name, q in (("p50", 50.0), ("p99", 99.0), ("max", 100.0))
    ]
