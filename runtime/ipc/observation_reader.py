"""Newest observation for the control tick, without pictures."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from runtime.core.types import Float32, Float64
from runtime.ipc.shared_state import SharedState


@dataclass(frozen=True, slots=True)
class LatestObservation:
    """Newest state of the robot: joints [D], and capture times on our monotonic clock [s]."""

    sequence: int  # 0 before the first observation
    qpos: Float32  # as measured
    joints: Float64  # qpos in double precision
    joints_captured: float
    pictures_captured: tuple[tuple[str, float], ...]  # by camera; NaN if it never sent a picture
    measured: bool  # every joint has a finite number
    implausible_reason: str = ""  # why the joints cannot be true

    def is_fresh(self, now: float, allowed: float) -> bool:
        """Return True if the joints are known, plausible, and at most `allowed` seconds old."""
        return self.measured and not self.implausible_reason and now - self.joints_captured <= allowed

    def picture_ages(self, now: float) -> dict[str, float]:
        """Return the age of each camera's newest picture [s]."""
        return {camera: now - captured for camera, captured in self.pictures_captured}


class ObservationReader:
    """Reader of the newest observation in shared state; decodes each observation once."""

    def __init__(self, shared: SharedState) -> None:
        self._shared_state = shared
        self._version = -1
        self._seen: LatestObservation

    def read_latest(self) -> LatestObservation:
        """Return the newest observation; it is decoded only if it is new."""
        version = self._shared_state.observation.version
        if version != self._version:
            self._seen, self._version = self._read(), version
        return self._seen

    def _read(self) -> LatestObservation:
        record = self._shared_state.observation.read()
        qpos = record["qpos"].copy()
        sequence = int(record["sequence"])
        captured = record["picture_captured"].tolist()
        return LatestObservation(
            sequence=sequence,
            qpos=qpos,
            joints=qpos.astype(np.float64),
            joints_captured=float(record["joints_captured"]),
            pictures_captured=tuple(zip(self._shared_state.layout.cameras, captured, strict=False)),
            measured=sequence > 0 and bool(np.isfinite(qpos).all()),
        )
