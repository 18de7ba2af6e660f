"""Notices pictures that do not change: a node stamps its messages, not what each camera last took."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from runtime.core.types import UInt8

FROZEN_S = 0.5  # after which a camera counts as frozen; nothing is decided by it, a person is told
_SAMPLED_ROWS = 16  # every so many rows are compared first: two pictures of a live camera differ there


class FrozenCameraDetector:
    """Since when each camera shows what it shows; for the pictures of one source, in their order."""

    def __init__(self) -> None:
        self._newest: dict[str, tuple[UInt8, float]] = {}  # by camera: picture, time of the first like it
        self._frozen: set[str] = set()

    def captured(self, pictures: Mapping[str, UInt8], time: float) -> dict[str, float]:
        """For each camera `time`, or where its picture is exactly the one before, the time of that."""
        times = {}
        for camera, picture in pictures.items():
            before = self._newest.get(camera)
            if before is None or not _equal(before[0], picture):
                self._newest[camera] = (picture, time)
                self._frozen.discard(camera)
            times[camera] = self._newest[camera][1]
        return times

    def newly_frozen(self, time: float) -> list[str]:
        """Cameras that show the same for FROZEN_S at `time`; each is named once, until it moves again."""
        frozen = {camera for camera, (_, since) in self._newest.items() if time - since > FROZEN_S}
        new = sorted(frozen - self._frozen)
        self._frozen |= frozen
        return new


def _equal(one: UInt8, other: UInt8) -> bool:
    """Bit by bit; most pictures are told apart by a few rows."""
    if one.shape != other.shape:
        return False
    sampled = slice(None, None, _SAMPLED_ROWS)
    return np.array_equal(one[sampled], other[sampled]) and np.array_equal(one, other)
