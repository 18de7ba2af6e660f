"""kill -9 at random moments during recording and publishing: losses, and whether all files can be opened.

Media, coordinator, control and reception are killed in turn, each in a recorded run. The worker is killed during its
jobs. The program that kills measures the time of each kill on the clock that also gives the rows their times.
"""

from __future__ import annotations

import json
import os
import random
import signal
import sqlite3
import subprocess
import sys
import time
from collections import deque
from collections.abc import Collection, Iterator, Mapping
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks.labs import ROOT
from benchmarks.recording_alone import append, manifest
from benchmarks.recording_pace import FPS, Frames
from runtime.core.errors import RecordingError
from runtime.core.restart_window import MOST_RESTARTS, RESTART_WINDOW_S
from runtime.datasets.consistency import check
from runtime.datasets.layout import INFO
from runtime.datasets.reader import open_dataset
from runtime.recording.base import Outcome
from runtime.recording.episode import EpisodeJournal
from runtime.recording.reader import Episode, open_episode
from runtime.recording.settings import RecordingSettings
from tests.crash.lab import Lab
from tests.processes import PATIENCE_S, eventually

EPISODES = 6  # for the worker
PROCESSES = ("media", "coordinator", "control", "reception")
_SPREAD_S = (1.0, 3.5)  # window of the kill within a recording
_WORKING_S = (0.0, 1.5)  # window of the kill after a worker's first job
_CLOSED_S = 120.0
_PUBLISHED_S = 180.0
RUNNING = "select key, owner from jobs_job where status = 'running'"


@dataclass(frozen=True, slots=True)
class KillCount:
    """Number of kills: `most`, or as many as can be made in `seconds` [s], but at least `least`."""

    most: int
    least: int
    seconds: float

    def moments(self, seed: int, between: tuple[float, float]) -> Iterator[float]:
        """Yield for each kill how long after the beginning of the interrupted activity the kill happens [s].

        The times are drawn from the range `between`.
        """
        drawn, begun = random.Random(seed), time.monotonic()
        for number in range(self.most):
            if number >= self.least and time.monotonic() - begun > self.seconds:
                return
            yield drawn.uniform(*between)


def kill_recording(lab: Lab, many: KillCount, seed: int) -> list[dict[str, Any]]:
    """Return one row per kill: process, time of the kill, loss [s], and how the episode ended."""
    kills: deque[float] = deque(maxlen=MOST_RESTARTS)
    moments = enumerate(many.moments(seed, _SPREAD_S))
    return [_one(lab, PROCESSES[number % len(PROCESSES)], moment, kills) for number, moment in moments]


def _one(lab: Lab, process: str, moment: float, kills: deque[float]) -> dict[str, Any]:
    if len(kills) == kills.maxlen:  # the supervisor gives up a station whose processes end more often
        time.sleep(max(0.0, kills[0] + RESTART_WINDOW_S + 1.0 - time.monotonic()))
    lab.reach("idle", "ready")
    lab.ready()
    lab.client.command("run")
    uuid = lab.client.wait(lambda status: status["recording"]["uuid"], PATIENCE_S)["recording"]["uuid"]
    before = lab.pids()
    time.sleep(moment)
    lab.kill(process)
    killed = time.monotonic()
    kills.append(killed)
    folder = lab.data / "episodes" / uuid
    episode = _closed(folder)
    eventually(lambda: lab.pids()[process] != before[process], f"another {process}")
    eventually(lab.answers, "the station answers again")
    lab.reach("idle")
    return {"process": process, "after_s": moment, **_loss(episode, killed)}


def _closed(folder: Path) -> Episode:
    deadline = time.monotonic() + _CLOSED_S
    while not (folder / "outcome.json").exists():
        if time.monotonic() > deadline:
            raise SystemExit(f"{folder.name} was not completed within {_CLOSED_S:g} s of a kill")
        time.sleep(0.02)
    return open_episode(folder)


def _loss(episode: Episode, killed: float) -> dict[str, Any]:
    """Return the time from the last complete row, including its period, until the kill [s].

    If there is no row, the time begins with the episode.
    """
    times = episode.rows.column("tick_time").to_numpy()
    started = float(episode.manifest["started_monotonic"])  # type: ignore[arg-type]
    left = killed - (started + times[-1] + 1.0 / episode.layout.fps if len(times) else started)
    outcome = episode.outcome or {}
    return {
        "lost_s": max(0.0, float(left)),
        "frames": episode.frames,
        "uuid": episode.layout.uuid,
        "status": outcome.get("status"),
    }


# --- the worker ------------------------------------------------------------------------------------------------


def make_episodes(data: Path, frames: Path, episodes: int = EPISODES) -> None:
    """Create `episodes` finished episodes of two seconds for the worker to publish."""
    pictures = Frames(frames)
    for _ in range(episodes):
        journal = EpisodeJournal(data / "episodes", RecordingSettings(min_free_bytes=0), patient=True)
        journal.begin(manifest())
        for index in range(2 * FPS):
            append(journal, index, pictures(index))
        journal.end(Outcome("finished", "the frames have ended", time.time()))


def kill_worker(data: Path, many: KillCount, seed: int) -> list[dict[str, Any]]:
    """Kill the worker during its jobs, then let one worker finish; return a row per kill and a last row with the
    result.

    Key `problems` of each row has sentences about files that cannot be opened.
    """
    environment = os.environ | {
        "EVA_DATA_DIR": str(data),
        "EVA_LOG_LEVEL": "ERROR",
        "EVA_JOB_STALE_S": "12",  # short, because the benchmark waits until a dead worker's job is reclaimed
    }
    requested = _ask(environment)
    rows = []
    dead: set[str] = set()
    for moment in many.moments(seed, _WORKING_S):
        with _worker(environment) as worker:
            job, owner = _working(data, worker, dead)
            time.sleep(moment)
            worker.kill()
        dead.add(owner)
        measured = {"job": job, "problems": _problems(data)}
        rows.append({"process": "worker", "after_s": moment, "lost_s": 0.0, **measured})
        _ask(environment)
    with _worker(environment) as worker:
        _published(data, worker, requested)
        worker.send_signal(signal.SIGTERM)
    missing = _missing_s(data, requested)
    rows.append({"process": "worker", "after_s": None, "lost_s": missing, "problems": _problems(data)})
    return rows


def _ask(environment: Mapping[str, str]) -> list[str]:
    """Enqueue the publication of every closed episode, also of those published already; return their uuids."""
    command = [sys.executable, "-m", "benchmarks.recording_jobs"]
    completed = subprocess.run(
        command, cwd=ROOT, env=environment, stdout=subprocess.PIPE, check=True, text=True
    )
    episodes: list[str] = json.loads(completed.stdout.splitlines()[-1])
    return episodes


@contextmanager
def _worker(environment: Mapping[str, str]) -> Iterator[subprocess.Popen[bytes]]:
    command = [sys.executable, "manage.py", "worker"]
    with subprocess.Popen(command, cwd=ROOT, env=environment, stdout=subprocess.DEVNULL) as child:
        try:
            yield child
        finally:
            if child.poll() is None and sys.exc_info()[0] is not None:
                child.kill()


def _working(data: Path, worker: subprocess.Popen[bytes], dead: Collection[str]) -> tuple[str, str]:
    """Return key and owner of this worker's first job; jobs of owners in `dead` may still be listed and do not
    count.
    """
    begun = time.monotonic()
    while time.monotonic() - begun < 60.0 and worker.poll() is None:
        for key, owner in _query(data, RUNNING):
            if owner not in dead:
                return str(key), str(owner)
        time.sleep(0.02)
    raise SystemExit(f"the worker took no job ({worker.poll()})")


def _published(data: Path, worker: subprocess.Popen[bytes], requested: list[str]) -> None:
    begun = time.monotonic()
    while _query(data, "select 1 from jobs_job where status in ('queued', 'running') limit 1"):
        if time.monotonic() - begun > _PUBLISHED_S or worker.poll() is not None:
            raise SystemExit(f"the jobs of {len(requested)} episodes were not done within {_PUBLISHED_S:g} s")
        time.sleep(0.1)


def _missing_s(data: Path, requested: list[str]) -> float:
    """Return the longest part of a recording that is missing in its dataset [s]; all of it if it is not published."""
    worst = 0.0
    for uuid in requested:
        episode = open_episode(data / "episodes" / uuid)
        query = f"select dataset, dataset_index from episodes_episode where uuid = '{uuid.replace('-', '')}'"
        ((dataset, index),) = _query(data, query)
        published = open_dataset(data / dataset).entry(index).length if dataset else 0
        worst = max(worst, (episode.frames - published) / episode.layout.fps)
    return worst


def _query(data: Path, query: str) -> list[Any]:
    (database,) = data.glob("*.sqlite3")
    with closing(sqlite3.connect(f"file:{database}?mode=ro", uri=True, timeout=10.0)) as connection:
        return connection.execute(query).fetchall()


def _problems(data: Path) -> list[str]:
    """Return sentences about datasets and episodes that cannot be opened as they are, before any repair."""
    datasets = [info.parents[1] for info in data.glob(f"datasets/**/{INFO}")]
    problems = [f"{dataset.name}: {problem}" for dataset in datasets for problem in check(dataset)]
    for folder in data.glob("episodes/*"):
        try:
            open_episode(folder)
        except RecordingError as error:
            problems.append(str(error))
    return problems
