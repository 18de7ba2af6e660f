"""Declared format of poses as rows of numbers."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from runtime.core.errors import ConfigurationError
from runtime.core.settings import Settings

_ORDERS = (
    r"^(xyz|xzy|yxz|yzx|zxy|zyx|xyx|xzx|yxy|yzy|zxz|zyz|XYZ|XZY|YXZ|YZX|ZXY|ZYX|XYX|XZX|YXY|YZY|ZXZ|ZYZ)$"
)
OrientationName = Literal["wxyz", "xyzw", "euler", "rotation_vector", "6d"]


class PoseFormat(Settings):
    """Format of an end effector's pose: per arm x, y, z [m], an orientation, and the gripper's value."""

    orientation: OrientationName = "wxyz"
    """"wxyz", "xyzw": quaternion with the scalar first or last; "euler": Euler angles; "rotation_vector": axis times
    angle; "6d": six numbers of the rotation matrix."""
    euler_order: Annotated[str, Field(pattern=_ORDERS)] = "xyz"
    """Axes of Euler angles; lower case, as in "xyz", for successive rotations about fixed axes (extrinsic), upper case,
    as in "XYZ", for rotations about moving axes (intrinsic)."""
    degrees: bool = False
    """Whether Euler angles and rotation vectors are in degrees instead of radians."""
    sixd: Literal["columns", "rows"] = "columns"
    """Numbers of "6d": the first two columns of the rotation matrix, one after the other, or its first two rows."""
    gripper: bool = True
    """Whether the gripper's value follows each pose (0 for an arm without gripper); if not, grippers stay as
    commanded."""
    frame: str = ""
    """Frame in which poses are expressed: "" for each arm's own frame, the robot's mount frame, or a link of its
    URDF."""
    groups: list[str] = Field(default_factory=list)
    """Groups without end effector (a head, a torso) whose joints are appended to the poses; all others are held."""

    @model_validator(mode="after")
    def _mean_something(self) -> PoseFormat:
        """Reject keys that the chosen orientation does not use: such a mistake would go unnoticed."""
        chosen = self.orientation
        strange = {
            "euler_order": self.euler_order != "xyz" and chosen != "euler",
            "degrees": self.degrees and chosen not in ("euler", "rotation_vector"),
            "sixd": self.sixd != "columns" and chosen != "6d",
        }
        for key, wrong in strange.items():
            if wrong:
                needed = {"euler_order": '"euler"', "degrees": '"euler" or "rotation_vector"', "sixd": '"6d"'}
                raise ValueError(
                    f"{key} = {getattr(self, key)!r} beside orientation = {chosen!r}, which has no such thing; "
                    f"allowed: with orientation = {needed[key]}, or without {key}"
                )
        return self

    def __str__(self) -> str:
        parts: list[str] = [self.orientation]
        parts += [self.euler_order] if self.orientation == "euler" else []
        parts += [f"of {self.sixd}"] if self.orientation == "6d" else []
        parts += ["in degrees"] if self.degrees else []
        parts += [] if self.gripper else ["without gripper"]
        parts += [f"in {self.frame}"] if self.frame else []
        parts += [f"with {', '.join(self.groups)}"] if self.groups else []
        return " ".join(parts)


CANONICAL = PoseFormat()


def reject_pose_format(pose: PoseFormat, key: str) -> None:
    """Raise ConfigurationError if a pose format is declared for the space "joint", which has no poses."""
    changed = pose.model_dump(exclude_defaults=True)
    if changed:
        raise ConfigurationError(
            f'{key} = {changed}, but the space it is for is "joint"; allowed: no format, or the space "eef"'
        )
