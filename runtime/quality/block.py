"""Input of the checks: an episode's properties, and its rows in blocks, independent of how it is stored."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

import robots
from robots import RobotError
from runtime.core.types import Float32, Float64
from runtime.quality.frame_stream import FrameStream
from runtime.quality.report import Severity

Bools = NDArray[np.bool_]

BLOCK_ROWS = 64  # largest number of rows of a block


@dataclass(frozen=True, slots=True)
class Vector:
    """Properties of a column of vectors that are known before it is read.

    `role` is its use by the checks: "state" and "action" are joints, "poses" 8 values per arm (x, y, z, quaternion w,
    x, y, z, gripper), "other" anything else. `sparse` columns may be missing in any row.
    """

    width: int
    names: tuple[str, ...]
    role: str = "other"
    sparse: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class VectorColumn:
    """Column of vectors in a block: `values` float32 [N, W], with zeros in rows that are `missing` or `malformed`."""

    values: Float32
    missing: Bools
    malformed: Bools  # rows of another width than declared


@dataclass(frozen=True, slots=True, eq=False)
class Block:
    """Consecutive rows from row `first` on; columns that the episode lacks have no key."""

    first: int
    rows: int
    index: NDArray[np.int64] | None  # row numbers in the file
    clocks: Mapping[str, Float64]  # by clock [N] [s]; each must increase
    vectors: Mapping[str, VectorColumn]
    captured: Mapping[str, Float64] = field(default_factory=dict)  # by stream [N] [s], NaN if unknown
    repeated: Mapping[str, Bools] = field(default_factory=dict)  # by camera [N]
    lost: Mapping[str, Bools] = field(default_factory=dict)  # by camera [N]: picture missing in the video
    simulated: Bools | None = None  # rows whose action moved a simulated robot


class VideoEnd(NamedTuple):
    """End of a camera's video: the first row without a frame, and the reason."""

    row: int
    reason: str


@dataclass(frozen=True, slots=True, eq=False)
class JointSpecs:
    """Properties of the robot's dimensions [D]; limits and velocities are NaN if unknown."""

    names: tuple[str, ...]
    groups: tuple[str, ...]  # group of each dimension
    grippers: Bools
    bases: Bools  # dimensions that are speeds, not positions
    lower: Float64
    upper: Float64
    velocity: Float64

    @property
    def position_mask(self) -> Bools:
        """Dimensions that are positions of joints: neither grippers nor speeds."""
        return ~(self.grippers | self.bases)


class EpisodeSource(ABC):
    """Source of one episode's rows, properties and pictures, however they are stored.

    Damage that makes later rows unreadable is raised as RecordingError by `blocks`.
    """

    name: str
    fps: float
    frames: int | None  # expected number of rows; None if it is unknown
    started: str  # clock in `Block.clocks` from which ages and gaps are measured, "" for none
    vectors: Mapping[str, Vector]
    cameras: Mapping[str, tuple[int, int] | None]  # declared (height, width) by camera
    ends: Mapping[str, VideoEnd]  # by camera, of videos that were lost
    schema: Mapping[str, Any]  # a collection's requirements: may contain max_skew_s, min_length_s
    remarks: Sequence[tuple[str, Severity, str]]  # kind, severity and sentence of findings in its documents
    drawn: bool = False  # whether its pictures are rendered by a simulated bench

    @abstractmethod
    def blocks(self) -> Iterator[Block]:
        """Yield the rows in order. Raises RecordingError if further rows cannot be read."""

    @abstractmethod
    def open_frames(self, camera: str, sampling: int) -> FrameStream:
        """Open the pictures of one camera. Raises RecordingError if that fails."""

    @abstractmethod
    def joints(self) -> tuple[JointSpecs | None, str]:
        """Return the robot's dimensions, and the reason if their limits are unknown.

        The dimensions are None without state or action; the reason is "" if the limits are known.
        """


GRIPPER = "gripper"  # part of a gripper's name, if no description identifies it
_UNKNOWN = np.nan


def known_joints(robot: str, names: Sequence[str]) -> JointSpecs:
    """Return the dimensions of the described robot `robot`.

    Raises RobotError if the robot is unknown or its dimensions have other names than `names`.
    """
    described = robots.load_robot(robot, groups_of(names))
    if list(described.joint_names) != list(names):
        raise RobotError(f"{robot} has other numbers today: {', '.join(described.joint_names)}")
    groups = [group.name for group in described.groups for _ in range(group.dof)]
    bases = np.zeros(described.dim, np.bool_)
    bases[list(described.speed_dims)] = True
    gripping = np.zeros(described.dim, np.bool_)
    gripping[list(described.gripper_dims)] = True
    return JointSpecs(
        tuple(names), tuple(groups), gripping, bases, described.lower, described.upper, described.velocity
    )


def unknown_joints(names: Sequence[str]) -> JointSpecs:
    """Return dimensions of which only the names are known."""
    unknown = np.full(len(names), _UNKNOWN)
    gripping = np.array([GRIPPER in name.lower() for name in names], np.bool_)
    groups = tuple(name.partition(".")[0] for name in names)
    return JointSpecs(
        tuple(names), groups, gripping, np.zeros(len(names), np.bool_), unknown, unknown, unknown
    )


def groups_of(names: Sequence[str]) -> list[str]:
    """Return the groups that occur in names of the form GROUP.JOINT, each group once, in the order of the names."""
    return list(dict.fromkeys(name.partition(".")[0] for name in names))
