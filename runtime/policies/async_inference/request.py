"""Messages for LeRobot's policy server, as a deployment declares them.

The module builds the request to load a model and the requests with observations, and converts responses to rows.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from pydantic import Field

from runtime.core.errors import ConfigurationError, ContradictionError, ShapeError, WrongProtocolError
from runtime.core.types import Float32, Observation
from runtime.policies.action_layout import ActionLayoutSettings
from runtime.policies.action_rows import parse_action_rows
from runtime.policies.async_inference.pickles import (
    MODULES,
    RemotePolicyConfig,
    TimedAction,
    TimedObservation,
    dump,
)
from runtime.policies.gripper_convention import Convention, GripperConvention
from runtime.policies.request_layout import Dims, pose_rows_for

if TYPE_CHECKING:
    from robots import Robot

_RATE_TOLERANCE = 0.02  # relative; timestamps are wall clock in double precision
_NATIVE = (480, 640)  # declared (height, width) of pictures without a size; the server resizes every picture


class RequestSettings(ActionLayoutSettings):
    """Model for the server to load, and the model's names of its inputs."""

    policy_type: Annotated[str, Field(pattern=r"^[a-z0-9_]+$")]
    """LeRobot's name of the model type: act, smolvla, diffusion, tdmpc, vqbet, pi0, pi05, groot."""
    checkpoint: Annotated[str, Field(min_length=1)]
    """Checkpoint that the server loads: a folder on its machine, or a name on the hub."""
    device: str = "cuda"
    """Device on which the server runs the model."""
    actions_per_chunk: Annotated[int, Field(ge=1, le=1000)] = 50
    """Largest number of rows of a response; a model with shorter chunks returns fewer."""
    images: dict[str, str]
    """The model's image name, without the prefix "observation.images.", = observation key of a camera."""
    state: Dims | None = None
    """Indices of the station's state vector that form the model's state, in the model's order; absent: all, in the
    station's order."""
    state_names: list[str] | None = None
    """Names of these values; the server does not require particular names. Absent: the names of the joints."""
    actions: Dims | None = None
    """Indices of the station's action row to which the values of the model's row belong, in the model's order; absent:
    all, in the station's order."""
    gripper: Convention = "robot"
    """Gripper convention in state and responses: "robot": the robot's own values; "droid": 0 is open and 1 is
    closed."""
    rename: dict[str, str] = Field(default_factory=dict)
    """LeRobot's rename_map, for observation keys on the server that have other names in its model."""
    server_version: Literal["0.4", "0.3"] = "0.4"
    """Version of LeRobot on the server: 0.3 has its classes in other modules. Newer versions are like 0.4."""


class AsyncRequest:
    """Builder of requests and checker of responses. Raises ConfigurationError if maps do not fit the robot."""

    def __init__(self, settings: RequestSettings, robot: Robot, control_rate: float) -> None:
        self._settings = settings
        self._module = MODULES[settings.server_version]
        self._rate = settings.action_rate or control_rate
        width, self._row_width = settings.widths(robot)
        self._places = _places("state", settings.state, width)
        self._actions = _places("actions", settings.actions, self._row_width)
        if sorted(self._actions) != list(range(self._row_width)):
            raise ConfigurationError(
                f"policy.actions = {self._actions}; allowed: each of 0 to {self._row_width - 1} once"
            )
        posed = pose_rows_for(settings.action_space, settings.action_pose, robot, "action_pose")
        self._grip = GripperConvention(settings.gripper, robot, posed)
        poses = pose_rows_for(
            settings.observation_space, settings.observation_pose, robot, "observation_pose"
        )
        own_names = robot.joint_names if poses is None else poses.names
        self._names = _names(settings.state_names, [f"{own_names[place]}.pos" for place in self._places])
        self._layout = settings.layout(robot, {camera: camera for camera in settings.images.values()})

    def setup_message(self) -> bytes:
        """Return the pickle with the model to load and the features of observations."""
        settings = self._settings
        height, width = settings.image_size or _NATIVE
        picture = {"dtype": "image", "shape": (height, width, 3), "names": ["height", "width", "channels"]}
        features: dict[str, Any] = {
            "observation.state": {
                "dtype": "float32",
                "shape": (len(self._names),),
                "names": list(self._names),
            }
        }
        features |= {f"observation.images.{name}": dict(picture) for name in settings.images}
        config = RemotePolicyConfig(
            settings.policy_type,
            settings.checkpoint,
            features,
            settings.actions_per_chunk,
            settings.device,
            dict(settings.rename),
        )
        return dump(config, self._module)

    def build(self, observation: Observation, timestep: int) -> bytes:
        """Return the pickle of an observation with `must_go` set. Raises PolicyError if a part is missing."""
        inputs = self._layout.build(self._grip.convert_observation(observation))
        values: dict[str, Any] = {
            name: float(inputs["state"][place]) for name, place in zip(self._names, self._places, strict=True)
        }
        values |= {name: inputs["images"][camera] for name, camera in self._settings.images.items()}
        values["task"] = observation.prompt
        return dump(TimedObservation(time.time(), timestep, values, must_go=True), self._module)

    def rows(self, given: Sequence[TimedAction], timestep: int) -> Float32:
        """Return rows [H, W] in the robot's order from the actions that answer the observation `timestep`.

        Raises:
            PolicyError: The response belongs to another observation, has gaps, or its rows are invalid.
            ContradictionError: The rows are for another rate.
        """
        actions = sorted(given, key=lambda action: action.timestep)
        steps = [action.timestep for action in actions]
        if not actions:
            raise ShapeError("the answer has no actions")
        if steps != list(range(timestep, timestep + len(steps))):
            raise WrongProtocolError(
                f"the answer has actions for the steps {_short(steps)}; expected {timestep} and those after it, as it "
                "answers the observation of that step: another client uses the same server?"
            )
        self._check_rate([action.timestamp for action in actions])
        for action in actions:
            if action.action.ndim != 1 or action.action.shape != actions[0].action.shape:
                raise ShapeError(
                    f"the action for step {action.timestep} has shape {list(action.action.shape)}, the first "
                    f"{list(actions[0].action.shape)}; expected [{self._row_width}] each"
                )
        rows = parse_action_rows(
            "the answer", np.stack([action.action for action in actions]), self._row_width
        )
        robot_rows = np.empty_like(rows)
        robot_rows[:, self._actions] = rows
        return self._grip.to_robot(robot_rows)

    def _check_rate(self, times: Sequence[float]) -> None:
        """Check the rate by the rows' timestamps, which the server computes from the rate that it was started with."""
        if len(times) < 2:
            return
        apart = (times[-1] - times[0]) / (len(times) - 1)
        if not abs(apart * self._rate - 1.0) <= _RATE_TOLERANCE:
            text = f"{1.0 / apart:.4g} Hz" if apart > 0 else f"{apart:g} s apart"
            raise ContradictionError(
                f"the server's rows are at {text}, policy.action_rate (without it the control rate) is {self._rate:g} "
                "Hz; start it with --fps of that rate, or correct policy.action_rate"
            )


def _places(name: str, requested: Sequence[int] | None, width: int) -> list[int]:
    places = list(range(width)) if requested is None else list(requested)
    if max(places) >= width:
        raise ConfigurationError(f"policy.{name} = {places} leaves the vector; allowed: 0 to {width - 1}")
    return places


def _names(requested: Sequence[str] | None, own_names: list[str]) -> list[str]:
    names = own_names if requested is None else list(requested)
    if len(names) != len(own_names) or len(set(names)) != len(names):
        raise ConfigurationError(
            f"policy.state_names has {len(names)} names, {len(set(names))} different ones; "
            f"the state has {len(own_names)}"
        )
    return names


def _short(steps: Sequence[int]) -> str:
    beginning = ", ".join(map(str, steps[:4]))
    return f"{beginning}, ... {steps[-1]}" if len(steps) > 4 else beginning
