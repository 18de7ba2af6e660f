"""Transport that plays a recorded episode at its own rate in place of a robot; commands move nothing."""

from __future__ import annotations

from contextlib import suppress
from typing import TYPE_CHECKING, Literal

from pydantic import Field

from runtime.core.clock import Clock
from runtime.core.errors import RecordingError, SetupError, TransportError
from runtime.core.settings import Settings
from runtime.core.types import EEF_WIDTH, Observation, RobotCommand, UInt8
from runtime.datasets.mapping import ColumnMapping, video_key
from runtime.transports.base import Capabilities, Sink, Source

if TYPE_CHECKING:
    from robots import Robot
    from runtime.datasets.reader import RecordedEpisode
    from runtime.datasets.video_frames import ImageSequence

TOLERANCE = 1e-6  # a frame is due this much early [s]: due times are sums of floats


class Config(Settings):
    """Playback of one episode of a LeRobot dataset: v2.0, v2.1 or v3.0."""

    kind: Literal["dataset"] = "dataset"
    path: str
    """Folder of the dataset."""
    episode: int = Field(default=0, ge=0)
    """Index of the episode in the dataset."""
    start_frame: int = Field(default=0, ge=0)
    """Index of the row at which a run begins."""
    mapping: ColumnMapping = ColumnMapping()
    """Names of the dataset's columns."""


class DatasetSource(Source):
    """Source that plays an episode: frame k is due k / fps after the start of the run, on the given clock.

    Before and between runs the first frame is delivered repeatedly, at most at the recording's rate, like a robot at
    rest. A late reader receives the newest frame that is due; missed frames are counted as `skipped_frames`. The last
    frame has `last` set, and no frame follows it. Row k comes with picture k of every camera: pictures are decoded by
    frame number, and the next ones are decoded while waiting for their due time.
    """

    def __init__(self, config: Config, robot: Robot, clock: Clock) -> None:
        self._config = config
        self._robot = robot
        self._clock = clock
        self._episode: RecordedEpisode | None = None
        self._pictures: dict[str, ImageSequence] = {}
        self._sequence = 0
        self._skipped = 0
        self._start: float | None = None  # start time of the run; None outside runs
        self._next = 0  # number of frames of the run that were delivered or skipped
        self._standing_due = float("-inf")

    def connect(self) -> None:
        """Open the episode and decode its first frame.

        Raises:
            TransportError: The dataset cannot be read.
            SetupError: The widths of its columns do not fit the robot, or `start_frame` is beyond its end.
        """
        from runtime.datasets.reader import open_dataset

        self.close()
        try:
            episode = open_dataset(self._config.path).episode(self._config.episode, self._mapping())
            self._check(episode)
            for camera in episode.cameras:
                self._pictures[camera] = episode.pictures(camera)
            self._episode = episode
            self._decode(self._config.start_frame)
        except RecordingError as error:
            self.close()
            raise TransportError(str(error)) from error

    def _mapping(self) -> ColumnMapping:
        mapping = self._config.mapping
        if mapping.videos is not None:
            return mapping
        return mapping.model_copy(
            update={"videos": {camera.key: video_key(camera.key) for camera in self._robot.cameras}}
        )

    def _check(self, episode: RecordedEpisode) -> None:
        where = f"{self._config.path}, episode {self._config.episode}"
        joints, poses = self._robot.dim, EEF_WIDTH * len(self._robot.arms)
        widths = {
            "state": (episode.qpos, joints),
            "velocity": (episode.qvel, joints),
            "effort": (episode.effort, joints),
            "action": (episode.action, joints),
            "eef": (episode.eef, poses),
            "action_eef": (episode.action_eef, poses),
        }
        for name, (rows, width) in widths.items():
            if rows is not None and rows.shape[1] != width:
                raise SetupError(
                    f"{where}: the {name} column is {rows.shape[1]} wide, {self._robot.name} needs {width}"
                )
        if self._config.start_frame >= episode.length:
            raise SetupError(
                f"{where} has frames 0 to {episode.length - 1}, start_frame is {self._config.start_frame}"
            )

    def begin_run(self) -> None:
        """Start the run: frame 0 is due now."""
        self._start = self._clock.now()
        self._next = 0

    def end_run(self) -> None:
        """End the run: the first frame is delivered again."""
        self._start = None
        self._standing_due = float("-inf")

    def receive(self, timeout: float) -> Observation | None:
        episode = self._episode
        if episode is None:
            raise TransportError(f"the dataset {self._config.path} is not connected")
        deadline = self._clock.now() + max(timeout, 0.0)
        if self._start is None:
            return self._receive_idle(episode, deadline)
        return self._receive_running(episode, self._start, deadline)

    def _receive_idle(self, episode: RecordedEpisode, deadline: float) -> Observation | None:
        if not self._wait(self._standing_due, deadline):
            return None
        now = self._clock.now()
        self._standing_due = now + 1 / episode.fps
        return self._observation(episode, self._config.start_frame, now)

    def _receive_running(self, episode: RecordedEpisode, start: float, deadline: float) -> Observation | None:
        frames = episode.length - self._config.start_frame
        if self._next >= frames:
            self._clock.sleep_until(deadline)
            return None
        due = start + self._next / episode.fps
        if self._clock.now() + TOLERANCE < due:
            self._prefetch(self._config.start_frame + self._next)
        if not self._wait(due, deadline):
            return None
        newest = int((self._clock.now() + TOLERANCE - start) * episode.fps)
        frame = min(max(newest, self._next), frames - 1)
        self._skipped += frame - self._next
        self._next = frame + 1
        return self._observation(episode, self._config.start_frame + frame, start + frame / episode.fps)

    def _wait(self, due: float, deadline: float) -> bool:
        """Wait until `due`, at most until `deadline`; return True if `due` has been reached."""
        if self._clock.now() + TOLERANCE < due:
            self._clock.sleep_until(min(due, deadline))
        return self._clock.now() + TOLERANCE >= due

    def _prefetch(self, row: int) -> None:
        """Decode the pictures of `row` before it is due.

        Errors are ignored here: they are raised when the row is due and its pictures are decoded again.
        """
        with suppress(RecordingError):
            self._decode(row)

    def _decode(self, row: int) -> dict[str, UInt8]:
        return {camera: pictures[row] for camera, pictures in self._pictures.items()}

    def _observation(self, episode: RecordedEpisode, row: int, due: float) -> Observation:
        try:
            pictures = self._decode(row)
        except RecordingError as error:
            raise TransportError(str(error)) from error
        arrived = self._clock.now()
        captured = min(due, arrived)  # a frame may be due TOLERANCE early, but is never newer than now
        self._sequence += 1
        return Observation(
            sequence=self._sequence,
            arrived=arrived,
            captured=dict.fromkeys(self._streams(episode), captured),
            qpos=episode.qpos[row],
            pictures=pictures,
            qvel=None if episode.qvel is None else episode.qvel[row],
            effort=None if episode.effort is None else episode.effort[row],
            eef=None if episode.eef is None else episode.eef[row],
            reported_action=None if episode.action is None else episode.action[row],
            reported_action_eef=None if episode.action_eef is None else episode.action_eef[row],
            last=row == episode.length - 1 and self._start is not None,
            prompt=episode.task,
        )

    def _streams(self, episode: RecordedEpisode) -> tuple[str, ...]:
        eef = () if episode.eef is None else ("eef",)
        return ("joints", *eef, *self._pictures)

    def faults(self) -> dict[str, int]:
        return {"skipped_frames": self._skipped}

    def close(self) -> None:
        for pictures in self._pictures.values():
            pictures.close()
        self._pictures.clear()
        self._episode = None


class DatasetSink(Sink):
    """Sink that counts the commands and sends nothing."""

    def __init__(self) -> None:
        self.commands = 0

    def connect(self) -> None:
        """Do nothing, because there is no robot."""

    def send(self, command: RobotCommand) -> None:
        """Count `command`."""
        self.commands += 1

    def close(self) -> None:
        """Do nothing, because nothing is open."""


def capabilities(config: Config) -> Capabilities:
    """Return the abilities of a recording: it ends, and moves no robot.

    It measures poses if the mapping names a column of poses.
    """
    return Capabilities(moves_robot=False, is_finite=True, measures_eef=config.mapping.eef is not None)


def source(config: Config, robot: Robot, clock: Clock) -> DatasetSource:
    """Create the source that plays the episode."""
    return DatasetSource(config, robot, clock)


def sink(config: Config, robot: Robot, clock: Clock) -> DatasetSink:
    """Create a sink that moves nothing."""
    return DatasetSink()
