"""A journal, and the records it takes: dataset rows, executed ticks, raw chunks."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from runtime.core.sentences import Pattern
from runtime.core.types import Float32, Space, UInt8

_VIDEO_ENDS = Pattern(
    "recording.video_ends",
    "{why}; its video ends at row {row}, all else is recorded on",
)


ControlSource = Literal["none", "hold", "motion", "policy", "teleop", "estop", "sim", "unknown"]
Status = Literal["finished", "interrupted", "failed"]


@dataclass(frozen=True, slots=True)
class Row:
    """Row `index` of the dataset grid: the observation assembled and the action sent at one control tick.

    Vectors as in runtime.core.types.Observation. `captured` holds capture times per stream on our monotonic clock.
    `pictures` has one entry per recorded camera, RGB uint8; None repeats the previous picture (flagged).
    """

    index: int
    step: int
    tick_time: float  # planned time of the tick, our monotonic clock [s]
    sequence: int  # Observation.sequence
    qpos: Float32
    action: Float32
    captured: Mapping[str, float]
    pictures: Mapping[str, UInt8 | None]
    control_source: ControlSource
    qvel: Float32 | None = None
    effort: Float32 | None = None
    eef: Float32 | None = None
    eef_action: Float32 | None = None
    eef_measured: bool = False  # eef came from the robot, not from forward kinematics
    eef_action_reported: bool = False  # likewise eef_action, for this very action
    intervention: bool = False
    stale: frozenset[str] = frozenset()  # cameras that have given no new picture for too long
    lost: frozenset[str] = frozenset()  # cameras that gave one which could not be kept
    bench: str | None = None  # what a simulated bench says, see bench_truth; None: as in the row before


@dataclass(frozen=True, slots=True)
class ExecutedTick:
    """One control tick at full rate: what smoothing asked for, what safety let through, when it was sent."""

    step: int
    planned: float
    sent: float
    sequence: int
    control_source: ControlSource
    qpos: Float32  # measured, as the tick saw it
    smoothed: Float32 | None  # before safety; None where nothing was asked for
    executed: Float32 | None  # what was sent; None where nothing was
    chunk_ids: tuple[int, ...] = ()
    weights: tuple[float, ...] = ()
    changes: tuple[str, ...] = ()  # what safety changed, or why it refused
    refused: bool = False
    woke: float | None = None  # when the loop woke for the tick; None in lockstep


@dataclass(frozen=True, slots=True)
class RawChunk:
    """One answer of the policy, in the policy's own space, and where it fell on the timeline."""

    chunk_id: int
    observation_step: int
    arrival_step: int  # -1: it never arrived at the control loop
    actions: Float32  # [H, W]
    target_steps: NDArray[np.int64]  # [H] control step each row was meant for; -1: dropped
    space: Space
    delay: int  # arrival_step - observation_step
    mistimed: int = 0  # steps by which k_max shifted it
    inference_ms: float = float("nan")
    strategy: str = ""  # the kind that merged it
    overlap: int = 0  # steps from the arrival on that were blended with what was planned before
    ik_position_error: Float32 | None = (
        None  # [H, arms] m, of the worst step made of each row; NaN where none was
    )
    ik_rotation_error: Float32 | None = None  # [H, arms] rad, likewise
    ik_flags: UInt8 | None = None  # [H, arms] bits of kinematics.base.IkFlag, of all these steps
    eef: str = ""  # "measured" or "fk": what the policy saw of poses, or its rows are relative to


Record = Row | ExecutedTick | RawChunk


IMPORTED = "imported"  # the kind of an episode that was recorded elsewhere, in whatever way
VIDEO_LOST = "video_lost"  # the event of a camera whose video has ended; repair goes by it


@dataclass(frozen=True, slots=True)
class LostCamera:
    """A camera whose video ends at row `row`, while all else is recorded on."""

    camera: str
    row: int
    reason: str

    @property
    def text(self) -> str:
        """For a person."""
        return _VIDEO_ENDS(why=self.reason, row=self.row)


@dataclass(frozen=True, slots=True)
class Outcome:
    """End of an episode."""

    status: Status
    reason: str
    ended_wall: float  # Unix time [s]
    details: Mapping[str, object] = field(default_factory=dict)


class Journal(ABC):
    """Writes one episode while it happens, so that a kill at any moment loses at most the last second."""

    @abstractmethod
    def begin(self, manifest: Mapping[str, object]) -> None:
        """Create the episode's folder with its manifest; raises RecordingError where that cannot be."""

    @abstractmethod
    def append(self, record: Record) -> None:
        """Take one record; waits for no encoder and no longer than a write; raises RecordingError."""

    @abstractmethod
    def append_event(self, event: Mapping[str, object]) -> None:
        """Append one event to the episode's log."""

    @abstractmethod
    def pop_lost_cameras(self) -> Sequence[LostCamera]:
        """Cameras that this episode, or the one that ended last, has lost since the last call."""

    @abstractmethod
    def end(self, outcome: Outcome) -> None:
        """Drain, close every file, and rename the outcome into place last."""
