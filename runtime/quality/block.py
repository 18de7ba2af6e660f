"""Input of the checks: an episode's facts, and its rows in blocks, whatever it is stored as."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from runtime.core.types import Float32, Float64
from runtime.quality.luma import FrameStream
from runtime.quality.report import Severity

Bools = NDArray[np.bool_]

BLOCK_ROWS = 64  # at most, in a block


@dataclass(frozen=True, slots=True)
class Vector:
    """Facts about a column of vectors that are known before it is read.

    `role` is its use by the checks: "state" and "action" are joints, "poses" 8 numbers per arm (x, y, z,
    quaternion w, x, y, z, gripper), "other" anything else. `sparse` columns may be missing in any row.
    """

    width: int
    names: tuple[str, ...]
    role: str = "other"
    sparse: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class VectorColumn:
    """A column of vectors in a block: `values` float32 [N, W], zeros where a row is `missing` or `malformed`."""

    values: Float32
    missing: Bools
    malformed: Bools  # rows of another width than declared


@dataclass(frozen=True, slots=True, eq=False)
class Block:
    """Consecutive rows from `first` on; an absent column is an absent key."""

    first: int
    rows: int
    index: NDArray[np.int64] | None  # as numbered in the file
    clocks: Mapping[str, Float64]  # [N] s: each has to increase
    vectors: Mapping[str, VectorColumn]
    captured: Mapping[str, Float64] = field(default_factory=dict)  # by stream [N] s, NaN unknown
    repeated: Mapping[str, Bools] = field(default_factory=dict)  # by camera
    lost: Mapping[str, Bools] = field(
        default_factory=dict
    )  # by camera: it gave a picture, its video has none
    simulated: Bools | None = None  # rows whose action moved a simulated robot


class VideoEnd(NamedTuple):
    """The row from which on a camera has no video, and why."""

    row: int
    reason: str


@dataclass(frozen=True, slots=True, eq=False)
class JointSpecs:
    """Facts about the robot's numbers [D]; limits and velocities are NaN where they are not known."""

    names: tuple[str, ...]
    groups: tuple[str, ...]  # of each number
    grippers: Bools
    bases: Bools  # speeds, no places
    lower: Float64
    upper: Float64
    velocity: Float64

    @property
    def position_mask(self) -> Bools:
        """Those that are places of joints: neither grippers nor speeds."""
        return ~(self.grippers | self.bases)


class EpisodeSource(ABC):
    """One episode as it lies on disk. What is damaged beyond its rows is a RecordingError of `blocks`."""

    name: str
    fps: float
    frames: int | None  # rows that were promised; None where nobody did
    started: str  # the clock among `Block.clocks` that ages and gaps are measured on, "" for none
    vectors: Mapping[str, Vector]
    cameras: Mapping[str, tuple[int, int] | None]  # (height, width) as declared, by camera
    ends: Mapping[str, VideoEnd]  # of the videos that were lost, by camera
    schema: Mapping[str, Any]  # of a collection: may hold max_skew_s, min_length_s
    remarks: Sequence[tuple[str, Severity, str]]  # kind, severity and sentence of what its documents say
    drawn: bool = False  # its pictures are those of a simulated bench

    @abstractmethod
    def blocks(self) -> Iterator[Block]:
        """The rows, in order; raises RecordingError where they cannot be read on."""

    @abstractmethod
    def open_frames(self, camera: str, sampling: int) -> FrameStream:
        """The pictures of one camera; raises RecordingError where they cannot be opened."""

    @abstractmethod
    def joints(self) -> tuple[JointSpecs | None, str]:
        """The robot's numbers, and why their limits are not known, "" where they are; None: no state or action."""
