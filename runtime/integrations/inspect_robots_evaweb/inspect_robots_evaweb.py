"""Embodiment `evaweb` of inspect-robots: a station of EVA Web. Every trial of theirs is an episode there.

    EVAWEB_ROBOT_URL=ws://... inspect-robots run --instruction "..." --embodiment evaweb --policy NAME

`reset` ends the previous run, **drives the station to its start pose** and begins another. `step` sends a row and
returns at the next control step. A stop of the station by a person ends the trial; its e-stop, and everything else
that ends its run, halts the evaluation.
"""

from __future__ import annotations

import contextlib
import time
from typing import Any

import numpy as np
from evaweb_robot import Observation as StationObservation
from evaweb_robot import Station, StationDescription, StationError
from inspect_robots.embodiment import RESETTABLE, SEEDABLE, SELF_PACED, EmbodimentInfo
from inspect_robots.errors import ConfigError, EmbodimentFault
from inspect_robots.scene import Scene
from inspect_robots.spaces import ActionSemantics, Box, CameraSpec, ObservationSpace, StateField, StateSpec
from inspect_robots.types import Action, Observation, StepResult

_STATE = "joint_pos"
_ENDLESS = 1e3  # bound of a joint without limits, which inspect-robots wants finite


class EvaStation:
    """Embodiment of one station.

    Args:
        url: Address that the station's robot server prints; "" for that in $EVAWEB_ROBOT_URL.

    Raises:
        ConfigError: The station does not answer, or has no pictures yet.
    """

    def __init__(self, *, url: str = "") -> None:
        try:
            self._station = Station(url, program="inspect-robots")
            description = self._station.describe()
        except StationError as error:
            raise ConfigError(f"the station cannot be used: {error}") from error
        self._has_bench = description.has_bench
        self._period = 1.0 / description.rate
        self._due = 0.0
        self._newest = Observation()
        self.info = _info_of(description)

    def reset(self, scene: Scene, *, seed: int | None = None) -> Observation:
        """Begin a run with the scene's instruction, and return its first observation. Raises: EmbodimentFault."""
        try:
            with contextlib.suppress(
                StationError
            ):  # ended for silence: the station says what else is the matter
                self._station.end()
            self._station.begin(scene.instruction, seed=seed if self._has_bench else None)
            observation = self._station.observe()
        except StationError as error:
            raise EmbodimentFault(f"{error}") from error
        self._due = time.monotonic()
        self._newest = _convert(observation)
        return self._newest

    def step(self, action: Action) -> StepResult:
        """Send a row, and return the observation of the next control step. Raises: EmbodimentFault."""
        try:
            self._station.act(np.asarray(action.data, np.float32))
            self._due = max(self._due + self._period, time.monotonic())
            time.sleep(max(0.0, self._due - time.monotonic()))
            observation = self._station.observe()
        except StationError as error:
            if error.is_stopped:
                return StepResult(self._newest, terminated=True, termination_reason="operator_end")
            raise EmbodimentFault(f"{error}") from error
        self._newest = _convert(observation)
        return StepResult(self._newest)

    def close(self) -> None:
        """End the run and the connection."""
        self._station.close()


def _convert(observation: StationObservation) -> Observation:
    times = observation.captured
    return Observation(
        images=dict(observation.pictures),
        state={_STATE: observation.joints.astype(np.float64)},
        instruction=observation.task,
        image_times={camera: times[camera] for camera in observation.pictures if camera in times},
        state_time=times["joints"],
    )


def _info_of(description: StationDescription) -> EmbodimentInfo:
    names, grippers = description.joint_names, set(description.gripper_dims)
    units = "; ".join(f"{name} [{unit}]" for name, unit in zip(names, description.units, strict=True))
    seedable = {SEEDABLE} if description.has_bench else set()
    return EmbodimentInfo(
        name="evaweb",
        action_space=Box(
            shape=(len(names),),
            low=np.clip(np.array(description.lower), -_ENDLESS, None),
            high=np.clip(np.array(description.upper), None, _ENDLESS),
            semantics=ActionSemantics(
                control_mode="joint_pos",
                gripper="continuous" if grippers else "none",
                dim_labels=names,
                max_step=tuple(speed / description.rate for speed in description.velocity),
            ),
        ),
        observation_space=ObservationSpace(
            cameras=tuple(
                CameraSpec(name=camera, height=height, width=width)
                for camera, (height, width) in description.cameras.items()
            ),
            state_keys=frozenset({_STATE}),
            state=StateSpec(fields=(StateField(key=_STATE, shape=(len(names),), unit="rad"),)),
        ),
        control_hz=description.rate,
        is_simulated=not description.moves_robot or description.has_bench,
        capabilities=frozenset({RESETTABLE, SELF_PACED} | seedable),
        docs=f"Actions and state are absolute positions of {description.robot}, in this order: {units}.",
        environment_id=description.station,
    )


def make_embodiment(**options: Any) -> EvaStation:
    """Return the embodiment for `-E NAME=VALUE`. Raises: ConfigError for an option that it does not have."""
    unknown = sorted(set(options) - {"url"})
    if unknown:
        raise ConfigError(f"options {', '.join(unknown)} of the embodiment evaweb; allowed: url")
    return EvaStation(**options)
