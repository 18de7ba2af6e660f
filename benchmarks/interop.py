"""Other programs: episodes as MCAP, the live view in Foxglove beside a running robot, and a program that drives it.

The complete demo runs. One trial has no live view; in the next, a client of `python -m runtime.clients.foxglove` has
subscribed all topics, cameras too. Its recording is then exported, read back by packages that are not ours, and
imported. In a third run a program drives by `python -m runtime.clients.robot_server`, at the control rate and with all
pictures, as LeRobot's commands do.

* `export_ratio.video`, `export_ratio.jpeg`: duration of the episode times its cameras over the time of the export; with
  "video" pictures are copied, with "jpeg" coded anew.
* `import_ratio`: the same for the import of the exported JPEG file as a checked LeRobot dataset.
* `roundtrip_differences`: tables of the episode of which any column differs in any bit from the messages.
* `bridge_share`: share of a processor that the bridge uses, `bridge_messages_per_s`: what it sends.
* `loop_p99_ratio.bridge`: the control loop's lateness p99 with the bridge over that without.
* `drive_observe_ms`, `drive_act_ms`: median time of the two requests of a program that drives, `..._p99` their 99th
  percentile.
* `drive_delay_steps`: median number of control steps from the observation that a row answers to its first place in the
  plan. `loop_p99_ratio.drive`: as for the bridge.
"""

from __future__ import annotations

import json
import math
import struct
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import psutil
from websockets.sync.client import ClientConnection, connect

import robots
from benchmarks.labs import ROOT, STATION, RunningLab, lab
from benchmarks.report import Figure, Report
from evaweb.lab.rest_client import LivePage, RestClient
from evaweb.lab.single_trial import TrialChoice, start
from runtime.clients.client import StationClient
from runtime.clients.foxglove.server import PROTOCOL
from runtime.integrations.evaweb_robot.evaweb_robot import Station
from runtime.interop.bag_import import import_bags
from runtime.interop.bag_mapping import propose_mapping
from runtime.interop.bag_reader import Bag
from runtime.interop.mcap_export import export_mcap
from runtime.recording.reader import Episode, open_episode
from tests.runtime.interop.rebuilt import differing_tables


def measure(seconds: float) -> Report:
    """Run two trials of `seconds`, the second with a live view, and pass its recording to other formats and back."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        ready = folder / "ready.json"
        with lab(["manage.py", "demo", "--port", "0", "--ready-file", str(ready)], ready) as demo:
            alone = _trial(demo.visitor, seconds)
            with _client(demo, "runtime.clients.foxglove") as (process, address), _viewer(address) as viewer:
                before, begun = sum(process.cpu_times()[:2]), time.monotonic()
                watched = _trial(demo.visitor, seconds)
                share = (sum(process.cpu_times()[:2]) - before) / (time.monotonic() - begun)
            episode = _newest_episode(demo.data)
            with _client(demo, "runtime.clients.robot_server") as (_, address):
                requests, driven = _drive(demo, address, seconds)
        delay = _delay_steps(_newest_episode(demo.data), requests)
        files = _files(episode, folder)
    lateness = [control["lateness_p99_ms"] for control in (alone, watched, driven)]
    observing, acting = (
        np.array([getattr(row, name) for row in requests]) for name in ("observe_ms", "act_ms")
    )
    figures = [
        *(Figure(f"export_ratio.{pictures}", files[pictures], "") for pictures in ("video", "jpeg")),
        Figure("import_ratio", files["import"], ""),
        Figure("roundtrip_differences", files["differences"], "", "== 0"),
        Figure("bridge_share", 100.0 * share, "%"),
        Figure("bridge_messages_per_s", viewer.count / seconds, "1/s"),
        Figure("loop_p99_ratio.bridge", lateness[1] / lateness[0], "", "<= 1.1"),
        Figure("drive_observe_ms", float(np.median(observing)), "ms"),
        Figure("drive_observe_ms_p99", float(np.percentile(observing, 99)), "ms"),
        Figure("drive_act_ms", float(np.median(acting)), "ms"),
        Figure("drive_act_ms_p99", float(np.percentile(acting, 99)), "ms"),
        Figure("drive_delay_steps", delay, "steps"),
        Figure("loop_p99_ratio.drive", lateness[2] / lateness[0], "", "<= 1.1"),
    ]
    with_what = (("nothing", alone), ("bridge", watched), ("program", driven))
    rows = [{"with": name, **control} for name, control in with_what]
    return Report("interop", figures, rows)


def _trial(visitor: RestClient, seconds: float) -> Mapping[str, Any]:
    """Run one trial for `seconds`; return control's figures."""
    with closing(LivePage(visitor, STATION)) as page:
        start(visitor, page, TrialChoice(STATION, "block-on-plate", 1, "pick-place-40k", seed=1))
        time.sleep(seconds)
        state = page.wait(lambda state: True, 10, "looking")
        page.command("stop")
        page.wait(lambda state: state["state_is"]["ready"], 10, "stopping")
        visitor.post(f"stations/{STATION}/lease", {"action": "give_up", "page": page.page})
    control: Mapping[str, Any] = state["control"]
    for trial in visitor.get("trials")["items"]:
        if trial["status"] in ("ended", "interrupted"):
            visitor.post(f"trials/{trial['id']}/void", {"reason": "a benchmark"})
    return control


class _Request(NamedTuple):
    """One turn of a program that drives: first number of the row that it sent, and times of its requests."""

    step: int  # of the observation
    number: float
    observe_ms: float
    act_ms: float


def _drive(demo: RunningLab, address: str, seconds: float) -> tuple[list[_Request], Mapping[str, Any]]:
    """Drive for `seconds` at the control rate; return the requests and control's figures."""
    requests: list[_Request] = []
    with Station(address, program="benchmark") as station:
        period, _ = 1.0 / station.describe().rate, station.begin()
        start = station.observe().joints.copy()
        begun = time.monotonic()
        for number in range(1, round(seconds / period)):
            row = start.copy()
            row[0] += 0.2 * math.sin(2.0 * number * period)
            before = time.monotonic()
            observation = station.observe()
            between = time.monotonic()
            station.act(row)
            after = time.monotonic()
            times = 1000.0 * (between - before), 1000.0 * (after - between)
            requests.append(_Request(observation.step, float(row[0]), *times))
            time.sleep(max(0.0, begun + number * period - time.monotonic()))
        client = StationClient(demo.data / "stations" / STATION)
        control: Mapping[str, Any] = client.status()["control"]
        client.close()
        station.end()
    return requests, control


def _delay_steps(episode: Episode, requests: Sequence[_Request]) -> float:
    """Return the median number of steps from a row's observation to its first place in the plan before safety."""
    steps = np.array(episode.smoothed["step"].to_pylist())
    planned = np.array([row[0] for row in episode.smoothed["smoothed"].to_pylist()])
    delays = []
    for request in requests:
        places = steps[(planned == np.float32(request.number)) & (steps > request.step)]
        delays += [int(places[0]) - request.step] if len(places) else []
    return float(np.median(delays))


@contextmanager
def _client(demo: RunningLab, module: str) -> Iterator[tuple[psutil.Process, str]]:
    """Yield the process of a station's client that other programs connect to, and its address."""
    command = [sys.executable, "-m", module, STATION, "--port", "0", "--lifeline"]
    child = subprocess.Popen(
        command, cwd=ROOT, env=demo.environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    assert child.stdin is not None
    assert child.stdout is not None
    try:
        yield psutil.Process(child.pid), child.stdout.readline().strip()
    finally:
        child.stdin.close()
        child.wait()


class _Viewer:
    """Client that has subscribed everything, and counts what it receives."""

    def __init__(self, connection: ClientConnection) -> None:
        self.count = 0
        self._connection = connection
        self._thread = threading.Thread(target=self._read)
        self._thread.start()

    def _read(self) -> None:
        for message in self._connection:
            if isinstance(message, bytes):
                struct.unpack_from("<BIQ", message)
                self.count += 1
            elif (told := json.loads(message))["op"] == "advertise":
                rows = [{"id": row["id"], "channelId": row["id"]} for row in told["channels"]]
                self._connection.send(json.dumps({"op": "subscribe", "subscriptions": rows}))

    def close(self) -> None:
        """Leave."""
        self._connection.close()
        self._thread.join()


@contextmanager
def _viewer(address: str) -> Iterator[_Viewer]:
    viewer = _Viewer(connect(address, subprotocols=[PROTOCOL], max_size=None))  # type: ignore[list-item]
    try:
        yield viewer
    finally:
        viewer.close()


def _newest_episode(data: Path) -> Episode:
    """Return the newest closed episode of a lab that has ended."""
    closed = [path.parent for path in (data / "episodes").glob("*/outcome.json")]
    return open_episode(max(closed, key=lambda path: path.stat().st_mtime))


def _files(episode: Episode, folder: Path) -> dict[str, float]:
    """Return the ratios of exports and import, and the number of tables that differ."""
    worth = episode.frames / episode.layout.fps * len(episode.layout.cameras)
    found: dict[str, float] = {}
    for pictures in ("video", "jpeg"):
        begun = time.monotonic()
        export_mcap(episode.path, folder / f"{pictures}.mcap", pictures)
        found[pictures] = worth / (time.monotonic() - begun)
    found["differences"] = float(len(differing_tables(folder / "video.mcap", episode)))
    robot = robots.load_robot(str(episode.manifest["robot"]["name"]))  # type: ignore[index]
    with Bag(folder / "jpeg.mcap") as bag:
        mapping, _ = propose_mapping(bag, robot)
    begun = time.monotonic()
    (imported,) = import_bags([folder / "jpeg.mcap"], mapping, folder / "dataset")
    if imported.problem:
        raise RuntimeError(f"the exported file is not imported: {imported.problem}")
    found["import"] = worth / (time.monotonic() - begun)
    return found
