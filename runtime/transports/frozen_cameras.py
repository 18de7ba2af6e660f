"""Detection of frozen cameras.

A node stamps its messages and not the pictures, so that an old picture seems new.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from runtime.core.types import UInt8

FROZEN_S = 0.5  # [s]; an older picture counts as frozen, which is only reported
_SAMPLED_ROWS = 16  # every 16th row is compared first: enough to tell two pictures of a live camera apart


class FrozenCameraDetector:
    """Detector of cameras whose picture does not change; pass it the pictures of one source in order."""

    def __init__(self) -> None:
        self._newest: dict[str, tuple[UInt8, float]] = {}  # by camera: picture and first time
        self._frozen: set[str] = set()

    def captured(self, pictures: Mapping[str, UInt8], time: float) -> dict[str, float]:
        """Return for each camera the time at which its present picture first appeared.

        That is `time`, or earlier if the picture equals the previous one.
        """
        times = {}
        for camera, picture in pictures.items():
            before = self._newest.get(camera)
            if before is None or not _equal(before[0], picture):
                self._newest[camera] = (picture, time)
                self._frozen.discard(camera)
            times[camera] = self._newest[camera][1]
        return times

    def newly_frozen(self, time: float) -> list[str]:
        """Return the cameras whose picture has not changed for FROZEN_S at `time`.

        Each is returned once, and again only after its picture has changed.
        """
        frozen = {camera for camera, (_, since) in self._newest.items() if time - since > FROZEN_S}
        new = sorted(frozen - self._frozen)
        self._frozen |= frozen
        return new


def _equal(first: UInt8, second: UInt8) -> bool:
    """Return True if two pictures are equal bit by bit; comparing a few rows first decides most cases."""
    if first.shape != second.shape:
        return False
    sampled = slice(None, None, _SAMPLED_ROWS)
    return np.array_equal(first[sampled], second[sampled]) and np.array_equal(first, second)
