"""Conversion between LeRobot's named features and joints of ours.

LeRobot's environment runs this module: it needs numpy alone.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

_UNITS = {"same": ((0.0, 1.0), (0.0, 1.0)), "degrees": ((0.0, 180.0), (0.0, math.pi))}
_NEAR = 0.15  # [rad] or [m]: more than the servo error that a station takes for no displacement
_LARGEST = 1e9  # of any number of a device
_KEYS = ("feature", "unit", "theirs", "ours")


def _is_range(pair: object) -> bool:
    """Return True for two different finite numbers."""
    numbers = isinstance(pair, list | tuple) and all(type(end) in (int, float) for end in pair)
    return numbers and len(pair) == 2 and math.isfinite(pair[0] - pair[1]) and pair[0] != pair[1]  # type: ignore[arg-type,index]


class UnusableValue(ValueError):
    """Value of a device that cannot be passed on; `fault` is the name under which it is counted."""

    def __init__(self, fault: str, text: str) -> None:
        super().__init__(text)
        self.fault = fault


@dataclass(frozen=True)
class JointFeature:
    """Feature that is one joint: the joint's number is `scale` times the feature's, plus `offset`."""

    feature: str
    scale: float
    offset: float
    is_degrees: bool = False

    @classmethod
    def from_table(cls, name: str, table: Mapping[str, Any]) -> JointFeature:
        """Return the feature of the joint `name`, from `feature` and `unit`, or `theirs` and `ours`.

        Raises:
            ValueError: The table is not valid.
        """
        if not isinstance(table, Mapping) or not isinstance(table.get("feature"), str) or {*table} - {*_KEYS}:
            raise ValueError(f"joint {name}: {table!r:.200}; allowed: feature, and unit or theirs and ours")
        unit = table.get("unit", "same")
        if unit not in _UNITS:
            raise ValueError(f"joint {name}: unit = {unit!r}; allowed: {', '.join(_UNITS)}")
        theirs, ours = _UNITS[unit]
        ranges = table.get("theirs"), table.get("ours")
        if ranges != (None, None):
            if unit != "same" or not all(map(_is_range, ranges)):
                raise ValueError(
                    f"joint {name}: theirs = {ranges[0]!r}, ours = {ranges[1]!r}, unit = {unit!r}; allowed: unit, or "
                    "both theirs and ours with two different numbers each"
                )
            theirs, ours = ranges  # type: ignore[assignment]
        scale = (ours[1] - ours[0]) / (theirs[1] - theirs[0])
        return cls(table["feature"], scale, ours[0] - scale * theirs[0], unit == "degrees")

    def read(self, values: Mapping[str, Any]) -> float:
        """Return the joint's number from the device's values. Raises UnusableValue if it is absent or not finite."""
        if self.feature not in values:
            raise UnusableValue("missing_value", f"{self.feature} is missing; it has {', '.join(values)}")
        try:
            value = float(values[self.feature])
        except (TypeError, ValueError):
            value = math.nan
        if not abs(value) < _LARGEST:  # NaN is not below it either
            raise UnusableValue("not_finite", f"{self.feature} is {values[self.feature]!r:.40}")
        return self.scale * value + self.offset

    def write(self, number: float) -> float:
        """Return the feature's number for the joint's `number`."""
        return (number - self.offset) / self.scale


class JointMap:
    """Features of all joints, by group and in the order of the group's joints."""

    def __init__(self, groups: Mapping[str, Sequence[JointFeature]]) -> None:
        self._groups = {name: tuple(joints) for name, joints in groups.items()}

    @classmethod
    def from_tables(cls, groups: Mapping[str, Mapping[str, Mapping[str, Any]]]) -> JointMap:
        """Return the map of group = joint = table. Raises ValueError if a table is not valid."""
        if not isinstance(groups, Mapping) or not all(
            isinstance(joints, Mapping) for joints in groups.values()
        ):
            raise ValueError(f"joints = {groups!r:.200}; allowed: a table per group of the robot")
        return cls(
            {
                group: [JointFeature.from_table(f"{group}.{name}", table) for name, table in joints.items()]
                for group, joints in groups.items()
            }
        )

    @property
    def features(self) -> tuple[str, ...]:
        """Names of all features, in the order of the robot's joints."""
        return tuple(joint.feature for joints in self._groups.values() for joint in joints)

    @property
    def in_degrees(self) -> tuple[str, ...]:
        """Names of the features that the device has in degrees."""
        return tuple(
            joint.feature for joints in self._groups.values() for joint in joints if joint.is_degrees
        )

    @property
    def tolerance(self) -> np.ndarray[Any, Any]:
        """Distance [D] from a measured joint within which the first command after a connection must be.

        In the joint's own unit. A gripper has none: what it holds keeps it from its command.
        """
        return np.array([np.inf if "gripper" in name else _NEAR for name in self.features])

    def read_state(self, values: Mapping[str, Any]) -> dict[str, np.ndarray[Any, Any]]:
        """Return the joints float32 by group. Raises UnusableValue if one is absent or not finite."""
        return {
            group: np.array([joint.read(values) for joint in joints], np.float32)
            for group, joints in self._groups.items()
        }

    def write_action(self, target: Sequence[float] | np.ndarray[Any, Any]) -> dict[str, float]:
        """Return the device's action for a target [D]."""
        joints = [joint for joints in self._groups.values() for joint in joints]
        return {
            joint.feature: joint.write(float(number)) for joint, number in zip(joints, target, strict=True)
        }


def read_image(name: str, values: Mapping[str, Any], shape: Sequence[int] | None) -> np.ndarray[Any, Any]:
    """Return the picture uint8 [H, W, 3] of the feature `name`, which must have the `shape` that was declared.

    Raises:
        UnusableValue: It is absent, or no such picture.
    """
    if name not in values:
        raise UnusableValue("missing_value", f"the picture {name} is missing; it has {', '.join(values)}")
    image = np.asarray(values[name])
    expected = None if shape is None else tuple(shape)
    plain = image.dtype == np.uint8 and image.ndim == 3 and image.shape[2] == 3 and image.size > 0
    if not plain or expected not in (None, image.shape):
        wanted = "[H, W, 3]" if expected is None else list(expected)
        raise UnusableValue(
            "wrong_picture",
            f"the picture {name} is {image.dtype} {list(image.shape)}; expected uint8 {wanted}",
        )
    return np.ascontiguousarray(image)
