"""Checks of values: present, of the declared width, finite, unit quaternions, no jumps."""

from __future__ import annotations

import numpy as np

from runtime.core.types import EEF_WIDTH, Float32
from runtime.quality.block import Block, EpisodeSource, JointSpecs, Vector, VectorColumn
from runtime.quality.report import Flag, FlagCollector, FrameRun, RunCollector, Severity, frame_range, listed
from runtime.quality.settings import QualitySettings

MOVING = ("state", "action")


class ValueCheck:
    """Check of every column of vectors, block by block.

    Values that are not finite are treated as unknown by all other checks; their rows are flagged and are not removed.
    """

    def __init__(
        self,
        source: EpisodeSource,
        joints: JointSpecs | None,
        settings: QualitySettings,
        flags: FlagCollector,
    ) -> None:
        self._columns = [
            _Column(name, vector, source.fps, joints, settings, flags)
            for name, vector in source.vectors.items()
        ]

    def add(self, block: Block) -> None:
        """Check the next rows."""
        for column in self._columns:
            column.add(block.first, block.vectors[column.name])

    def close(self) -> None:
        """End the checks."""
        for column in self._columns:
            column.close()


class _Column:
    def __init__(
        self,
        name: str,
        vector: Vector,
        fps: float,
        joints: JointSpecs | None,
        settings: QualitySettings,
        flags: FlagCollector,
    ) -> None:
        self.name = name
        self._vector = vector
        self._fps = fps
        self._settings = settings
        self._flags = flags
        self._broken: set[int] = set()  # dimensions that are not finite in the open run
        self._speeds = self._allowed(joints)
        self._before = np.full(vector.width, np.nan, np.float32)
        self._fastest = 0  # the dimension of the worst jump
        self._runs = {
            "missing": RunCollector(self._missing),
            "dimensions": RunCollector(self._malformed),
            "not_finite": RunCollector(self._not_finite),
            "quaternion": RunCollector(self._no_rotation),
            "jump": RunCollector(self._jump),
        }
        self._worst: dict[int, int] = {}

    def _allowed(self, joints: JointSpecs | None) -> np.ndarray[tuple[int], np.dtype[np.float64]] | None:
        """Return the allowed change of each dimension [1/s], inf if any change is allowed.

        None if the column is not checked.
        """
        width, settings = self._vector.width, self._settings
        if self._vector.role == "poses":
            bound = np.full(width, np.inf)
            bound[np.arange(width) % EEF_WIDTH < 3] = settings.eef_speed
            return bound
        if self._vector.role not in MOVING:
            return None
        if joints is None or len(joints.names) != width:
            return np.full(width, settings.joint_speed)
        bounded = np.isfinite(joints.velocity)
        bound = np.where(bounded, joints.velocity * settings.speed_factor, settings.joint_speed)
        return np.where(joints.position_mask, bound, np.inf)

    def add(self, first: int, numbers: VectorColumn) -> None:
        finite = np.isfinite(numbers.values)
        present = ~(numbers.missing | numbers.malformed)
        broken = present & ~finite.all(axis=1)
        self._runs["missing"].add(first, numbers.missing)
        self._runs["dimensions"].add(first, numbers.malformed)
        if not broken.any():
            self._runs["not_finite"].add(first, broken)
        for row in np.flatnonzero(broken):  # rare, so one row at a time, to name the dimensions
            self._runs["not_finite"].add(first + int(row), np.ones(1, np.bool_))
            self._broken |= set(np.flatnonzero(~finite[row]).tolist())
        usable = np.where(finite & present[:, None], numbers.values, np.nan).astype(np.float32)
        if self._vector.role == "poses":
            self._rotations(first, usable)
        if self._speeds is not None:
            self._jumps(first, usable)

    def _rotations(self, first: int, values: Float32) -> None:
        arms = values.reshape(len(values), -1, EEF_WIDTH)
        off = np.abs(np.linalg.norm(arms[:, :, 3:7], axis=2) - 1.0).max(axis=1)
        self._runs["quaternion"].add(
            first, np.nan_to_num(off) > self._settings.quaternion_error, np.nan_to_num(off)
        )

    def _jumps(self, first: int, values: Float32) -> None:
        assert self._speeds is not None
        steps = np.abs(np.diff(np.concatenate([self._before[None], values]), axis=0)) * self._fps
        excess = np.nan_to_num(steps / self._speeds, nan=0.0)
        worst = excess.max(axis=1)
        for row in np.flatnonzero(worst > 1.0):
            self._worst[first + int(row)] = int(np.argmax(excess[row]))
        self._runs["jump"].add(first, worst > 1.0, worst)
        self._before = values[-1]

    def close(self) -> None:
        for runs in self._runs.values():
            runs.close()

    def _missing(self, run: FrameRun) -> None:
        severity: Severity = "info" if self._vector.sparse else "error" if self._moves else "warning"
        self._flag("missing_values", severity, run, f"{self.name} was not recorded", None, None)

    def _malformed(self, run: FrameRun) -> None:
        self._flag(
            "dimensions", "error", run, f"{self.name} has another width than {self._vector.width}", None, None
        )

    def _not_finite(self, run: FrameRun) -> None:
        names = listed([self._vector.names[dim] for dim in sorted(self._broken)])
        self._broken = set()
        severity: Severity = "error" if self._moves else "warning"
        text = f"{self.name} is not finite in {names}: it counts as 0"
        self._flag("not_finite", severity, run, text, float(run.frames), 0.0)

    def _no_rotation(self, run: FrameRun) -> None:
        text = f"{self.name}: the length of a quaternion is {run.value:.3f} off 1"
        self._flag("quaternion", "error", run, text, run.value, self._settings.quaternion_error)

    def _jump(self, run: FrameRun) -> None:
        assert self._speeds is not None
        dim = self._worst[run.at]
        self._worst = {frame: run_at for frame, run_at in self._worst.items() if frame > run.last}
        bound = float(self._speeds[dim])
        unit = "m/s" if self._vector.role == "poses" else "rad/s"
        text = f"{self.name}: {self._vector.names[dim]} jumps, at {run.value * bound:.2f} {unit}"
        self._flag("jump", "warning", run, text, run.value * bound, bound)

    @property
    def _moves(self) -> bool:
        return self._vector.role in MOVING

    def _flag(
        self,
        kind: str,
        severity: Severity,
        run: FrameRun,
        text: str,
        value: float | None,
        bound: float | None,
    ) -> None:
        sentence = f"{frame_range(run.first, run.last)}: {text}"
        self._flags.add(Flag(kind, severity, run.first, run.last, self.name, sentence, value, bound))
