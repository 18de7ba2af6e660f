"""Groups that a URDF suggests by names and by the structure of its tree: arms, hands, torso, head, base."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from robots.description import Kind
from robots.draft.geometry import places
from robots.errors import RobotError
from robots.urdf import Joint, Urdf

_WORD = re.compile(r"[A-Z]?[a-z]+|[A-Z]+(?![a-z])")
_FINGERS = ("finger", "grip", "jaw", "claw", "knuckle", "thumb")
_WHEELS = ("wheel", "caster", "steer", "chassis")
_ARM = {"arm", "forearm", "upperarm", "shoulder", "elbow", "wrist", "hand"}
_WORDS: tuple[tuple[Kind, set[str]], ...] = (  # ordered by precedence
    ("arm", _ARM),
    ("head", {"head", "neck"}),
    ("torso", {"torso", "waist", "body", "trunk", "spine", "chest", "lift", "column", "elevator"}),
    ("base", {"base", "platform", "rail", "gantry"}),
    ("other", {"leg", "hip", "knee", "ankle", "foot", "tail"}),
)
_TURNS = {
    "roll",
    "pitch",
    "yaw",
    "rotate",
    "rotation",
    "wrist",
}  # words that a finger's joint does not contain
_SIDES = {"left": {"left", "l", "lh"}, "right": {"right", "r", "rh"}}
_ORDER: tuple[Kind, ...] = ("arm", "hand", "torso", "head", "base", "other")
_FORK = 3  # joints in a row after which two ending joints are fingers
_ARM_LENGTH = 4  # joints in a row that make an arm without a telling name
_BEYOND_LIFT, _BEYOND_TURN = 4, 6  # joints that an arm needs beyond a torso in the same row
_SIDEWAYS = 0.01  # [m] distance from the middle from which an arm is on a side


@dataclass(frozen=True, slots=True)
class GroupGuess:
    """Suggested group: `joints` of the URDF outwards, `fingers` of its gripper, and the link `above`, where it begins.

    `side` is "left", "right" or "". `wheels` are joints that roll and are not commanded individually: a base with
    wheels is commanded by speeds.
    """

    name: str
    kind: Kind
    side: str
    joints: tuple[str, ...]
    fingers: tuple[str, ...]
    above: str
    wheels: tuple[str, ...] = ()


def guess_groups(tree: Urdf) -> tuple[GroupGuess, ...]:
    """Return the groups that the tree suggests, arms first.

    Raises:
        RobotError: If nothing moves.
    """
    moving = [joint for joint in tree.outwards() if joint.is_independent]
    if not moving:
        raise RobotError(f"{tree.path}: no joint moves by itself; needed: at least one")
    skeleton = _Skeleton(tree, moving)
    wheels = [joint.name for joint in moving if _has(joint.name, _WHEELS)]
    wheels += [name for name in skeleton.names if skeleton.descendants(name) & set(wheels)]
    fingers = skeleton.fingers(set(wheels))
    runs = skeleton.runs({*wheels, *fingers})
    limbs = [limb for run in runs for limb in _limbs(skeleton, run, fingers, alone=len(runs) == 1)]
    limbs += _loose(skeleton, limbs, fingers)
    if wheels:
        limbs.append(GroupGuess("base", "base", "", (), (), tree.root, tuple(dict.fromkeys(wheels))))
    return _named(_assign_sides(tree, _merge_trunks(limbs)))


class _Skeleton:
    """Tree of the joints that move independently."""

    def __init__(self, tree: Urdf, moving: Sequence[Joint]) -> None:
        self.tree = tree
        self.names = [joint.name for joint in moving]
        self.parent = {name: self._next_above(tree.joint(name).parent) for name in self.names}
        self.masters = tree.masters()

    def children(self, name: str | None, without: Iterable[str] = ()) -> list[str]:
        """Return the joints directly after `name`, except those in `without`; if `name` is None, those after
        the root.
        """
        return [child for child in self.names if self.parent[child] == name and child not in without]

    def descendants(self, name: str) -> set[str]:
        """Return all joints that are further out than `name` in its branch."""
        below = self.children(name)
        return set(below).union(*(self.descendants(child) for child in below))

    def depth(self, name: str | None) -> int:
        """Return the number of joints from the root to `name`."""
        return 0 if name is None else 1 + self.depth(self.parent[name])

    def fingers(self, wheels: set[str]) -> dict[str, str | None]:
        """Return a map from each finger joint to the joint that carries its hand, None if the root carries the hand.

        `wheels` are the joints of wheels, which are no fingers.
        """
        names: set[str] = set()
        for name in reversed(self.names):  # from the tips inwards
            if name not in wheels and names.issuperset(self.children(name)) and self._is_finger(name):
                names.add(name)
        carriers: dict[str, str | None] = {}
        for name in self.names:
            if name in names:
                carrier = self.parent[name]
                while carrier in names:
                    carrier = self.parent[carrier]
                carriers[name] = carrier
        return carriers

    def runs(self, without: set[str]) -> list[tuple[tuple[str, ...], bool]]:
        """Return the unbranched sequences of joints, without the joints in `without`.

        The joints of a sequence are in order from the root outwards. The second element of each pair is True if no
        joint follows the last joint of the sequence.
        """
        result: list[tuple[tuple[str, ...], bool]] = []
        starts = self.children(None, without)
        for start in starts:  # the list grows during the loop
            run = [start]
            while len(behind := self.children(run[-1], without)) == 1:
                run += behind
            result.append((tuple(run), not behind))
            starts += behind
        return result

    def _next_above(self, link: str) -> str | None:
        while (joint := self.tree.above(link)) is not None:
            if joint.name in self.names:
                return joint.name
            link = joint.parent
        return None

    def _is_finger(self, name: str) -> bool:
        joint = self.tree.joint(name)
        behind = self.children(name)
        if name in self.masters:
            return True
        if _has(name, _FINGERS) and not (behind and _name_parts(name) & (_TURNS | _ARM - {"hand"})):
            return True
        if behind:
            return False
        siblings = [sibling for sibling in self.children(self.parent[name]) if sibling != name]
        twins = [sibling for sibling in siblings if self.tree.joint(sibling).parent == joint.parent]
        if not twins or any(self.children(sibling) for sibling in siblings):
            return False
        slides = joint.kind == "prismatic" and all(
            self.tree.joint(sibling).kind == "prismatic" for sibling in twins
        )
        return slides or (self.depth(self.parent[name]) >= _FORK and not _kind_of(name))


def _limbs(
    skeleton: _Skeleton, run: tuple[tuple[str, ...], bool], fingers: dict[str, str | None], *, alone: bool
) -> list[GroupGuess]:
    """Return the limbs that an unbranched row of joints forms.

    A torso or base that leads to an arm without branching is a separate limb.

    Args:
        skeleton: Tree of the joints.
        run: The joints, and True if no joint follows the last one.
        fingers: The joint that carries the hand, by finger joint.
        alone: True if there is no other row of joints, so that a shorter one counts as an arm.
    """
    joints, ends = run
    own = tuple(name for name, carrier in fingers.items() if carrier == joints[-1])
    cut = _trunk(skeleton.tree, joints) if ends else len(joints)
    limbs = [_limb(skeleton, _kind(joints[:cut]) or "torso", joints[:cut])] if cut else []
    if not ends:
        return limbs
    outer = joints[cut:]
    kind = _kind(outer)
    if kind in (None, "torso", "base"):
        long = len(outer) >= (_FORK if alone else _ARM_LENGTH)
        kind = "arm" if own or (long and kind is None) else kind
    kind = kind or "other"
    gripper = own if kind == "arm" and _one_gripper(skeleton, own) else ()
    return [*limbs, replace(_limb(skeleton, kind, outer), fingers=gripper)]


def _trunk(tree: Urdf, joints: tuple[str, ...]) -> int:
    """Return how many joints at the beginning of `joints` belong to a torso or base that carries an arm.

    `joints` is an unbranched sequence of joints that ends at a tip. The result is 0 if the rest is too short for an
    arm.
    """
    cut = next((i for i, name in enumerate(joints) if _kind_of(name) not in ("torso", "base")), 0)
    slides = any(tree.joint(name).kind == "prismatic" for name in joints[:cut])
    return cut if len(joints) - cut >= (_BEYOND_LIFT if slides else _BEYOND_TURN) else 0


def _limb(skeleton: _Skeleton, kind: Kind, joints: tuple[str, ...]) -> GroupGuess:
    above = skeleton.parent[joints[0]]
    tree = skeleton.tree
    return GroupGuess(
        "", kind, _side(tree, joints), joints, (), tree.joint(above).child if above else _base(tree)
    )


def _base(tree: Urdf) -> str:
    """Return the base link: the root, or the link that is fixed to a root that only represents the world."""
    behind = tree.children(tree.root)
    if tree.root in ("world", "map", "odom", "ground") and len(behind) == 1 and behind[0].kind == "fixed":
        return behind[0].child
    return tree.root


def _one_gripper(skeleton: _Skeleton, fingers: Sequence[str]) -> bool:
    """Return True if the fingers are a gripper, which one number opens and closes.

    More fingers, or fingers with several joints, are a hand instead.
    """
    return 0 < len(fingers) <= _FORK and not any(skeleton.parent[name] in fingers for name in fingers)


def _loose(
    skeleton: _Skeleton, limbs: Sequence[GroupGuess], fingers: dict[str, str | None]
) -> list[GroupGuess]:
    """Return the hands: one group for all fingers with the same carrier that are not part of an arm's gripper."""
    assigned = {name for limb in limbs for name in limb.fingers}
    hands: dict[str | None, list[str]] = {}
    for name, carrier in fingers.items():
        if name not in assigned:
            hands.setdefault(carrier, []).append(name)
    return [_limb(skeleton, "hand", tuple(names)) for names in hands.values()]


def _merge_trunks(limbs: Sequence[GroupGuess]) -> list[GroupGuess]:
    """Return the limbs with all parts of the torso merged into one, and all parts of the base into one."""
    merged: list[GroupGuess] = []
    for limb in limbs:
        same = next(
            (i for i, earlier in enumerate(merged) if earlier.kind == limb.kind in ("torso", "base")), None
        )
        if same is None:
            merged.append(limb)
        else:
            first = merged[same]
            merged[same] = replace(
                first, joints=first.joints + limb.joints, wheels=first.wheels + limb.wheels
            )
    return merged


def _assign_sides(tree: Urdf, limbs: Sequence[GroupGuess]) -> list[GroupGuess]:
    """Return the limbs, with a side for each of two arms that have none.

    The arm that begins at larger y is the left one. Nothing is assigned unless one arm begins clearly on each side of y
    = 0.
    """
    arms = [limb for limb in limbs if limb.kind == "arm"]
    if len(arms) != 2 or any(arm.side for arm in arms):
        return list(limbs)
    at = places(tree, {})
    y = [float(at[tree.joint(arm.joints[0]).child][1, 3]) for arm in arms]
    if not min(y) < -_SIDEWAYS < _SIDEWAYS < max(y):
        return list(limbs)
    sides = {id(arm): "left" if value > 0 else "right" for arm, value in zip(arms, y, strict=True)}
    return [replace(limb, side=sides.get(id(limb), limb.side)) for limb in limbs]


def _named(limbs: Sequence[GroupGuess]) -> tuple[GroupGuess, ...]:
    """Return the limbs with unique names, e.g. left_arm, torso, other2: arms first, left before right."""
    ordered = sorted(limbs, key=lambda limb: (_ORDER.index(limb.kind), limb.side != "left", limb.side == ""))
    plain = ["_".join(filter(None, (limb.side, limb.kind))) for limb in ordered]
    names = []
    for index, name in enumerate(plain):
        names.append(name if plain.count(name) == 1 else f"{name}{plain[: index + 1].count(name)}")
    return tuple(replace(limb, name=name) for limb, name in zip(ordered, names, strict=True))


def _name_parts(name: str) -> set[str]:
    return {word.lower() for word in _WORD.findall(name)}


def _has(name: str, parts: Iterable[str]) -> bool:
    return any(part in name.lower() for part in parts)


def _kind_of(name: str) -> Kind | None:
    parts = _name_parts(name)
    return next((kind for kind, telling in _WORDS if parts & telling), None)


def _kind(joints: Sequence[str]) -> Kind | None:
    """Return the kind that at least half of the joints' names indicate, None if there is none."""
    kinds = [_kind_of(name) for name in joints]
    likely = max(dict.fromkeys(kinds), key=kinds.count)
    return likely if 2 * kinds.count(likely) >= len(kinds) else None


def _side(tree: Urdf, joints: Sequence[str]) -> str:
    """Return the side that the names of most joints indicate, or else the names of their child links."""
    for names in (joints, [tree.joint(name).child for name in joints]):
        counts = np.array(
            [[bool(_name_parts(name) & names_of_side) for names_of_side in _SIDES.values()] for name in names]
        ).sum(axis=0)
        if counts.max() * 2 > len(names) and counts[0] != counts[1]:
            return list(_SIDES)[int(counts.argmax())]
    return ""
