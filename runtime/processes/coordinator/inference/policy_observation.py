"""Observation for a policy: fresh, assigned to a control step, with its instruction."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from runtime.core.clock import Clock
from runtime.core.errors import PolicyError
from runtime.core.sentences import Pattern, fixed
from runtime.core.types import Float64, Observation
from runtime.ipc.shared_state import SharedState

_NONE_YET = fixed("observation.none_yet", "no observation has arrived yet")
_STALE = Pattern("observation.stale", "{stream}: {seconds:.2f} s old (limit {allowed:g} s)")
_NOTHING_YET = Pattern("observation.nothing_yet", "{stream}: nothing has arrived yet")
_NO_PICTURE = Pattern("observation.no_picture", "no picture has arrived from {cameras}")


class StaleObservationError(PolicyError):
    """Error that the newest observation is too old for a request."""


class ObservationProvider(Protocol):
    """Source of a policy's observations.

    `simulated` is True if the observations contain the joints of the simulated robot instead of the real one.
    """

    @property
    def simulated(self) -> bool: ...

    def use_simulated(self, simulated: bool) -> None:
        """Select the joints of the simulated robot, or those of the real one."""

    def latest(self, prompt: str, pictures: bool = True) -> Observation:
        """Return the newest observation; if `pictures` is False, without pictures.

        Raises:
            PolicyError: there is no observation, or it is too old.
        """

    def commanded(self) -> tuple[int, Float64] | None:
        """Return the newest control step and its commanded position [D]; None before the first."""


@dataclass(frozen=True, slots=True)
class StalenessLimits:
    """Greatest permitted ages of joints and pictures in an observation [s], with the control rate [Hz]."""

    control_rate: float
    joint_age: float
    picture_age: float


class PolicyObservation:
    """Observation provider that reads the shared state."""

    def __init__(self, shared: SharedState, clock: Clock, settings: StalenessLimits) -> None:
        self._shared_state = shared
        self._clock = clock
        self._settings = settings
        self.simulated = False

    def use_simulated(self, simulated: bool) -> None:
        """Select the joints of the simulated robot, or those of the real one."""
        self.simulated = simulated

    def latest(self, prompt: str, pictures: bool = True) -> Observation:
        """Return the newest observation; if `pictures` is False, without pictures.

        Raises:
            PolicyError: there is no observation, or it is too old.
        """
        cameras = self._shared_state.layout.cameras if pictures else ()
        observation = self._shared_state.read_observation(cameras)
        if observation is None:
            raise PolicyError(_NONE_YET)
        now, bounds = self._clock.now(), self._settings
        for stream, captured in observation.captured.items():
            if not (pictures or stream in ("joints", "eef")):
                continue
            allowed = bounds.joint_age if stream in ("joints", "eef") else bounds.picture_age
            if math.isnan(captured):
                raise StaleObservationError(_NOTHING_YET(stream=stream))
            if not now - captured <= allowed:
                raise StaleObservationError(_STALE(stream=stream, seconds=now - captured, allowed=allowed))
        missing = [camera for camera in cameras if camera not in observation.pictures]
        if missing:
            raise PolicyError(_NO_PICTURE(cameras=", ".join(missing)))
        newest = self.commanded()
        commanded = None if newest is None else newest[1]
        complete = replace(observation, step=self._step_of(observation), prompt=prompt, commanded=commanded)
        return self._of_the_simulated_robot(complete) if self.simulated else complete

    def commanded(self) -> tuple[int, Float64] | None:
        """Return the newest control step and the commanded position [D] of the robot that executes chunks.

        None if it is not engaged.
        """
        status = self._shared_state.control.read()
        simulated = np.array(status["simulated"], np.float64)
        if int(status["step"]) >= 0 and np.isfinite(simulated).all() and bytes(status["behaviour"]):
            return int(status["step"]), simulated
        if not status["engaged"]:
            return None
        return int(status["step"]), np.array(status["commanded"], np.float64)

    def _step_of(self, observation: Observation) -> int:
        """Return the control step of an observation.

        That is the step of the tick that used it or, if no tick has used it yet, of the next tick. If control has
        missed ticks, the next tick is more than one step ahead of the newest, because steps follow the clock and missed
        ticks are skipped.
        """
        status = self._shared_state.control.read()
        step, planned = int(status["step"]), float(status["planned"])
        if observation.sequence == int(status["sequence"]):
            return step
        periods = (observation.arrived - planned) * self._settings.control_rate if planned else 1.0
        return step + max(1, math.ceil(periods - 1e-6))

    def _of_the_simulated_robot(self, observation: Observation) -> Observation:
        """Return the observation with the simulated robot's joints, and without velocities, efforts and poses.

        Before the first tick of the simulated robot the observation is returned unchanged.
        """
        joints = np.array(self._shared_state.control.read()["simulated"], np.float32)
        if not np.isfinite(joints).all():
            return observation
        return replace(observation, qpos=joints, qvel=None, effort=None, eef=None)
