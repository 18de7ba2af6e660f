"""Journal interface and its records: dataset rows, executed ticks, raw chunks."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from runtime.core.sentences import Pattern
from runtime.core.types import ControlSource, Float32, Space, UInt8
from runtime.ipc.messages import ExecutedTick

_VIDEO_ENDS = Pattern(
    "recording.video_ends",
    "{why}; its video ends at row {row}, all else is recorded on",
)


Status = Literal["finished", "interrupted", "failed"]


@dataclass(frozen=True, slots=True)
class Row:
    """Row `index` of the dataset grid: the observation and the action sent at one control tick.

    Vectors are as in `runtime.core.types.Observation`. `captured` has the capture time of each stream on our monotonic
    clock [s]. `pictures` has one entry per recorded camera, RGB uint8 [H, W, 3]; None repeats the previous picture and
    is flagged.
    """

    index: int
    step: int
    tick_time: float  # planned time of the tick, our monotonic clock [s]
    sequence: int  # `Observation.sequence`
    qpos: Float32
    action: Float32
    captured: Mapping[str, float]
    pictures: Mapping[str, UInt8 | None]
    control_source: ControlSource
    qvel: Float32 | None = None
    effort: Float32 | None = None
    eef: Float32 | None = None
    eef_action: Float32 | None = None
    eef_measured: bool = False  # eef was measured by the robot, not computed by forward kinematics
    eef_action_reported: bool = False  # eef_action was reported by the robot for this action
    intervention: bool = False
    stale: frozenset[str] = frozenset()  # cameras without a new picture for too long
    lost: frozenset[str] = frozenset()  # cameras whose new picture could not be recorded
    bench: str | None = (
        None  # state of a simulated bench, see bench_truth; None: unchanged since the previous row
    )


@dataclass(frozen=True, slots=True)
class RawChunk:
    """Chunk of the policy in the policy's own space, with its placement on the timeline."""

    chunk_id: int
    observation_step: int
    arrival_step: int  # -1: it never reached the control loop
    actions: Float32  # [H, W]
    target_steps: NDArray[np.int64]  # [H] control step of each row; -1: dropped
    space: Space
    delay: int  # arrival_step - observation_step
    mistimed: int = 0  # [steps] by which k_max shifted it
    inference_ms: float = float("nan")
    strategy: str = ""  # kind of the strategy that merged it
    overlap: int = 0  # [steps] from its arrival on that were blended with the previous plan
    ik_position_error: Float32 | None = (
        None  # [H, arms] [m], largest of the steps made from each row; NaN if none
    )
    ik_rotation_error: Float32 | None = None  # [H, arms] [rad], likewise
    ik_flags: UInt8 | None = None  # [H, arms] bits of `kinematics.base.IkFlag`, of all these steps
    eef: str = (
        ""  # "measured" or "fk": origin of the poses that the policy received or that its rows refer to
    )


Record = Row | ExecutedTick | RawChunk


IMPORTED = "imported"  # kind of an episode that was recorded by other software
VIDEO_LOST = "video_lost"  # kind of the event about a camera whose video has ended; repair reads it


@dataclass(frozen=True, slots=True)
class LostCamera:
    """Camera whose video ends at row `row`, while the recording continues without it."""

    camera: str
    row: int
    reason: str

    @property
    def text(self) -> str:
        """Sentence for the operator."""
        return _VIDEO_ENDS(why=self.reason, row=self.row)


@dataclass(frozen=True, slots=True)
class Outcome:
    """Outcome of an episode, which is written when the episode ends.

    It consists of the status, the reason for the end, the time, and further `details`.
    """

    status: Status
    reason: str
    ended_wall: float  # Unix time [s]
    details: Mapping[str, object] = field(default_factory=dict)


class Journal(ABC):
    """Writer of one episode while it happens; a kill at any moment loses at most the last second."""

    @abstractmethod
    def begin(self, manifest: Mapping[str, object]) -> None:
        """Create the episode's folder with its manifest. Raises RecordingError if that is impossible."""

    @abstractmethod
    def append(self, record: Record) -> None:
        """Record one row, tick or chunk.

        The call never waits for an encoder, and takes no longer than one write. Raises RecordingError.
        """

    @abstractmethod
    def append_event(self, event: Mapping[str, object]) -> None:
        """Append one event to the episode's log."""

    @abstractmethod
    def pop_lost_cameras(self) -> Sequence[LostCamera]:
        """Return the cameras whose video was lost since the last call, in this episode or the one that ended last."""

    @abstractmethod
    def end(self, outcome: Outcome) -> None:
        """Write all waiting records, close every file, and write the outcome last."""
