"""Policy that replays a recorded episode: it returns the recorded actions exactly as they are stored."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
from pydantic import Field

import robots
from runtime.core.clock import Clock
from runtime.core.errors import PolicyError, RecordingError
from runtime.core.host_references import Recording
from runtime.core.pose_format import PoseFormat
from runtime.core.settings import Settings
from runtime.core.types import ActionChunk, Conditioning, Float32, Observation, Space
from runtime.datasets.mapping import ColumnMapping
from runtime.policies.base import Policy, PolicyInfo
from runtime.policies.request_layout import pose_rows_for
from runtime.recording.base import IMPORTED

if TYPE_CHECKING:
    from robots import Robot


class Config(Settings):
    """Replay of the actions of one episode: of a LeRobot dataset (v2.0, v2.1, v3.0) or of an EVA Web recording."""

    kind: Literal["replay"] = "replay"
    path: Recording
    """Folder of the dataset, or of a recorded episode."""
    episode: int = Field(default=0, ge=0)
    """Index of the episode in the dataset."""
    mapping: ColumnMapping = ColumnMapping()
    """Names of the dataset's columns; a recorded episode defines its own."""
    space: Space = "joint"
    """Recorded actions that are replayed: "joint" uses the action column, "eef" the action_eef column."""
    action_pose: PoseFormat = PoseFormat()
    """Format of the poses in the action_eef column, with space = "eef"."""
    horizon: int = Field(default=50, ge=1)
    """Rows per chunk, at the recording's rate."""
    latency_s: float = Field(default=0.0, ge=0, allow_inf_nan=False)
    """Duration of each response [s], as a real wait on the clock."""


@dataclass(frozen=True, slots=True, eq=False)
class _Recorded:
    """Actions of an episode, and the robot that it was recorded with, if known."""

    actions: Float32  # [N, W]
    fps: float
    task: str
    robot: str  # "" if unknown
    names: Sequence[str]  # of the dimensions; empty if unknown
    state: str = "unsealed"  # integrity of its files, see runtime.recording.scrub


class ReplayPolicy(Policy):
    """Policy that replays an episode: row 0 is for the first observation after a reset, later rows for later steps.

    After a hold, a replay in joint space continues with the row of the last chunk that is nearest to the robot's
    joints; a replay in poses continues with the first row of the last chunk. A chunk beyond the end repeats the last
    row, so that the robot holds there; without rows it would brake, and stop beyond that row.
    """

    def __init__(self, config: Config, robot: Robot, clock: Clock, control_rate: float) -> None:
        self._config = config
        self._robot = robot
        poses = pose_rows_for(config.space, config.action_pose, robot, "action_pose")
        self._width = robot.dim if poses is None else poses.width
        self._clock = clock
        self._control_rate = control_rate
        self._actions: Float32 | None = None
        self._fps = 0.0
        self._first_step: int | None = None
        self._row = 0  # first row of the last chunk
        self._held = False  # whether there was a hold since

    def connect(self) -> PolicyInfo:
        """Open the episode. Raises PolicyError if it is absent or does not fit the robot."""
        config = self._config
        try:
            recorded = self._recording() if self._is_recording() else self._of_dataset()
        except RecordingError as error:
            raise PolicyError(str(error)) from error
        self._require_same_robot(recorded)
        self._actions = self._fitting(recorded.actions)
        self._fps = recorded.fps
        self.reset()
        episode = "" if self._is_recording() else f", episode {config.episode}"
        return PolicyInfo(
            name=f"replay of {config.path}{episode}",
            action_space=config.space,
            horizon=config.horizon,
            rate=recorded.fps,
            metadata={
                "rows": len(recorded.actions),
                "fps": recorded.fps,
                "task": recorded.task,
                "files": recorded.state,
            },
        )

    def _is_recording(self) -> bool:
        return (Path(self._config.path) / "manifest.json").is_file()

    def _of_dataset(self) -> _Recorded:
        from runtime.datasets.reader import open_dataset

        mapping = self._mapping()
        dataset = open_dataset(self._config.path)
        episode = dataset.episode(self._config.episode, mapping)
        names = dataset.features.get(mapping.state, {}).get("names")
        return _Recorded(
            episode.qpos,
            episode.fps,
            episode.task,
            str(dataset.info.get("robot_type") or ""),
            names if isinstance(names, list) else (),
        )

    def _recording(self) -> _Recorded:
        from runtime.datasets.finished_episode import read_finished_episode
        from runtime.recording.scrub import files_here, require_intact

        if self._config.episode:
            raise PolicyError(
                f"policy.episode = {self._config.episode}, but {self._config.path} is one recorded episode; allowed: 0"
            )
        folder = Path(self._config.path)
        state = require_intact(folder, files_here(folder)).state  # its videos may be in the lab's store
        journal = read_finished_episode(folder, videos=False)
        poses = self._config.space == "eef"
        column, key = ("eef_action", "eef_names") if poses else ("action", "joint_names")
        if poses and not journal.has_stream(column):
            raise PolicyError(
                f'{self._config.path} has no poses of its actions; allowed: policy.space = "joint"'
            )
        if poses and journal.manifest.get("kind") == IMPORTED:
            raise PolicyError(
                f"{self._config.path} was imported: the frames of its poses are unknown; allowed: "
                'policy.space = "joint"'
            )
        names = journal.manifest["robot"][key]
        actions = journal.finite_vectors(column)
        return _Recorded(actions, journal.fps, journal.task, journal.robot, names, state)

    def _require_same_robot(self, recorded: _Recorded) -> None:
        """Raise PolicyError if the actions are known to be of another robot, or in another order of joints."""
        own = self._robot
        if robots.is_described(recorded.robot) and recorded.robot != own.name:
            raise PolicyError(
                f"{self._config.path} is of the robot {recorded.robot}, the station's is {own.name}"
            )
        if recorded.robot != own.name or self._config.space != "joint" or not recorded.names:
            return
        if list(recorded.names) != list(own.joint_names):
            raise PolicyError(
                f"{self._config.path}: the actions are of the joints {list(recorded.names)}, the station's are "
                f"{list(own.joint_names)}"
            )

    def _mapping(self) -> ColumnMapping:
        """Return a mapping of columns that reads the action column as the state, so that no other column is needed."""
        name = "action" if self._config.space == "joint" else "action_eef"
        column = getattr(self._config.mapping, name)
        if column is None:
            raise PolicyError(
                f'policy.space is "{self._config.space}" but policy.mapping.{name} names no column'
            )
        return ColumnMapping(state=column, action=None, videos={})

    def _fitting(self, actions: Float32) -> Float32:
        if actions.shape[1] != self._width:
            name = "action" if self._config.space == "joint" else "action_eef"
            raise PolicyError(
                f"{self._config.path}: the {name} column is {actions.shape[1]} wide, "
                f"{self._robot.name} needs {self._width}"
            )
        return actions

    def infer(self, observation: Observation, conditioning: Conditioning | None = None) -> ActionChunk:
        """Return the recorded rows from the observation's step on."""
        if self._actions is None:
            raise PolicyError(f"the replay of {self._config.path} is not connected")
        answered_at = self._clock.now() + self._config.latency_s
        if self._first_step is None:
            self._first_step = observation.step
        elif self._held:
            steps = round(self._place(observation) * self._control_rate / self._fps)
            self._first_step = observation.step - steps
        self._held = False
        passed = observation.step - self._first_step
        if passed < 0:
            raise PolicyError(
                f"the observation is of step {observation.step}, before the first one since the reset, "
                f"which was of step {self._first_step}"
            )
        row = min(round(passed * self._fps / self._control_rate), len(self._actions) - 1)
        self._row = row
        self._clock.sleep_until(answered_at)
        return ActionChunk(
            actions=self._actions[
                np.minimum(np.arange(row, row + self._config.horizon), len(self._actions) - 1)
            ],
            space=self._config.space,
            rate=self._fps,
            pose=self._config.action_pose,
        )

    def _place(self, observation: Observation) -> int:
        """Return the index of the row with which the replay continues after a hold."""
        if self._actions is None or self._config.space != "joint":
            return self._row
        rows = self._actions[self._row : self._row + self._config.horizon]
        away = np.abs(rows - observation.qpos).max(axis=1)
        return self._row + int(away.argmin())

    def reset(self) -> None:
        self._first_step = None
        self._row, self._held = 0, False

    def resume(self) -> None:
        self._held = True

    def close(self) -> None:
        self._actions = None


def build(config: Config, robot: Robot, clock: Clock, control_rate: float) -> ReplayPolicy:
    """Create the policy; `control_rate` is the rate of the steps in observations [Hz]."""
    return ReplayPolicy(config, robot, clock, control_rate)
