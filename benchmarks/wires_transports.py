"""Delay of observations through each transport: three cameras and joints, from the sender to the control loop.

Sender, receiving side (`benchmarks.wires_receiver`, like reception) and control loop are separate processes. The
control loop is this process: it polls shared state at 100 Hz, so that its readings are uniformly distributed between
two images. Live images of 640x480 arrive at 30 Hz. Their age is the time since the sender began to draw and encode
them; the number in the image shows when that was. Images of recordings have no sender: their age is the time since they
were due.

Afterwards another receiving side receives, as fast as possible, as many images as arrive in ten minutes of idling. The
growth of its memory is reported, counted from the end of a warm-up with further images. If this takes more than a few
times as long as the live part, it ends early, and the number of minutes is reported.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import psutil

import robots
from benchmarks.wires_cases import PATIENCE_S, Case, CaseEndpoints, CaseSetup, absent, cases, end, process
from benchmarks.wires_receiver import FPS, Receiving, layout
from runtime.core.clock import MonotonicClock
from runtime.core.types import UInt8
from runtime.ipc.shared_state import SharedState
from runtime.simulation.bench.numbered_frames import frame_number

IDLE_FRAMES = 18_900  # of each camera: half a minute of warm-up, and ten minutes
_WARM_FRAMES = 900  # after which memory should be constant
_LIVE = (480, 640)
_FLOOD = (120, 160)  # small, because a retained image counts whatever its size, and these are faster
_FLOOD_HZ = 1000.0
_IDLE_SHARE = 3.0  # of the live part, at most
_LOOKS_HZ = 100.0
_SETTLE_S = 1.5  # after the first observation
Row = dict[str, Any]


def measure(seconds: float) -> list[Row]:
    """Return a row per transport: live for `seconds`, then with the images of ten minutes as fast as possible."""
    rows: list[Row] = []
    for case in cases():
        reason = absent(case)
        rows.append({"transport": case.name, **({"absent": reason} if reason else _measured(case, seconds))})
    return rows


def _measured(case: Case, seconds: float) -> Row:
    return {**live(case, seconds), **(idle(case, _IDLE_SHARE * seconds) if case.idle else {})}


def live(case: Case, seconds: float) -> Row:
    """Return the ages of images in a control loop at the transport's usual rate, and the cost of receiving them."""
    with _staged(case, FPS, _LIVE) as (stage, shared):
        wired = case.open(stage)
        receiver = _receiving(stage, wired, fast=False)
        _await(shared, receiver, 1)
        time.sleep(_SETTLE_S)
        watched = psutil.Process(receiver.pid)
        before, begun = _processor(watched), time.monotonic()
        readings, arrivals = _control_readings(shared, seconds)
        took = time.monotonic() - begun
        used = (_processor(watched) - before) / took
        faults, sent = _ended(receiver), stage.sent()
        ages = [age for age in image_ages(readings, wired.born, sent) if age is not None]
    return {
        "cpu_percent": 100.0 * used,
        "age_ms": {f"p{q}": 1e3 * float(np.percentile(ages, q)) for q in (50, 99)},
        "observation_hz": arrivals / took,
        "sent_hz": sent_hz(sent, begun, took),
        "faults": faults,
    }


def idle(case: Case, seconds: float, frames: int = IDLE_FRAMES) -> Row:
    """Return the memory growth of the receiving side over `frames` images of each camera, or over `seconds`."""
    with _staged(case, _FLOOD_HZ, _FLOOD, hurried=True) as (stage, shared):
        wired = case.open(stage)
        receiver = _receiving(stage, wired, fast=case.played)
        watched = psutil.Process(receiver.pid)
        first = _await(shared, receiver, min(_WARM_FRAMES, frames // 2))
        warm = _resident(watched)
        last = _await(shared, receiver, frames, seconds)
        grown = _resident(watched) - warm
        faults = _ended(receiver)
    minutes = (last - first) / (60.0 * FPS)
    return {
        "idle_minutes": minutes,
        "resident_mb": (warm + grown) / 1e6,
        "growth_mb": grown / 1e6,
        "idle_faults": faults,
    }


@contextlib.contextmanager
def _staged(
    case: Case, rate: float, size: tuple[int, int], hurried: bool = False
) -> Iterator[tuple[CaseSetup, SharedState]]:
    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        shared, descriptor = SharedState.create(layout(robots.load_robot(case.robot)))
        stack.callback(os.close, descriptor)
        yield CaseSetup(stack, folder, rate, size, case.robot, descriptor, hurried), shared


def _receiving(stage: CaseSetup, wired: CaseEndpoints, fast: bool) -> subprocess.Popen[str]:
    """Start the receiving process, which fills the shared state."""
    options = Receiving(stage.robot, wired.transport, stage.page, wired.cameras, fast)
    command = [sys.executable, "-m", "benchmarks.wires_receiver", options.text()]
    return stage.stack.enter_context(process(command, stage.page))


def _await(
    shared: SharedState, receiver: subprocess.Popen[str], frames: int, seconds: float = math.inf
) -> int:
    """Wait until `frames` images of every camera have arrived, or for `seconds`; return their number.

    Raises:
        SystemExit: If no more arrive.
    """
    newest, since = 0, time.monotonic()
    latest = since + seconds
    while newest < frames and time.monotonic() < latest:
        time.sleep(0.02)
        now = int(shared.observation.read()["picture_number"].min())
        if now > newest:
            newest, since = now, time.monotonic()
        if receiver.poll() is not None or time.monotonic() - since > PATIENCE_S:
            raise SystemExit(
                f"{newest} of {frames} pictures of each camera came, then none for {PATIENCE_S:g} s"
            )
    return newest


Look = list[
    tuple[UInt8 | None, float, float]
]  # per camera: head and foot of the image, capture time, current time


def _control_readings(shared: SharedState, seconds: float) -> tuple[list[Look], int]:
    """Return the readings of a control loop at each of its ticks, and the number of observations in that time."""
    clock = MonotonicClock()
    first = int(shared.observation.read()["sequence"])
    readings: list[Look] = []
    start = clock.now()
    for tick in range(int(seconds * _LOOKS_HZ)):
        clock.sleep_until(start + tick / _LOOKS_HZ)
        now, record = clock.now(), shared.observation.read()
        reading: Look = []
        for index, camera in enumerate(shared.layout.cameras):
            picture = shared.pictures[camera].read(int(record["picture_number"][index]))
            captured = float(record["picture_captured"][index])
            reading.append((None if picture is None else number_marks(picture), captured, now))
        readings.append(reading)
    return readings, int(shared.observation.read()["sequence"]) - first


def number_marks(picture: UInt8) -> UInt8:
    """Return the parts of an image that encode its number: the strip at its top and the bar at its bottom."""
    return np.concatenate([picture[:16], picture[-16:]])


def image_ages(looks: Sequence[Look], born: str, sent: Any) -> list[float | None]:
    """Return for each tick the age of the oldest image [s].

    The age is None if the start time of any image is unknown, because this image was being overwritten.

    Args:
        looks: For each tick, what the control loop read from each camera.
        born: How the start time of an image is found: "due", "strip" or another word, see `_birth`.
        sent: Start times recorded by the sender.
    """
    ages: list[float | None] = []
    for reading in looks:
        births = [_birth(index, *entry, born, sent) for index, entry in enumerate(reading)]
        known_births = [birth for birth in births if birth is not None]
        ages.append(reading[0][2] - min(known_births) if len(known_births) == len(reading) else None)
    return ages


def sent_hz(sent: Any, begun: float, took: float) -> float | None:
    """Return the rate that the sender achieved [Hz]; None for recordings."""
    streams = [stream for stream in (sent if sent and isinstance(sent[0], list) else [sent]) if stream]
    rates = [sum(begun <= at <= begun + took for at in stream) / took for stream in streams]
    return min(rates, default=None)


def _birth(
    camera: int, marks: UInt8 | None, captured: float, now: float, born: str, sent: Any
) -> float | None:
    """Return when the sender began an image [s]; None if the marks of the image could not be read.

    `born` names how this time is found. "due": the image has no sender and began when it was due, at `captured`.
    "strip": the number in the strip of the image is an index of `sent`. Otherwise the time comes from the bar of the
    image and the start times `sent` of the camera.
    """
    if born == "due":
        return captured
    if marks is None:
        return None
    if born == "strip":
        begun: float = sent[strip_number(marks)]
        return begun
    return bar_birth(marks, now, sent[camera])


def strip_number(marks: UInt8) -> int:
    """Return the frame number that is encoded in the strip at the top of an image.

    `marks` are the parts of the image that `number_marks` returns. The strip is put on top of an empty image of full
    size, because `frame_number` expects a complete image.
    """
    whole = np.zeros((_LIVE[0], *marks.shape[1:]), np.uint8)
    whole[:16] = marks[:16]
    return frame_number(whole)


def bar_birth(marks: UInt8, now: float, times: Sequence[float]) -> float:
    """Return the send time of the newest image whose number the bar in `marks` can encode.

    The width of the bar encodes the number, and the widths repeat after 80 images that are 640 pixels wide. `times` has
    the send time of each image by number. Only images that were sent until `now` are considered.
    """
    width, cycle = int((marks[-4].mean(axis=-1) > 127).sum()), marks.shape[1] // 8
    number = round((width - 1) / 8) % cycle
    left = [time for index, time in enumerate(times) if index % cycle == number and time <= now]
    return max(left)


def _processor(process: psutil.Process) -> float:
    """Return the processor time of a process and its child processes so far [s]."""
    everybody = [process, *process.children(recursive=True)]
    return float(sum(sum(member.cpu_times()[:2]) for member in everybody))


def _resident(process: psutil.Process) -> float:
    """Return the memory of a process and its child processes [bytes]."""
    return float(sum(member.memory_info().rss for member in [process, *process.children(recursive=True)]))


def _ended(receiver: subprocess.Popen[str]) -> Mapping[str, int]:
    """End the receiving side; return the counts of its faults by name."""
    end(receiver)
    assert receiver.stdout is not None
    faults: Mapping[str, int] = json.loads(receiver.stdout.read())
    return faults
