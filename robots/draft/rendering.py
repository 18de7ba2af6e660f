"""Text of a draft: robot.toml with a comment at every guess, and a README with a list of things to verify."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence

from robots.draft.draft_model import GroupDraft, PoseDraft, RobotDraft
from robots.draft.gripper import GripperDraft
from robots.draft.mesh_copy import MeshCopyReport
from robots.inspection import GUESS
from robots.rotations import Float64

_LIMITS = "joints: position and velocity limits of the URDF; placeholders, as overrides, where it has none to believe"


def render_robot_toml(
    sheet: RobotDraft, poses: Mapping[str, Mapping[str, Sequence[float]]], touching: Sequence[tuple[str, str]]
) -> str:
    """Return the text of robot.toml.

    `poses` are vectors by group; `touching` are the pairs of links that the collision check is to ignore.
    """
    lines = [
        "# Drafted from a URDF. What was guessed says so in capitals: verify it on the robot, then delete the word.",
        f"title = {_text(sheet.title)}",
        f"urdf = {_text(sheet.urdf)}",
        f"limits_source = {_text(_LIMITS)}",
        f"control_rate = 30.0 # {GUESS}: commands per second that the robot's node takes",
        "",
        f"[cameras] # {GUESS}: logical name = the key of its pictures in observations; delete what is not there",
        *(f"{name} = {_text(key)}" for name, key in sheet.cameras.items()),
    ]
    if sheet.stand is not None:
        lines += [
            "",
            f"[stand] # {GUESS}: where the URDF's root stands; the table is z = 0, drawn ahead along y",
        ]
        lines += _place(sheet.stand)
    for group in sheet.groups:
        lines += ["", *_group(group)]
    lines += _idle(sheet)
    for name, parts in poses.items():
        lines += ["", _pose_comment(name), f"[poses.{name}]"]
        lines += [f"{group} = {_numbers(values)}" for group, values in parts.items()]
    if touching:
        lines += ["", f"[collision] # {GUESS}: these touch at home or ready, as far as their shapes tell"]
        lines.append(f"ignore = [{', '.join(_texts(pair) for pair in touching)}]")
    return "\n".join(lines) + "\n"


def _pose_comment(name: str) -> str:
    description = (
        "where the robot rests, zero or near it" if name == "home" else "clear of the workspace, fingers down"
    )
    return f"# {GUESS}: {description}; found by looking at shapes, so try it slowly."


def _group(group: GroupDraft) -> Iterator[str]:
    yield "[[groups]]"
    yield f"name = {_text(group.name)} # {GUESS}: what the node calls this group"
    yield f"kind = {_text(group.kind)}"
    if group.optional:
        yield f"optional = true # {GUESS}: part of the robot only where a deployment's `groups` names it"
    yield f"joints = {_texts(group.numbers)} # {GUESS}: names and order on the wire"
    yield f"urdf_joints = {_texts(group.urdf_joints)}"
    if group.frame is not None and group.eef_link is not None:
        yield f"frame = {_text(group.frame)} # {GUESS}: poses are given in it"
        yield f"eef_link = {_text(group.eef_link)} # {GUESS}: what the robot and the policy call its end effector"
    if group.pinned:
        pinned = ", ".join(f"{json.dumps(name)} = {value:g}" for name, value in group.pinned.items())
        yield f"pinned = {{ {pinned} }} # {GUESS}: where they are while no group moves them"
    if group.overrides:
        yield "overrides = ["
        for override in group.overrides:
            sides = ((side, getattr(override, side)) for side in ("lower", "upper", "velocity"))
            values = "".join(f" {side} = {value}," for side, value in sides if value is not None)
            yield f"  {{ joint = {_text(override.joint)},{values} reason = {_text(override.reason)} }}, # {GUESS}"
        yield "]"
    if group.gripper is not None:
        yield ""
        yield from _gripper(group.gripper, len(group.numbers) - 1)
    if group.mount is not None:
        yield ""
        yield f"[groups.mount] # {GUESS}: for drawings, collisions and the simulated bench; measure it"
        yield from _place(group.mount)


def _gripper(gripper: GripperDraft, index: int) -> Iterator[str]:
    yield "[groups.gripper]"
    yield from (f"# {GUESS}: {doubt}." for doubt in gripper.placeholder_notes)
    yield f"index = {index}"
    yield f"unit = {_text(gripper.unit)} # {GUESS}: the number is taken to be the position of {gripper.driver}"
    yield f"lower = {gripper.lower}"
    yield f"upper = {gripper.upper}"
    yield f"open = {gripper.open} # {GUESS}"
    yield f"close = {gripper.close} # {GUESS}"
    yield f"velocity = {gripper.velocity}"
    yield f"binary = false # {GUESS}: true, with a threshold, where it knows only open and close"
    fingers = ", ".join(f"{json.dumps(name)} = {_numbers(ends)}" for name, ends in gripper.fingers.items())
    yield f"fingers = {{ {fingers} }}"
    if gripper.apart is not None:
        yield f"apart = [0.0, {gripper.apart}] # {GUESS}: m between the fingers at close and at open"
    yield from _tip(gripper.tip)


def _tip(tip: Float64) -> Iterator[str]:
    values = (tip.round(6) + 0.0).tolist()
    wxyz = _unit(values[3:])
    place = f"xyz = {_numbers(values[:3])}, wxyz = {_numbers(wxyz)}"
    yield f"tip = {{ {place} }} # {GUESS}: between the fingertips, z ahead, y the way they open"


def _unit(wxyz: Sequence[float]) -> list[float]:
    """Return the quaternion divided by its length, which rounding changed."""
    length = sum(value * value for value in wxyz) ** 0.5
    return [value / length for value in wxyz]


def _idle(sheet: RobotDraft) -> Iterator[str]:
    if sheet.unassigned_joints or sheet.held:
        yield ""
    if sheet.unassigned_joints:
        yield f"# {GUESS}: not commanded: {', '.join(sheet.unassigned_joints)}."
    if sheet.held:
        yield f"# {GUESS}: floating or planar, and held where the URDF draws them: {', '.join(sheet.held)}."


def _place(place: PoseDraft) -> list[str]:
    return [f"xyz = {_numbers(place.xyz)}", f"wxyz = {_numbers(place.wxyz)}"]


def _text(text: str) -> str:
    return json.dumps(text, ensure_ascii=False)


def _texts(texts: Iterable[str]) -> str:
    return f"[{', '.join(map(_text, texts))}]"


def _numbers(numbers: Iterable[float]) -> str:
    return f"[{', '.join(repr(float(number)) for number in numbers)}]"


def render_readme(name: str, sheet: RobotDraft, pictures: MeshCopyReport) -> str:
    """Return the text of the README, with a checklist of guesses to verify."""
    numbers = sum(len(group.numbers) for group in sheet.groups if not group.optional)
    lines = [
        f"# {sheet.title}",
        "",
        f"Drafted by `python -m robots new {name}` from a URDF; {numbers} numbers. Nothing here has been verified yet.",
        "",
        "| group | kind | numbers |",
        "|---|---|---|",
        *(
            f"| `{group.name}`{' (optional)' if group.optional else ''} | {group.kind} | {', '.join(group.numbers)} |"
            for group in sheet.groups
        ),
        "",
        "## To be verified on the robot",
        "",
        *(f"- [ ] {sentence}" for sentence in _tasks(name, sheet, pictures)),
        "",
        f"`python -m robots check {name}` shows all of it as it is loaded, and the lines that still say {GUESS}.",
    ]
    return "\n".join(lines) + "\n"


def _tasks(name: str, sheet: RobotDraft, pictures: MeshCopyReport) -> Iterator[str]:
    yield "Names of groups and joints, and their order, as the execution node sends and takes them."
    yield "The sign and zero of every joint: move one at a time by hand and watch the console."
    for group in sheet.groups:
        if group.eef_link is not None:
            yield (
                f"Forward kinematics: `python -m robots fk {name} {group.name} Q...` against the pose that the robot "
                f"itself reports for {group.eef_link} in {group.frame}, at three postures that differ in every joint."
            )
        if group.gripper is not None:
            yield (
                f"Gripper of {group.name}: its unit on the wire, which value is open, how far its fingers are apart."
            )
        if group.overrides:
            joints = ", ".join(override.joint for override in group.overrides)
            yield f"Limits of {joints} in {group.name}: placeholders, see the reasons in robot.toml."
    yield "Velocity limits: a URDF often says what motors can do, not what is pleasant near people."
    yield "Poses home and ready: go there slowly, with a hand on the hardware stop."
    yield "Cameras: the keys under which the node sends pictures."
    yield "Where the arms stand: mounts and stand, before anybody relies on the collision check."
    if sheet.held:
        yield (
            f"{', '.join(sheet.held)}: floating or planar joints, which this description has none of; it is that of "
            "the robot without them, standing where the URDF draws it."
        )
    if pictures.missing:
        yield f"Meshes that were not found or cannot be read: {', '.join(pictures.missing)}."
    if pictures.drawn:
        yield (
            f"Shapes of {', '.join(pictures.drawn)}: cylinders from joint to joint stand in, also for collisions: "
            "they are thinner than the robot."
        )
