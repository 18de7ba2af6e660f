"""Assignment of cameras to the slots of a RoboArena request, as the deployment declares it.

It is declared because the order of a robot's cameras does not tell their slots. Servers and most clients number the
exterior cameras from 0, the original client from 1. A server that receives the other numbering uses a picture for the
wrong view, or drops it, without an error.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Literal

from runtime.core.errors import ConfigurationError, ContradictionError
from runtime.policies.arena.requirements import ServerRequirements

if TYPE_CHECKING:
    from robots import Robot

Numbering = Literal["0-based", "1-based"]
Slot = Literal["first", "second", "wrist", "first_stereo", "second_stereo", "wrist_stereo"]
_FIRST: dict[Numbering, int] = {"0-based": 0, "1-based": 1}


class Cameras:
    """Slots of a RoboArena request and the robot's cameras (observation keys) that fill them.

    Raises ConfigurationError for unknown cameras or repeated slots.
    """

    def __init__(self, cameras: Mapping[str, Slot], numbering: Numbering, robot: Robot) -> None:
        robot_cameras = [camera.key for camera in robot.cameras]
        unknown = [key for key in cameras if key not in robot_cameras]
        if unknown:
            raise ConfigurationError(
                f"policy.cameras names {', '.join(unknown)}; cameras of {robot.name}: {', '.join(robot_cameras)}"
            )
        self._by_slot = {slot: key for key, slot in cameras.items()}
        if len(self._by_slot) != len(cameras):
            raise ConfigurationError(
                f"policy.cameras puts two cameras into one slot: {dict(cameras)}; allowed: each slot once"
            )
        self._numbering: Numbering = numbering

    def assign(self, wants: ServerRequirements) -> dict[str, str]:
        """Return the observation key for each request key of the views that the server needs.

        The result is in the order of the protocol's messages.

        Cameras for other views are not sent. Raises ContradictionError if no camera is declared for a needed view.
        """
        assigned: dict[str, str] = {}
        for slot, key in _keys(wants, self._numbering):
            if slot not in self._by_slot:
                declared = ", ".join(f"{k} = {s}" for s, k in self._by_slot.items()) or "none"
                raise ContradictionError(
                    f"the server wants {key} (n_external_cameras = {wants.externals}, needs_wrist_camera = "
                    f"{wants.wrist}, needs_stereo_camera = {wants.stereo}), policy.cameras has no {slot!r}, only "
                    f"{declared}; say which camera it is"
                )
            assigned[key] = self._by_slot[slot]
        return assigned


def _keys(wants: ServerRequirements, numbering: Numbering) -> list[tuple[Slot, str]]:
    """Return (slot, request key) for each picture that the server needs, in the order of the protocol's messages."""
    slots: tuple[Slot, Slot] = ("first", "second")
    stereo: tuple[Slot, Slot] = ("first_stereo", "second_stereo")
    keys: list[tuple[Slot, str]] = []
    for place in range(wants.externals):
        name = f"observation/exterior_image_{_FIRST[numbering] + place}"
        keys.append((slots[place], f"{name}_left"))
        if wants.stereo:
            keys.append((stereo[place], f"{name}_right"))
    if wants.wrist:
        keys.append(("wrist", "observation/wrist_image_left"))
        if wants.stereo:
            keys.append(("wrist_stereo", "observation/wrist_image_right"))
    return keys
