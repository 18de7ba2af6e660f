"""Lab whose processes are killed while trials are run and scored; at the end, everything it acknowledged is counted.

Lab and one station with a simulated robot are connected over loopback, each with its own data folder. At random times,
drawn from the seed, a process of the lab or the station is killed (SIGKILL), or the link is paused for seconds
(SIGSTOP), as if it were cut. The supervisors of lab and station, which restart the other processes, are never killed,
nor are the simulated robot and the policy. A station whose processes end six times within a minute ends for good, so at
most four are killed per minute.

With `--long`, the lab has its own PostgreSQL and Redis servers, which are crashed and started again like the rest.
"""

from __future__ import annotations

import json
import os
import random
import secrets
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from contextlib import ExitStack
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any
from uuid import uuid4

import psutil

from benchmarks.estop_lab import PRESSED
from benchmarks.lab import enrol, two_free_ports
from benchmarks.labs import RunningLab, lab
from benchmarks.report import Figure, Report
from benchmarks.servers import postgresql, redis, why_no_postgresql, why_no_redis
from benchmarks.start import started
from evaweb.lab.rest_client import RestClient
from evaweb.lab.stall_detection import DemoFailed, NoReply
from tests.crash.lab import ROOT, Lab

SECONDS = 600.0
_PAUSE_S = (3.0, 9.0)  # between two kills
_STOPPED_S = (1.0, 4.0)
_RUN_S = (1.0, 6.0)
_MOST_OF_STATION = 4  # kills per minute
_AGAIN_S = 0.3
_PATIENCE_S = 90.0
_REST_S = 180.0
_OF_LAB = ("serve", "stops", "worker", "gate")
_OF_STATION = ("control", "coordinator", "reception", "media", "guard", "link")


@dataclass(frozen=True, slots=True)
class Act:
    """Request that was acknowledged with status 2xx: `prepare`, `run` with its episode, or `score` with its uuid."""

    kind: str
    trial: int
    uuid: str = ""
    episode: str = ""


@dataclass(slots=True)
class DataAtEnd:
    """Contents of the database and of both data folders at the end."""

    trials: dict[int, str] = field(default_factory=dict)  # status
    scores: list[tuple[int, str]] = field(default_factory=list)  # trial, uuid
    rows: set[str] = field(default_factory=set)  # episodes
    trial_episodes: list[str] = field(default_factory=list)
    folders: set[str] = field(default_factory=set)  # episodes with an outcome at the lab
    at_home: set[str] = field(default_factory=set)  # episodes at the station
    unopened: set[str] = field(default_factory=set)  # runs that never began according to the lab
    refusing: list[str] = field(default_factory=list)  # stations that refuse new trials


_OVER = ("scored", "voided", "abandoned")


def counted(acts: Iterable[Act], found: DataAtEnd) -> dict[str, list[str]]:
    """Return the faults by name of the figure that counts them.

    A fault is anything that was acknowledged and is lost, that exists twice, or that remained unfinished.
    """
    acts = list(acts)
    runs = {act.episode: act for act in acts if act.kind == "run" and act.uuid not in found.unopened}
    scores = {act.uuid for act in acts if act.kind == "score"}
    stored = {uuid for _, uuid in found.scores}
    prepared = {act.trial for act in acts if act.kind == "prepare"}
    doubled = [f"score {uuid}" for uuid, n in Counter(uuid for _, uuid in found.scores).items() if n > 1]
    scored = Counter(trial for trial, _ in found.scores)
    doubled += [f"trial {trial} has {n} scores" for trial, n in scored.items() if n > 1]
    doubled += [
        f"episode {uuid} is that of {n}" for uuid, n in Counter(found.trial_episodes).items() if n > 1
    ]
    doubled += [f"trial {trial} was prepared by nobody" for trial in found.trials if trial not in prepared]
    in_lab = found.rows & found.folders
    return {
        "lost_episodes": sorted(set(runs) - (found.rows & (found.folders | found.at_home))),
        "lost_scores": sorted(scores - stored),
        "lost_trials": sorted(str(trial) for trial in prepared - set(found.trials)),
        "doubled": doubled,
        "stuck_trials": [f"trial {n} is {s}" for n, s in found.trials.items() if s not in _OVER]
        + found.refusing,
        "lost_after_delete": sorted(set(runs) - found.at_home - in_lab),
    }


class _Operator(threading.Thread):
    """Thread that prepares, runs, ends and scores trials over REST, and records each acknowledged request."""

    def __init__(self, running: RunningLab, chance: random.Random) -> None:
        super().__init__(daemon=True)
        self.acts: list[Act] = []
        self.said: Counter[str] = Counter()  # refusals and missing answers
        self.over = threading.Event()
        self.voided = 0  # at the end, because scores were refused
        self._visitor = RestClient(running.visitor.url)
        self._password = running.announced["passwords"]["operator"]
        self._chance, self._page, self._logged_in = chance, uuid4().hex, False

    def run(self) -> None:
        while not self.over.is_set():
            self.once()

    def once(self) -> bool:
        """Run one trial from begin to end, or finish the open one; return True if it was completed."""
        try:
            return self._trial()
        except (
            DemoFailed
        ) as fault:  # refused, or unanswered for long: start again from the current state, as a person would
            self.said[str(fault)[:160]] += 1
            time.sleep(_AGAIN_S)
            return False

    def leave_none(self, number: int) -> str:
        """Score a trial that was left open, or void it; return "", or the reason if neither was possible."""
        try:
            self._end(number)
            return ""
        except DemoFailed as fault:
            self.said[f"at rest: {fault}"[:160]] += 1
        try:
            self._request("post", f"trials/{number}/void", {"reason": "left behind"})
            self.voided += 1
            return ""
        except DemoFailed as fault:
            return str(fault)

    def _trial(self) -> bool:
        opened = self._poll()["trial"]
        number = int(opened["id"] if opened else self._prepare()["id"])
        if not opened or opened["status"] == "prepared":
            self._act(Act("prepare", number))  # also if the answer was lost: a page would show the trial
            self._command("setup", number)
            self._state("ready", "idle", "faulted")
            self._begin(number)
            time.sleep(self._chance.uniform(*_RUN_S))
        return self._end(number)

    def _prepare(self) -> Mapping[str, Any]:
        choice = {"scene": "block-on-plate", "position": 1, "checkpoint": "chaos"}
        return self._request("post", f"stations/{PRESSED}/trials", choice, again=False)

    def _begin(self, number: int) -> None:
        answer = self._command("run", number)
        self._act(Act("run", number, answer["uuid"], answer["data"]["episode"]))

    def _end(self, number: int) -> bool:
        until = time.monotonic() + _PATIENCE_S
        while (status := self._request("get", f"trials/{number}")["status"]) in ("running", "paused"):
            if time.monotonic() > until:
                raise DemoFailed(f"trial {number} stays {status}")
            if "stop" in (self._poll()["snapshot"] or {}).get("allowed", ()):
                self._command("stop")
            time.sleep(_AGAIN_S)
        if status in ("ended", "interrupted"):
            steps = self._request("get", "scenes/block-on-plate")["milestones"]
            reached = {str(step["id"]): self._chance.random() < 0.5 for step in steps}
            uuid = str(uuid4())
            self._request("post", f"trials/{number}/score", {"milestones": reached, "uuid": uuid})
            self._act(Act("score", number, uuid))
        return status in ("ended", "interrupted", *_OVER)

    def _command(self, kind: str, trial: int | None = None) -> Mapping[str, Any]:
        epoch = self._request("post", f"stations/{PRESSED}/lease", {"action": "claim", "page": self._page})[
            "epoch"
        ]
        state = self._poll()["snapshot"] or {}
        order = {"uuid": str(uuid4()), "kind": kind, "page": self._page, "epoch": epoch, "trial": trial}
        decided = {"boot": state.get("boot", ""), "sequence": state.get("sequence", 0)}
        return self._request("post", f"stations/{PRESSED}/commands", order | decided)

    def _state(self, *wanted: str) -> None:
        until = time.monotonic() + _PATIENCE_S
        while (self._poll()["snapshot"] or {}).get("state") not in wanted and time.monotonic() < until:
            time.sleep(_AGAIN_S)

    def _poll(self) -> Mapping[str, Any]:
        return self._request("get", f"stations/{PRESSED}")

    def _act(self, act: Act) -> None:
        if act not in self.acts:
            self.acts.append(act)

    def _request(self, verb: str, *given: Any, again: bool = True) -> Mapping[str, Any]:
        """Send a request by the client's method `verb` and return the answer.

        With `again`, a request without an answer, or with an unknown outcome (504), is repeated.
        """
        until = time.monotonic() + _PATIENCE_S
        while True:
            try:
                if not self._logged_in:
                    self._visitor.login("operator", self._password)
                    self._logged_in = True
                answer: Mapping[str, Any] = getattr(self._visitor, verb)(*given)
                return answer
            except DemoFailed as fault:
                unknown = isinstance(fault, NoReply) or "HTTP 50" in str(fault)
                self._logged_in = self._logged_in and "HTTP 401" not in str(fault)
                if not (unknown and again) or time.monotonic() > until:
                    raise
                self.said["no answer: the same again"] += 1
            except OSError as fault:  # broken connections that urllib does not wrap
                if not again or time.monotonic() > until:
                    raise NoReply(str(fault)) from None
                self.said["no answer: the same again"] += 1
            time.sleep(_AGAIN_S)


def _name(process: psutil.Process) -> str:
    """Return the name of a process that belongs to lab or station, "" for any other process."""
    arguments = process.cmdline()
    names = [
        name
        for name in _OF_LAB
        if any(argument.endswith("manage.py") for argument in arguments) and name in arguments
    ]
    names += [name for name in _OF_STATION if f"runtime.processes.{name}.process" in arguments]
    names += ["link"] if "runtime.link" in arguments else []
    return names[0] if names else ""


def _ours(*parents: psutil.Process) -> dict[str, psutil.Process]:
    """Return the current processes by name; of several with the same name the first."""
    by_name: dict[str, psutil.Process] = {}
    for parent in parents:
        for child in parent.children(recursive=False):
            try:
                by_name.setdefault(_name(child), child)
            except psutil.Error:  # it has just ended
                continue
    by_name.pop("", None)
    return by_name


def _hurt(
    parents: tuple[psutil.Process, ...],
    crashes: Mapping[str, Callable[[], None]],
    seconds: float,
    chance: random.Random,
) -> Counter[str]:
    """Kill and pause processes for `seconds`, and crash the servers in `crashes`; return how often, by name."""
    counts: Counter[str] = Counter()
    of_station: list[float] = []
    until = time.monotonic() + seconds
    while (now := time.monotonic()) < until:
        time.sleep(min(chance.uniform(*_PAUSE_S), until - now))
        of_station = [at for at in of_station if at > time.monotonic() - 60.0]
        name = chance.choice((*_OF_LAB, *_OF_STATION, "link stopped", *crashes))
        if name in crashes:
            crashes[name]()
            counts[name] += 1
            continue
        process = _ours(*parents).get(name.split()[0])
        if process is None or (name in _OF_STATION and len(of_station) >= _MOST_OF_STATION):
            continue
        try:
            if name == "link stopped":
                process.send_signal(signal.SIGSTOP)
                time.sleep(chance.uniform(*_STOPPED_S))
                process.send_signal(signal.SIGCONT)
            else:
                process.kill()
                of_station += [time.monotonic()] if name in _OF_STATION else []
        except psutil.NoSuchProcess:  # it has ended by itself
            continue
        counts[name] += 1
    return counts


def _servers(folder: Path, stack: ExitStack) -> dict[str, Callable[[], None]]:
    """Start PostgreSQL and Redis for this process and its children; return how to crash each."""
    if missing := why_no_postgresql() or why_no_redis():
        raise SystemExit(f"chaos --long needs PostgreSQL and Redis: {missing}")
    store = stack.enter_context(postgresql(folder / "postgresql"))
    broker = stack.enter_context(redis(folder / "redis"))
    os.environ.update(DATABASE_URL=store.url, REDIS_URL=broker.url)
    return {"postgresql": store.crash, "redis": broker.crash}


def measure(seconds: float, seed: int | None = None, *, long: bool = False) -> Report:
    """Kill processes for `seconds`, with `long` also PostgreSQL and Redis, then measure what was lost.

    The figures are `lost_episodes`, `lost_scores`, `lost_trials`, `doubled`, `stuck_trials` and `lost_after_delete`.
    """
    seed = secrets.randbelow(2**31) if seed is None else seed
    chance = random.Random(seed)
    with tempfile.TemporaryDirectory(prefix="chaos") as name, ExitStack() as stack:
        folder = Path(name)
        crashes = _servers(folder, stack) if long else {}
        robot = folder / PRESSED
        robot.mkdir()
        extra = {"EVA_GATE": f"127.0.0.1:{two_free_ports()}", "EVA_GATE_NAME": "127.0.0.1"}
        os.environ.update(
            extra, EVA_DATA_DIR=str(folder / "data"), EVA_LOG_LEVEL="WARNING", EVA_KEEP_DAYS="0"
        )
        bench = Lab(robot)
        try:
            ready = folder / "ready.json"
            with lab(["-m", "benchmarks.linked_lab", str(ready)], ready, extra) as running:
                node = bench.node("--bench", "tabletop").addresses["node"]
                _rows(bench.server().addresses["server"]["url"])
                patient = (
                    *("recording.export=false", "lease.ttl_s=30.0"),
                    *("safety.joint_age_s=10.0", "safety.picture_age_s=10.0"),
                )
                with started(node, robot, f'station="{PRESSED}"', *patient) as station:
                    enrol(robot, running.announced["enrol"][PRESSED])
                    operator = _Operator(running, random.Random(seed + 1))
                    operator.start()
                    parents = (running.process, station.processes["supervisor"])
                    hurt = _hurt(parents, crashes, seconds, chance)
                    operator.over.set()
                    operator.join()
                    state = _at_rest(operator, robot, folder / "data")
        finally:
            bench.close()
    wrong = counted(operator.acts, state)
    kinds = Counter(act.kind for act in operator.acts)
    figures = [Figure(name, float(len(things)), "", "== 0") for name, things in wrong.items()]
    figures += [Figure(f"acknowledged.{kind}", float(n), "") for kind, n in sorted(kinds.items())]
    figures += [Figure(f"killed.{kind}", float(n), "") for kind, n in sorted(hurt.items())]
    figures += [Figure("never_begun", float(len(state.unopened)), "")]
    figures += [Figure("removed_at_home", float(len(state.folders - state.at_home)), "")]
    figures += [Figure("voided_at_rest", float(operator.voided), "")]
    rows = [{"seed": seed, "long": long, "wrong": wrong, "said": operator.said.most_common(30)}]
    return Report("chaos", figures, [*rows, *map(asdict, operator.acts)])


def _rows(policy: str) -> None:
    """Create the database rows of the scene and of the checkpoint that the trials use.

    `policy` is the url of the checkpoint's policy server.
    """
    os.environ.setdefault("DJANGO_SETTINGS_MODULE", "evaweb.settings")
    import django

    django.setup()
    from evaweb.lab import demo_rows

    demo_rows.demo_scene()
    demo_rows.demo_checkpoint(name="chaos", description="", policy={"url": policy})


def _at_rest(operator: _Operator, robot: Path, data: Path) -> DataAtEnd:
    """Run one more trial, wait for transfers, finish open trials, reconcile, and return the contents."""
    from django.db import connections

    from evaweb.stations.models import Command
    from evaweb.trials.models import Score, Trial

    connections.close_all()  # PostgreSQL has been restarted since they were opened
    until, worked, before = time.monotonic() + _REST_S, False, len(operator.acts)
    while not worked and time.monotonic() < until:
        worked = operator.once() and any(act.kind == "run" for act in operator.acts[before:])
    while time.monotonic() < until and _closed(robot) - _closed(data):
        time.sleep(1.0)
    left = Trial.objects.filter(status__in=("ended", "interrupted")).values_list("pk", flat=True)
    for number in list(left):
        if reason := operator.leave_none(number):
            operator.said[f"stuck: {reason}"[:200]] += 1
    command = [sys.executable, str(ROOT / "manage.py"), "reconcile"]
    subprocess.run(command, cwd=ROOT, check=True, stdout=subprocess.DEVNULL)
    runs = Command.objects.filter(kind="run").exclude(unopened="")
    trials = Trial.objects.values_list("pk", "status", "episode_id")
    from evaweb.episodes.models import Episode

    return DataAtEnd(
        trials={pk: status for pk, status, _ in trials},
        scores=[(trial, str(uuid)) for trial, uuid in Score.objects.values_list("trial_id", "uuid")],
        rows={str(uuid) for uuid in Episode.objects.values_list("pk", flat=True)},
        trial_episodes=[str(uuid) for _, _, uuid in trials if uuid],
        folders=_closed(data),
        at_home=_closed(robot),
        unopened={str(uuid) for uuid in runs.values_list("pk", flat=True)},
        refusing=[] if worked else [f"{PRESSED}: {json.dumps(operator.said.most_common(3))}"],
    )


def _closed(data: Path) -> set[str]:
    return {path.parent.name for path in data.glob("episodes/*/outcome.json")}
