"""A recorded episode as a policy: it answers with the recorded actions, exactly as they are stored."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

from pydantic import Field

from runtime.clock import Clock
from runtime.datasets.mapping import ColumnMapping
from runtime.errors import PolicyError, RecordingError
from runtime.policies.base import Policy, PolicyInfo
from runtime.policies.request import poses_of
from runtime.pose_format import PoseFormat
from runtime.section import Section
from runtime.types import ActionChunk, Conditioning, Float32, Observation, Space

if TYPE_CHECKING:
    from robots import Robot


class Config(Section):
    """Replays the actions of one episode of a LeRobot v2.x dataset."""

    kind: Literal["replay"] = "replay"
    path: str
    """Folder of the dataset."""
    episode: int = Field(default=0, ge=0)
    """Index of the episode in the dataset."""
    mapping: ColumnMapping = ColumnMapping()
    """Names of the dataset's columns."""
    space: Space = "joint"
    """Which recorded actions: "joint" takes the action column, "eef" the action_eef column."""
    action_pose: PoseFormat = PoseFormat()
    """How poses are written in the action_eef column, where space is "eef"."""
    horizon: int = Field(default=50, ge=1)
    """Rows per chunk, at the recording's rate."""
    latency_s: float = Field(default=0.0, ge=0, allow_inf_nan=False)
    """How long an answer takes [s]: a real wait on the clock."""


class ReplayPolicy(Policy):
    """Row 0 belongs to the first observation after a reset, later rows to the steps that passed since.

    Near the end chunks get shorter; past the end the last row is answered alone, for ever.
    """

    def __init__(self, config: Config, robot: Robot, clock: Clock, control_rate: float) -> None:
        self._config = config
        self._robot = robot
        poses = poses_of(config.space, config.action_pose, robot, "action_pose")
        self._width = robot.dim if poses is None else poses.width
        self._clock = clock
        self._control_rate = control_rate
        self._actions: Float32 | None = None
        self._fps = 0.0
        self._first_step: int | None = None

    def connect(self) -> PolicyInfo:
        """Open the episode; raises PolicyError where it is absent or does not fit the robot."""
        from runtime.datasets.reader import open_dataset

        config = self._config
        try:
            mapping = config.mapping.model_copy(update={"videos": {}})
            episode = open_dataset(config.path).episode(config.episode, mapping)
        except RecordingError as error:
            raise PolicyError(str(error)) from error
        self._actions = self._fitting(episode.action if config.space == "joint" else episode.action_eef)
        self._fps = episode.fps
        self._first_step = None
        return PolicyInfo(
            name=f"replay of {config.path}, episode {config.episode}",
            action_space=config.space,
            horizon=config.horizon,
            rate=episode.fps,
            metadata={"rows": episode.length, "fps": episode.fps, "task": episode.task},
        )

    def _fitting(self, actions: Float32 | None) -> Float32:
        name = "action" if self._config.space == "joint" else "action_eef"
        if actions is None:
            raise PolicyError(
                f'policy.space is "{self._config.space}" but policy.mapping.{name} names no column'
            )
        if actions.shape[1] != self._width:
            raise PolicyError(
                f"{self._config.path}: the {name} column is {actions.shape[1]} wide, "
                f"{self._robot.name} needs {self._width}"
            )
        return actions

    def infer(self, observation: Observation, conditioning: Conditioning | None = None) -> ActionChunk:
        """The rows recorded from the observation's moment on."""
        if self._actions is None:
            raise PolicyError(f"the replay of {self._config.path} is not connected")
        answered_at = self._clock.now() + self._config.latency_s
        if self._first_step is None:
            self._first_step = observation.step
        passed = observation.step - self._first_step
        if passed < 0:
            raise PolicyError(
                f"the observation is of step {observation.step}, before the first one since the reset, "
                f"which was of step {self._first_step}"
            )
        row = min(round(passed * self._fps / self._control_rate), len(self._actions) - 1)
        self._clock.sleep_until(answered_at)
        return ActionChunk(
            actions=self._actions[row : row + self._config.horizon].copy(),
            space=self._config.space,
            rate=self._fps,
            pose=self._config.action_pose,
        )

    def reset(self) -> None:
        self._first_step = None

    def close(self) -> None:
        self._actions = None


def build(config: Config, robot: Robot, clock: Clock, control_rate: float) -> ReplayPolicy:
    """The policy; `control_rate` [Hz] is the rate of the steps that observations carry."""
    return ReplayPolicy(config, robot, clock, control_rate)
