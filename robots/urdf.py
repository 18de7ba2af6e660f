"""Reader of the kinematic tree of a URDF: links, joints, origins, axes, limits, mimics.

Shapes are read by another module.
"""

from __future__ import annotations

import codecs
import math
import re
import xml.etree.ElementTree as ET
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from robots.errors import RobotError
from robots.rotations import Float64, matrix_of_rpy

KINDS = ("fixed", "revolute", "continuous", "prismatic")
HELD = (
    "floating",
    "planar",
)  # joints that no group moves: they are read as fixed, at their position in the URDF
_ENCODING = re.compile(rb"""\s*<\?xml[^>]*?\sencoding\s*=\s*["']([^"']*)["'][^>]*\?>""")


@dataclass(frozen=True, slots=True)
class Mimic:
    """Dependence of a joint that follows another: its position is multiplier * (position of `joint`) + offset."""

    joint: str
    multiplier: float
    offset: float


@dataclass(frozen=True, slots=True, eq=False)
class Joint:
    """Joint of a URDF; `origin` [4, 4] is its pose in the parent link, `axis` a unit vector [3] in its own frame.

    Limits are in rad and rad/s (prismatic: m and m/s), None if not declared, infinite if continuous.
    """

    name: str
    kind: str
    parent: str
    child: str
    origin: Float64
    axis: Float64
    lower: float | None
    upper: float | None
    velocity: float | None
    mimic: Mimic | None

    @property
    def is_independent(self) -> bool:
        """Whether the joint moves by itself: it is neither fixed nor a mimic."""
        return self.kind != "fixed" and self.mimic is None


@dataclass(frozen=True, slots=True)
class Urdf:
    """Tree of links: `joints` by name in the file's order, `root` the only link without a parent.

    `held` are the names of floating and planar joints, which are read as fixed.
    """

    path: Path
    root: str
    links: frozenset[str]
    joints: Mapping[str, Joint]
    held: tuple[str, ...]

    def joint(self, name: str) -> Joint:
        """Return the joint with that name.

        Raises:
            RobotError: If it does not exist; the message lists the names.
        """
        if name not in self.joints:
            raise RobotError(f"{self.path}: no joint {name!r}; it has {', '.join(self.joints)}")
        return self.joints[name]

    def above(self, link: str) -> Joint | None:
        """Return the joint whose child is `link`; None for the root."""
        return next((joint for joint in self.joints.values() if joint.child == link), None)

    def children(self, link: str) -> tuple[Joint, ...]:
        """Return the joints whose parent is `link`, in the file's order."""
        return tuple(joint for joint in self.joints.values() if joint.parent == link)

    def between(self, frame: str, tip: str) -> tuple[Joint, ...]:
        """Return the joints on the path from link `frame` outwards to link `tip`.

        Raises:
            RobotError: If a link does not exist, or `tip` is not a descendant of `frame`.
        """
        for link in (frame, tip):
            if link not in self.links:
                raise RobotError(f"{self.path}: no link {link!r}; it has {', '.join(sorted(self.links))}")
        chain: list[Joint] = []
        link = tip
        while link != frame:
            joint = self.above(link)
            if joint is None:
                raise RobotError(f"{self.path}: link {tip!r} does not hang on link {frame!r}")
            chain.append(joint)
            link = joint.parent
        return tuple(reversed(chain))

    def outwards(self) -> tuple[Joint, ...]:
        """Return the joints in an order in which every parent link precedes its children."""
        order: list[Joint] = []
        links = [self.root]
        for link in links:  # the list grows during the loop
            below = self.children(link)
            order += below
            links += [joint.child for joint in below]
        return tuple(order)

    def master(self, joint: Joint) -> tuple[Joint, float, float]:
        """Return the joint that `joint` finally follows, factor and offset; `joint` itself unless it is a mimic.

        The value of `joint` is factor * (value of the returned joint) + offset.
        """
        factor, offset, names = 1.0, 0.0, [joint.name]
        while joint.mimic is not None:
            offset += factor * joint.mimic.offset
            factor *= joint.mimic.multiplier
            joint = self.joint(joint.mimic.joint)
            if joint.name in names:
                raise RobotError(f"{self.path}: joints {', '.join(names)} mimic each other in a circle")
            names.append(joint.name)
        return joint, factor, offset

    def masters(self) -> set[str]:
        """Return the names of the joints that mimic joints follow."""
        return {self.master(joint)[0].name for joint in self.joints.values() if joint.mimic is not None}


def read(path: Path) -> Urdf:
    """Return the kinematic tree in the file.

    Raises:
        RobotError: If it is invalid; the message names file, joint and fault.
    """
    robot = document(path)
    links = [text_of(path, link, "name") for link in robot.findall("link")]
    joints = [_joint(path, element) for element in robot.findall("joint")]
    _refuse_twice(path, "link", links)
    _refuse_twice(path, "joint", [joint.name for joint in joints])
    root = _root(path, links, joints)
    pinned = tuple(
        joint.name
        for joint, element in zip(joints, robot.findall("joint"), strict=True)
        if element.get("type") in HELD
    )
    return Urdf(path, root, frozenset(links), {joint.name: joint for joint in joints}, pinned)


def document(path: Path) -> ET.Element:
    """Return the root element of the file, <robot>.

    Raises:
        RobotError: If it is not a URDF.
    """
    robot = parsed(path)
    if _is_xacro(robot):
        command = f"xacro {path.name} > {path.name.split('.')[0]}.urdf"
        raise RobotError(f"{path}: this is a xacro, of which a URDF is yet to be made: {command}")
    if robot.tag != "robot":
        raise RobotError(f"{path}: the outermost element is <{robot.tag}>; a URDF has <robot>")
    return robot


def parsed(path: Path, comments: bool = False) -> ET.Element:
    """Return the root element of an XML file in any encoding that Python knows, with `comments` if requested.

    Raises:
        RobotError: If it cannot be read.
    """
    parser = ET.XMLParser(target=ET.TreeBuilder(insert_comments=comments))
    try:
        content = path.read_bytes()
        if content.startswith(codecs.BOM_UTF8):  # the byte order mark overrides the declared encoding
            content = _ENCODING.sub(b"", content.removeprefix(codecs.BOM_UTF8), count=1)
        declared = _ENCODING.match(content)
        if declared is None:
            parser.feed(content)
        else:  # expat supports few encodings, and no multi-byte ones except Unicode's
            encoding = declared[1].decode("ascii", "replace")
            try:
                codecs.lookup(encoding)
            except LookupError:
                raise RobotError(
                    f"{path}: encoding {encoding!r} is not known; allowed: that of the file, such as UTF-8"
                ) from None
            parser.feed(content[declared.end() :].decode(encoding))
        root: ET.Element = parser.close()
    except (OSError, ET.ParseError, LookupError, ValueError) as error:
        raise RobotError(f"{path}: cannot be read as URDF: {error}") from error
    return root


def _is_xacro(robot: ET.Element) -> bool:
    """Return True if the document contains macros or placeholders of xacro."""
    return any(
        "xacro" in element.tag or any("${" in value or "$(" in value for value in element.attrib.values())
        for element in robot.iter()
        if isinstance(element.tag, str)
    )


def _joint(path: Path, element: ET.Element) -> Joint:
    name = text_of(path, element, "name")
    kind = element.get("type")
    if kind in HELD:
        kind = "fixed"
    if kind not in KINDS:
        raise RobotError(f"{path}: joint {name!r} has type {kind!r}; allowed: {', '.join((*KINDS, *HELD))}")
    endless, moves = kind == "continuous", kind != "fixed"  # ignored values may be invalid
    bounded = moves and not endless
    lower, upper = (_limit(path, element, name, key) if bounded else None for key in ("lower", "upper"))
    return Joint(
        name=name,
        kind=kind,
        parent=_end(path, element, name, "parent"),
        child=_end(path, element, name, "child"),
        origin=origin_of(path, f"joint {name!r}", element),
        axis=_axis(path, element, name) if moves else np.array([1.0, 0.0, 0.0]),
        lower=-math.inf if endless else lower,
        upper=math.inf if endless else upper,
        velocity=_limit(path, element, name, "velocity") if moves else None,
        mimic=_mimic(path, element, name),
    )


def text_of(path: Path, element: ET.Element, key: str) -> str:
    """Return the required attribute `key` of an element.

    Raises:
        RobotError: If it is missing.
    """
    value = element.get(key)
    if not value:
        raise RobotError(f"{path}: a <{element.tag}> has no {key!r}")
    return value


def _end(path: Path, element: ET.Element, name: str, which: str) -> str:
    end = element.find(which)
    if end is None or not end.get("link"):
        raise RobotError(f"{path}: joint {name!r} names no {which} link")
    return text_of(path, end, "link")


def numbers(path: Path, owner: str, what: str, text: str, count: int) -> list[float]:
    """Return `count` finite numbers from `text`.

    Raises:
        RobotError: If `text` is anything else; the message names file, owner and attribute.
    """
    try:
        values = [float(part) for part in text.split()]
    except ValueError:
        values = []
    if len(values) != count or not all(math.isfinite(value) for value in values):
        raise RobotError(f"{path}: {owner}: {what} is {text!r}; allowed: {count} finite number(s)")
    return values


def origin_of(path: Path, owner: str, element: ET.Element) -> Float64:
    """Return the transform [4, 4] of the element's <origin>; the identity if there is none."""
    matrix = np.eye(4)
    origin = element.find("origin")
    if origin is not None:
        roll, pitch, yaw = numbers(path, owner, "origin rpy", origin.get("rpy", "0 0 0"), 3)
        matrix[:3, :3] = matrix_of_rpy(roll, pitch, yaw)
        matrix[:3, 3] = numbers(path, owner, "origin xyz", origin.get("xyz", "0 0 0"), 3)
    return matrix


def _axis(path: Path, element: ET.Element, name: str) -> Float64:
    declared = element.find("axis")
    text = "1 0 0" if declared is None else declared.get("xyz", "1 0 0")  # the default of the URDF format
    axis = np.array(numbers(path, f"joint {name!r}", "axis xyz", text, 3))
    length = float(np.linalg.norm(axis))
    if length < 1e-9:
        raise RobotError(f"{path}: joint {name!r}: axis xyz is {text!r}; allowed: a vector that is not zero")
    return np.asarray(axis / length, dtype=np.float64)


def _limit(path: Path, element: ET.Element, name: str, key: str) -> float | None:
    limit = element.find("limit")
    text = None if limit is None else limit.get(key)
    return None if text is None else numbers(path, f"joint {name!r}", f"limit {key}", text, 1)[0]


def _mimic(path: Path, element: ET.Element, name: str) -> Mimic | None:
    mimic = element.find("mimic")
    if mimic is None:
        return None
    multiplier = numbers(path, f"joint {name!r}", "mimic multiplier", mimic.get("multiplier", "1"), 1)[0]
    offset = numbers(path, f"joint {name!r}", "mimic offset", mimic.get("offset", "0"), 1)[0]
    return Mimic(text_of(path, mimic, "joint"), multiplier, offset)


def _refuse_twice(path: Path, label: str, names: list[str]) -> None:
    repeated = sorted({name for name in names if names.count(name) > 1})
    if repeated:
        raise RobotError(f"{path}: {label} {', '.join(repeated)} declared more than once")


def _root(path: Path, links: list[str], joints: list[Joint]) -> str:
    """Return the only link without a parent.

    Raises: RobotError if the joints do not form one tree.
    """
    children = [joint.child for joint in joints]
    _refuse_twice(path, "the joint above link", children)
    names = {joint.name for joint in joints}
    for joint in joints:
        for link in (joint.parent, joint.child):
            if link not in links:
                raise RobotError(f"{path}: joint {joint.name!r} names link {link!r}, which is not declared")
        if joint.mimic and joint.mimic.joint not in names:
            raise RobotError(
                f"{path}: joint {joint.name!r} mimics {joint.mimic.joint!r}, which is not declared"
            )
    roots = [link for link in links if link not in children]
    if len(roots) != 1:
        raise RobotError(f"{path}: the links without a parent are {roots}; allowed: exactly one")
    below: dict[str, list[str]] = {}
    for joint in joints:
        below.setdefault(joint.parent, []).append(joint.child)
    reached = [roots[0]]
    for link in reached:  # the list grows during the loop
        reached += below.get(link, [])
    if in_circles := sorted(set(links) - set(reached)):
        raise RobotError(
            f"{path}: the links {in_circles} hang on each other in a circle, and not on {roots[0]!r}"
        )
    return roots[0]
