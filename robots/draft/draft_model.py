"""Content of a draft: the guessed tables of robot.toml, before they are written."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path

import numpy as np

from robots import shapes
from robots.description import Kind, OverrideTable
from robots.draft.geometry import corners, places
from robots.draft.gripper import GripperDraft, end_link, guess_gripper
from robots.draft.group_guessing import GroupGuess, guess_groups
from robots.draft.limits import placeholder_limits
from robots.draft.postures import rest_posture
from robots.errors import RobotError
from robots.rotations import Float64
from robots.urdf import Urdf

_SPEEDS = (("vx", 0.3, "m/s"), ("vy", 0.3, "m/s"), ("wz", 0.5, "rad/s"))
_SPACING = 0.5  # [m] between copies of an arm
_HIGHEST = 0.6  # [m] over the root: an arm on a table has its shoulder below this
_SHOULDER = 0.35  # [m] over the table, for a robot that stands in front of it
_BEFORE = -0.2  # [m] near side of the table, where such a robot's shoulders are
_QUARTER = (0.7071067811865476, 0.0, 0.0, 0.7071067811865476)  # the robot's x points over the table


@dataclass(frozen=True, slots=True)
class PoseDraft:
    """Pose: x, y, z [m] and unit quaternion w, x, y, z; checked when the written robot.toml is loaded."""

    xyz: tuple[float, float, float]
    wxyz: tuple[float, float, float, float]


@dataclass(frozen=True, slots=True)
class GroupDraft:
    """Group of a draft.

    `numbers` are the names of its values in messages, with the gripper's last. `rest` are its values at home.
    """

    name: str
    kind: Kind
    optional: bool
    numbers: tuple[str, ...]
    urdf_joints: tuple[str, ...]
    frame: str | None
    eef_link: str | None
    gripper: GripperDraft | None
    pinned: Mapping[str, float]
    mount: PoseDraft | None
    overrides: tuple[OverrideTable, ...]
    rest: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class RobotDraft:
    """Complete draft; no group moves the `unassigned_joints`; `held` joints are floating or planar."""

    title: str
    urdf: str
    groups: tuple[GroupDraft, ...]
    cameras: Mapping[str, str]
    stand: PoseDraft | None
    unassigned_joints: tuple[str, ...]
    held: tuple[str, ...]


def build_draft(tree: Urdf, shown: Path, drawn: Collection[str], title: str, copies: int) -> RobotDraft:
    """Return the draft of a robot with that URDF, whose visuals are in the file `shown`.

    The shapes of the links `drawn` are only stand-ins, and are not used for measuring.

    Raises:
        RobotError: If nothing moves, or copies are requested of a URDF without exactly one arm.
    """
    limbs = guess_groups(tree)
    arms = [limb for limb in limbs if limb.kind == "arm"]
    if copies > 1 and len(arms) != 1:
        raise RobotError(
            f"{tree.path}: {copies} copies of {len(arms)} arms; allowed: copies of a URDF with one arm"
        )
    real = {link: box for link, box in corners(shapes.read_shapes(shown)).items() if link not in drawn}
    groups = [_group(tree, real, limb, limbs) for limb in limbs]
    if copies > 1:
        groups = [_copy(group, index, copies) for index in range(copies) for group in groups]
        groups.sort(key=lambda group: (group.kind != "arm", group.optional))
    moved = set(chain.from_iterable(limb.joints + limb.fingers for limb in limbs))
    return RobotDraft(
        title=title,
        urdf=shown.name,
        groups=tuple(groups),
        cameras=_cameras([group.name for group in groups if group.kind == "arm"]),
        stand=None if copies > 1 else _root_pose(tree, limbs),
        unassigned_joints=tuple(
            name for name, joint in tree.joints.items() if joint.is_independent and name not in moved
        ),
        held=tree.held,
    )


def _group(
    tree: Urdf, real: Mapping[str, Float64], limb: GroupGuess, limbs: Sequence[GroupGuess]
) -> GroupDraft:
    if limb.wheels and not limb.joints:
        return _speeds(limb)
    eef_link = end_link(tree, limb) if limb.kind == "arm" else None
    gripper = None
    if limb.fingers and eef_link is not None:
        gripper = guess_gripper(tree, limb, eef_link, real)
    values = _rest_joints(tree, limb.joints)
    return GroupDraft(
        name=limb.name,
        kind=limb.kind,
        optional=limb.kind not in ("arm", "hand") and any(guess.kind == "arm" for guess in limbs),
        numbers=(*limb.joints, *([gripper.driver] if gripper else [])),
        urdf_joints=limb.joints,
        frame=limb.above if eef_link is not None else None,
        eef_link=eef_link,
        gripper=gripper,
        pinned=_pinned(tree, limb, limbs),
        mount=None,
        overrides=tuple(filter(None, (placeholder_limits(tree.joint(name)) for name in limb.joints))),
        rest=(*values, *([gripper.open] if gripper else [])),
    )


def _rest_joints(tree: Urdf, joints: Sequence[str]) -> tuple[float, ...]:
    ends = [_ends(tree, name) for name in joints]
    return tuple(
        rest_posture(np.array([low for low, _ in ends]), np.array([high for _, high in ends]))
        .round(4)
        .tolist()
    )


def _ends(tree: Urdf, name: str) -> tuple[float, float]:
    """Return lower and upper position limit of a joint, or placeholders if the URDF's are unusable."""
    joint = tree.joint(name)
    instead = placeholder_limits(joint)
    if instead is not None and instead.lower is not None and instead.upper is not None:
        return instead.lower, instead.upper
    assert joint.lower is not None  # otherwise there is a placeholder
    assert joint.upper is not None
    return joint.lower, joint.upper


def _pinned(tree: Urdf, limb: GroupGuess, limbs: Sequence[GroupGuess]) -> dict[str, float]:
    """Return the rest values of the joints of torso, head, base and other optional groups, without zeros.

    The values are used for drawing while these groups do not move. Only the first arm's group states them; the result
    is {} for every other limb.
    """
    if limb.kind != "arm" or limb is not next(guess for guess in limbs if guess.kind == "arm"):
        return {}
    carriers = [guess for guess in limbs if guess.kind in ("torso", "head", "other", "base")]
    values = {
        name: value
        for guess in carriers
        for name, value in zip(guess.joints, _rest_joints(tree, guess.joints), strict=True)
    }
    return {name: value for name, value in values.items() if value}


def _speeds(limb: GroupGuess) -> GroupDraft:
    """Return the group of a base on wheels, whose numbers are speeds and move no joint of the URDF."""
    overrides = tuple(
        OverrideTable(
            joint=name,
            lower=-fastest,
            upper=fastest,
            velocity=2 * fastest,
            reason=f"{fastest:g} {unit} is a placeholder, and so is its change",
        )
        for name, fastest, unit in _SPEEDS
    )
    names = tuple(name for name, _, _ in _SPEEDS)
    return GroupDraft(
        name=limb.name,
        kind="base",
        optional=True,
        numbers=names,
        urdf_joints=("",) * len(names),
        frame=None,
        eef_link=None,
        gripper=None,
        pinned={},
        mount=None,
        overrides=overrides,
        rest=(0.0,) * len(names),
    )


def _copy(group: GroupDraft, index: int, copies: int) -> GroupDraft:
    """Return the group for arm `index` of `copies` equal arms, which are side by side, the first on the left."""
    side = ("left", "right")[index] if copies == 2 else ""
    name = f"{side}_{group.name}" if side else f"{group.name}{index + 1}"
    x = round((index - (copies - 1) / 2) * _SPACING, 4)
    return replace(group, name=name, mount=PoseDraft((x, 0.0, 0.0), _QUARTER))


def _cameras(arms: Sequence[str]) -> dict[str, str]:
    """Return one camera above the table and one per wrist, by name, with the names that are common in training data."""
    sides = [name.replace("arm", "wrist") for name in arms]
    return {"front": "cam_high"} | {side: f"cam_{side}" for side in sides}


def _root_pose(tree: Urdf, limbs: Sequence[GroupGuess]) -> PoseDraft:
    """Return the pose that the robot's root must have so that the arms reach over the table.

    The root is on the table if the shoulders are low and the robot has no wheels. Otherwise the robot stands on the
    floor in front of the table.
    """
    at = places(tree, {})
    shoulders: list[Float64] = [
        at[tree.joint(limb.joints[0]).child][:3, 3] for limb in limbs if limb.kind == "arm" and limb.joints
    ]
    if not shoulders:
        return PoseDraft((0.0, 0.0, 0.0), _QUARTER)
    x, _, z = np.mean(shoulders, axis=0).tolist()
    if z <= _HIGHEST and not any(limb.wheels for limb in limbs):
        return PoseDraft((0.0, round(-x, 4) + 0.0, 0.0), _QUARTER)
    return PoseDraft((0.0, round(_BEFORE - x, 4), round(_SHOULDER - z, 4)), _QUARTER)
