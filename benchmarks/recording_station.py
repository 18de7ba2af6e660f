"""Recording by a complete station: cost, delay until frames are on disk, end of the run, and publication."""

from __future__ import annotations

import subprocess
import sys
import threading
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import av
import numpy as np
import psutil

from benchmarks.busy_lab import PATIENT
from benchmarks.labs import ROOT
from runtime.recording.reader import Episode, open_episode
from tests.crash.lab import Lab
from tests.processes import PATIENCE_S

SIZE = ("--width", "640", "--height", "480")
_SETTLED_S = 3.0  # start of a recording, until encoders, queues and pools are allocated
_SIZES_PERIOD_S = 0.01
_MEMORY_PERIOD_S = 0.5


class PatientLab(Lab):
    """Lab that tolerates slow starts of its processes on a busy machine."""

    def ready(self, **asked: Any) -> PatientLab:
        """Set up the station; try again while a killed process is restarting.

        Raises:
            AssertionError: If it remains impossible.
        """
        begun = time.monotonic()
        while True:
            try:
                super().ready(**asked)
            except AssertionError:
                if time.monotonic() - begun > 2 * PATIENCE_S:
                    raise
                time.sleep(1.0)
            else:
                return self


class Watch:
    """Observer of the memory of two processes and of the sizes of an episode's videos, in a thread until `end`."""

    def __init__(self, media: psutil.Process, reception: psutil.Process, folder: Path) -> None:
        self._media, self._reception = media, reception
        self._folder = folder
        self._ending = threading.Event()
        self.memory: list[float] = []  # resident memory of media [MB], every half second after settling
        self.processor = self.receiving = 0.0  # processor time of media, and of reception [s], after settling
        self.seconds = 0.0
        self.sizes: dict[
            str, list[tuple[float, int]]
        ] = {}  # (monotonic time, bytes) whenever a video has grown
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def end(self) -> None:
        """Stop observing."""
        self._ending.set()
        self._thread.join()

    def _run(self) -> None:
        settled = time.monotonic() + _SETTLED_S
        while not self._ending.wait(_SIZES_PERIOD_S) and time.monotonic() < settled:
            self._poll()
        self.memory.append(resident_mb(self._media))
        begun, before, received = time.monotonic(), _used(self._media), _used(self._reception)
        next_memory = begun + _MEMORY_PERIOD_S
        while not self._ending.wait(_SIZES_PERIOD_S):
            self._poll()
            if time.monotonic() >= next_memory:
                next_memory += _MEMORY_PERIOD_S
                self.memory.append(resident_mb(self._media))
        self.processor, self.receiving = _used(self._media) - before, _used(self._reception) - received
        self.seconds = time.monotonic() - begun

    def _poll(self) -> None:
        for video in self._folder.glob("*.mp4"):
            size = video.stat().st_size
            samples = self.sizes.setdefault(video.stem, [])
            if not samples or samples[-1][1] != size:
                samples.append((time.monotonic(), size))


def resident_mb(process: psutil.Process) -> float:
    """Return the resident memory of a process [MB]."""
    return float(process.memory_info().rss) / 1e6


def _used(process: psutil.Process) -> float:
    times = process.cpu_times()
    return float(times.user + times.system)


def record(folder: Path, seconds: float) -> dict[str, Any]:
    """Start a station with three cameras of 640x480 at 30 Hz, record a run of `seconds`, end it and publish the
    episode.
    """
    lab = PatientLab(folder)
    try:
        lab.node(*SIZE).server()
        lab.up(*PATIENT, f"run.duration_s={seconds + 600}", "bus.preview_rate=15")
        media, reception = (psutil.Process(lab.pids()[name]) for name in ("media", "reception"))
        lab.ready()
        before = resident_mb(media), _used(media) + _used(reception), time.monotonic()
        time.sleep(_SETTLED_S)
        idle = (_used(media) + _used(reception) - before[1]) / (time.monotonic() - before[2]) * 100.0
        missed = _missed(lab)
        lab.client.command("run")
        uuid = lab.client.wait(lambda status: status["recording"]["uuid"], 2 * PATIENCE_S)["recording"][
            "uuid"
        ]
        episode = lab.data / "episodes" / uuid
        watch = Watch(media, reception, episode)
        time.sleep(seconds)
        stopped = time.monotonic()
        lab.client.command("stop")
        while not (episode / "outcome.json").exists():
            if time.monotonic() - stopped > 60.0:
                raise SystemExit(f"episode {uuid} was not closed within 60 s of the stop")
            time.sleep(0.002)
        saved = time.monotonic() - stopped
        watch.end()
        missed = _missed(lab) - missed
    finally:
        lab.close()
    recorded = open_episode(episode)
    return {
        "seconds": seconds,
        "cpu_core_percent": (watch.processor + watch.receiving) / watch.seconds * 100.0,
        "cpu_core_percent_reception": watch.receiving / watch.seconds * 100.0,
        "cpu_core_percent_not_recording": idle,
        "memory_mb": {
            "before": before[0],
            "start": watch.memory[0],
            "end": watch.memory[-1],
            "peak": max(watch.memory),
        },
        **lost(recorded, missed),
        "to_disk_ms": to_disk(recorded, watch.sizes),
        "muxed_ms": recorded.outcome and recorded.outcome["muxed_ms"],
        "skew": recorded.outcome and recorded.outcome["skew"],
        "stop_to_saved_s": saved,
        **published(episode, folder / "dataset", recorded.frames),
    }


def _missed(lab: Lab) -> int:
    """Return the number of observations that the node sent but the station did not receive."""
    return int(lab.client.status()["link"]["faults"].get("frames_lost", 0))


def lost(episode: Episode, missed: int = 0) -> dict[str, Any]:
    """Return counts of missing rows of the grid, and of images that were given but are not in the video.

    `missed` is the number of observations that were not received; their images are included. The keys `grid_repeats`
    and `grid_skips` count no losses: they exist because source and grid have independent clocks of 30 Hz.
    """
    rows, outcome = episode.rows, episode.outcome or {}
    times = rows.column("tick_time").to_numpy()
    expected = 1 + round((times[-1] - times[0]) * episode.layout.fps)
    dropped = repeats = 0
    for camera in episode.layout.cameras:
        captured = rows.column(f"capture_time.{camera}").to_numpy()
        repeated = rows.column(f"repeated.{camera}").to_numpy()
        changed = np.concatenate([[True], captured[1:] != captured[:-1]]) & np.isfinite(captured)
        dropped += int((repeated & changed).sum())
        repeats += int((repeated & ~changed).sum())
    frames: Mapping[str, int] = outcome["video_frames"]  # type: ignore[assignment]
    row_count = int(outcome.get("rows", len(times)))  # type: ignore[call-overload]
    short = sum(max(0, row_count - frames[camera]) for camera in episode.layout.cameras)
    steps = np.diff(rows.column("sequence").to_numpy())
    absent = max(0, expected - len(times)) + missed
    return {
        "status": outcome.get("status"),
        "reason": outcome.get("reason"),
        "rows": len(times),
        "frames_lost": dropped + short + absent * len(episode.layout.cameras),
        "not_received": missed,
        "not_encoded": dropped + short,
        "grid_repeats": repeats,
        "grid_skips": max(0, int(np.maximum(steps - 1, 0).sum()) - missed) * len(episode.layout.cameras),
    }


def to_disk(episode: Episode, sizes: Mapping[str, list[tuple[float, int]]]) -> dict[str, float]:
    """Return the time from an image's capture until its packet is completely in the file [ms].

    The sizes of the files are observed from another process.
    """
    started = float(episode.manifest["started_monotonic"])  # type: ignore[arg-type]
    delays_ms: list[float] = []
    for camera, video in episode.videos.items():
        times, grown = (np.array(column) for column in zip(*sizes[video.stem], strict=True))
        with av.open(str(video)) as container:
            ends = [(packet.pos or 0) + packet.size for packet in container.demux(video=0) if packet.size]
        captured = episode.rows.column(f"capture_time.{camera}").to_numpy() + started
        repeated = episode.rows.column(f"repeated.{camera}").to_numpy()
        count = min(len(ends), len(captured))
        places = np.searchsorted(grown, ends[:count])  # first observation of at least that many bytes
        usable = (places < len(times)) & np.isfinite(captured[:count]) & ~repeated[:count]
        delays_ms.extend((times[places[usable]] - captured[:count][usable]) * 1000.0)
    if not delays_ms:
        raise SystemExit(f"no frame of {episode.path} was seen to reach its file")
    p50, p99, longest = (float(value) for value in np.percentile(delays_ms, (50, 99, 100)))
    return {"p50": p50, "p99": p99, "max": longest}


def published(episode: Path, dataset: Path, frames: int) -> dict[str, Any]:
    """Publish an episode into a dataset by the command line.

    Return the duration, and the number of encoded frames, of the first `frames` of each video, that differ from the
    recording.
    """
    command = [sys.executable, "-m", "runtime.datasets", "publish", str(episode), "--to", str(dataset)]
    command.append("--include-interrupted")  # measure it even if the run failed on a busy machine
    begun = time.monotonic()
    subprocess.run(command, cwd=ROOT, check=True, stdout=subprocess.DEVNULL)
    took = time.monotonic() - begun
    differing = 0
    for recorded in sorted(episode.glob("*.mp4")):
        (copied,) = dataset.glob(f"videos/**/*{recorded.stem}*/*.mp4")
        pairs = zip(_packets(recorded)[:frames], _packets(copied), strict=True)
        differing += sum(left != right for left, right in pairs)
    return {"publish_s": took, "publish_changed_frames": differing}


def _packets(video: Path) -> list[bytes]:
    with av.open(str(video)) as container:
        return [bytes(packet) for packet in container.demux(video=0) if packet.size]
