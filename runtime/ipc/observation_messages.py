"""Observations from reception to media: the message has slot numbers, and the pictures stay in shared memory."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from runtime.core.types import Observation, UInt8
from runtime.ipc.messages import Observed
from runtime.ipc.shared_state import SharedState

_SAME = (
    *("sequence", "arrived", "captured", "qpos", "qvel", "effort", "eef"),
    *("reported_action", "reported_action_eef", "last", "truth"),
)


class SlotPictures(Mapping[str, UInt8]):
    """Pictures by camera, copied from their slots on access; KeyError if a picture was overwritten."""

    def __init__(self, shared: SharedState, numbers: Mapping[str, int]) -> None:
        self._shared_state = shared
        self._numbers = numbers

    def __getitem__(self, camera: str) -> UInt8:
        picture = self._shared_state.pictures[camera].read(self._numbers[camera])
        if picture is None:
            raise KeyError(camera)
        return picture

    def __contains__(self, camera: object) -> bool:
        """Return True if the observation has a picture of the camera, overwritten or not."""
        return camera in self._numbers

    def __iter__(self) -> Iterator[str]:
        return iter(self._numbers)

    def __len__(self) -> int:
        return len(self._numbers)


def as_message(observation: Observation, numbers: Mapping[str, int]) -> Observed:
    """Return the message for media about an observation whose pictures are in the slots `numbers`."""
    fields = {name: getattr(observation, name) for name in _SAME}
    fields["captured"] = dict(observation.captured)
    return Observed(**fields, pictures={camera: numbers[camera] for camera in observation.pictures})


def as_observation(message: Observed, shared: SharedState) -> Observation:
    """Return the observation in a message."""
    return Observation(
        **{name: getattr(message, name) for name in _SAME}, pictures=SlotPictures(shared, message.pictures)
    )
