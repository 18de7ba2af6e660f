"""Receiver that puts observations into shared state.

It also provides rates, fault counts and ages of the observations, the state of the drives, and the ground truth.
"""

from __future__ import annotations

import logging
import math
from collections import Counter, deque
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from runtime.core.clock import Clock
from runtime.core.errors import TransportError
from runtime.core.quantiles import quantiles
from runtime.core.sentences import Pattern
from runtime.core.types import Observation
from runtime.ipc.messages import Event
from runtime.ipc.shared_state import SharedState
from runtime.processes.reception.drive_status import DriveStatus
from runtime.transports.base import Source

log = logging.getLogger(__name__)
_BECAUSE = Pattern("reception.because", "{what}: {why}")
_SOURCE_FAULT = Pattern("reception.source_fault", "source: {fault} ({count} so far)")
_RATE_WINDOW = 40  # number of arrivals per stream
_AGES_KEPT = 2000  # number of ages: over a minute at 30 Hz
_SILENT_S = 2.0  # [s]; after that a stream's rate is 0
_REPEAT_S = 5.0  # shortest time between two events of one fault [s], against log floods
_STANDING = "_unusable"  # suffix of faults that occur in every message of a node: reported once per run


class ObservationReceiver:
    """Receiver of a source's observations.

    It writes pictures into shared slots, calls `hand_on` with the slots' numbers, then publishes the observation.
    Numbers of observations and pictures continue those of a predecessor in the same shared state. `truth` is the last
    reported ground truth of a simulated bench. Events are passed to `say`.
    """

    def __init__(
        self,
        shared: SharedState,
        source: Source,
        clock: Clock,
        say: Callable[[Event], None],
        hand_on: Callable[[Observation, Mapping[str, int]], None],
    ) -> None:
        self._shared_state = shared
        self._source = source
        self._clock = clock
        self._say, self._hand_on = say, hand_on
        self._before = int(shared.observation.read()["sequence"])  # number of observations by predecessors
        self._numbers = {camera: slots.newest for camera, slots in shared.pictures.items()}
        self._ages, self._aged = np.zeros(_AGES_KEPT), 0  # [s], and their total number
        self._captured: dict[str, float] = {}
        self._arrivals: dict[str, deque[float]] = {}
        self._faults: dict[str, int] = {}  # counts in the last events
        self._said_at: dict[str, float] = {}
        self._too_large: Counter[str] = Counter()
        self._failure = ""
        self._drives = DriveStatus()
        self.truth: Mapping[str, Any] = {}

    @property
    def drives(self) -> Mapping[str, Any]:
        """Drive state that the node last reported; {} without one."""
        return self._drives.newest

    @property
    def cameras(self) -> Mapping[str, Any]:
        """Health of each camera that the deployment opens itself."""
        return self._source.camera_health()

    def poll(self, timeout: float) -> None:
        """Receive one observation, waiting at most `timeout` [s]."""
        observation = self._receive(timeout)
        if observation is not None:
            self._accept(observation)

    def begin_run(self) -> None:
        """Start the source's run, and receive its first frame so that the run's first tick uses it."""
        self._source.begin_run()
        self._said_at = {name: at for name, at in self._said_at.items() if not name.endswith(_STANDING)}
        self._captured.clear()  # pictures are new although time may be paused between two frames
        self.poll(0.0)

    def end_run(self) -> None:
        """End the source's run."""
        self._source.end_run()

    def faults(self) -> dict[str, int]:
        """Return the counts of faults; emit an event for each count that has grown, at most every 5 s per fault.

        A fault that every message of a node has is emitted once per run.
        """
        for event in self._source.pop_events():
            self._say(event)
        now, faults = self._clock.now(), {**self._source.faults(), **self._too_large}
        for name, count in faults.items():
            previous = self._faults[name] = min(
                count, self._faults.get(name, 0)
            )  # a restarted source counts from 0
            repeat_s = math.inf if name.endswith(_STANDING) else _REPEAT_S
            if count > previous and now - self._said_at.get(name, -math.inf) >= repeat_s:
                self._faults[name], self._said_at[name] = count, now
                reason = self._source.describe_fault(name)
                named = name.replace("_", " ").replace(".", ": ")
                text = _SOURCE_FAULT(fault=named, count=count)
                text = _BECAUSE(what=text, why=reason) if reason else text
                self._say(Event(f"source_{name}", text, now, data={"count": count}))
        return faults

    def rates(self) -> dict[str, float]:
        """Return the arrival rate of each stream [Hz] over its newest 40 arrivals; 0 after 2 s of silence."""
        now = self._clock.now()
        return {stream: _rate(times, now) for stream, times in self._arrivals.items()}

    def age_ms(self) -> dict[str, float]:
        """Return p50, p99 and maximum of the age of joints at publication [ms], over the newest 2000 observations."""
        if not self._aged:
            return {}
        ages = self._ages[: min(self._aged, _AGES_KEPT)]
        p50, p99, worst = (1000.0 * age for age in quantiles(ages, (0.5, 0.99, 1.0)))
        return {"p50": p50, "p99": p99, "max": worst}

    def _receive(self, timeout: float) -> Observation | None:
        """Receive from the source; a failure is reported once. Control then holds because joints become too old."""
        try:
            observation = self._source.receive(timeout)
        except TransportError as error:
            if str(error) != self._failure:
                self._failure = str(error)
                log.error("%s", error)
                self._say(Event("source_failed", str(error), self._clock.now()))
            self._clock.sleep_until(self._clock.now() + timeout)
            return None
        if observation is not None:
            self._failure = ""
        return observation

    def _accept(self, received: Observation) -> None:
        observation = self._drop_unknown_images(received)
        # The order matters: pictures are in their slots before their numbers are published, and media has an
        # observation before a tick can use it.
        for camera, picture in observation.pictures.items():
            captured = observation.captured.get(camera, observation.arrived)
            if captured != self._captured.get(camera):
                self._captured[camera] = captured
                self._count(camera, observation.arrived)
                self._numbers[camera] += 1
                self._shared_state.pictures[camera].write(self._numbers[camera], picture)
        self._count("joints", observation.arrived)
        self.truth = observation.truth or {}
        self._update_drives(observation)
        self._hand_on(observation, self._numbers)
        self._shared_state.publish_observation(observation, self._numbers)
        age = self._clock.now() - observation.captured.get("joints", observation.arrived)
        self._ages[self._aged % _AGES_KEPT] = age
        self._aged += 1

    def _drop_unknown_images(self, observation: Observation) -> Observation:
        """Return the observation with its number in shared state.

        Pictures of unknown cameras, and pictures that are too large, are removed.
        """
        most = self._shared_state.layout.picture_bytes
        pictures = {
            camera: image for camera, image in observation.pictures.items() if camera in self._numbers
        }
        large = {camera for camera, picture in pictures.items() if picture.nbytes > most}
        self._too_large.update(f"picture_too_large_{camera}" for camera in large)
        return replace(
            observation,
            sequence=self._before + observation.sequence,
            pictures={camera: picture for camera, picture in pictures.items() if camera not in large},
            captured={name: time for name, time in observation.captured.items() if name not in large},
        )

    def _update_drives(self, observation: Observation) -> None:
        change = self._drives.update(observation.drives, observation.arrived)
        if change:
            self._say(Event("drives", change, observation.arrived, data=dict(self._drives.newest)))

    def _count(self, stream: str, arrived: float) -> None:
        self._arrivals.setdefault(stream, deque(maxlen=_RATE_WINDOW)).append(arrived)


def _rate(times: deque[float], now: float) -> float:
    if len(times) < 2 or now - times[-1] > _SILENT_S:
        return 0.0
    return (len(times) - 1) / max(times[-1] - times[0], 1e-9)
