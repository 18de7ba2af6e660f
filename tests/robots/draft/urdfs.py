"""URDFs of made-up robots, written by the line."""

from __future__ import annotations

from pathlib import Path

LIMIT = '<limit lower="-2.5" upper="2.5" velocity="2.0" effort="10"/>'
BOX = '<visual><origin xyz="{x}"/><geometry><box size="{size}"/></geometry></visual>'
AXES = ("0 0 1", "0 1 0", "0 1 0", "1 0 0", "0 1 0", "1 0 0", "0 1 0")


def link(name: str, visual: str = "") -> str:
    return f'<link name="{name}">{visual}</link>'


def joint(
    name: str,
    parent: str,
    child: str,
    *,
    kind: str = "revolute",
    axis: str = "0 0 1",
    xyz: str = "0 0 0",
    rpy: str = "0 0 0",
    more: str = LIMIT,
) -> str:
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="{xyz}" rpy="{rpy}"/><axis xyz="{axis}"/>{"" if kind == "fixed" else more}</joint>'
    )


def arm(parent: str, prefix: str = "", *, count: int = 6, xyz: str = "0 0 0.1", visual: bool = True) -> str:
    """Joints PREFIXjoint1 ... and links PREFIXlink1 ..., each 0.12 m from the last, straight up."""
    text = ""
    for number in range(1, count + 1):
        shown = BOX.format(x="0 0 0.05", size="0.04 0.04 0.08") if visual else ""
        text += link(f"{prefix}link{number}", shown)
        above = parent if number == 1 else f"{prefix}link{number - 1}"
        place = xyz if number == 1 else "0 0 0.12"
        text += joint(
            f"{prefix}joint{number}", above, f"{prefix}link{number}", axis=AXES[number - 1], xyz=place
        )
    return text


def jaws(hand: str, prefix: str = "", *, mimic: bool = True, way: float = 0.04) -> str:
    """Two sliding fingers PREFIXfinger_joint1 and 2 on `hand`, apart along y, their ends 0.08 m ahead along z."""
    limit = f'<limit lower="0" upper="{way}" velocity="0.2" effort="10"/>'
    follows = f'<mimic joint="{prefix}finger_joint1"/>' if mimic else ""
    text = ""
    for number, side in ((1, 1), (2, -1)):
        finger = BOX.format(x=f"0 {side * 0.005} 0.02", size="0.02 0.01 0.04")
        text += link(f"{prefix}finger{number}", finger)
        text += joint(
            f"{prefix}finger_joint{number}",
            hand,
            f"{prefix}finger{number}",
            kind="prismatic",
            axis=f"0 {side} 0",
            xyz="0 0 0.04",
            more=limit + (follows if number == 2 else ""),
        )
    return text


def write(folder: Path, body: str, name: str = "made_up") -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{name}.urdf"
    path.write_text(f'<?xml version="1.0"?>\n<robot name="{name}">{body}</robot>\n')
    return path


def base(name: str = "base_link") -> str:
    return link(name, BOX.format(x="0 0 0.05", size="0.1 0.1 0.1"))


def single() -> str:
    """An arm of six joints with a gripper."""
    return base() + arm("base_link") + jaws("link6")


def dual() -> str:
    """Two arms with grippers on a torso of two joints, a head, and wheels."""
    text = base() + link("torso1") + link("torso2", BOX.format(x="0 0 0.1", size="0.1 0.2 0.4"))
    text += joint(
        "lift",
        "base_link",
        "torso1",
        kind="prismatic",
        xyz="0 0 0.3",
        more='<limit lower="0" upper="0.4" velocity="0.1"/>',
    )
    text += joint("waist", "torso1", "torso2", axis="0 0 1", xyz="0 0 0.1")
    for side, y in (("l", 0.25), ("r", -0.25)):
        text += arm("torso2", f"{side}_", xyz=f"0 {y} 0.3") + jaws(f"{side}_link6", f"{side}_")
    text += link("head1") + link("head2", BOX.format(x="0 0 0.05", size="0.1 0.1 0.1"))
    text += joint("neck_yaw", "torso2", "head1", xyz="0 0 0.4") + joint(
        "neck_pitch", "head1", "head2", axis="0 1 0"
    )
    for number in (1, 2):
        text += link(f"wheel{number}")
        text += joint(f"wheel_joint{number}", "base_link", f"wheel{number}", kind="continuous", more="")
    return text
