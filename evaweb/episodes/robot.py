"""The robot of an episode, in the groups that it had then."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from evaweb.errors import NotFound
from evaweb.stations.looks import Looks, groups_of, looks_of


def robot_in(manifest: Mapping[str, Any]) -> Mapping[str, Any]:
    """What a manifest says of its robot; {} where it says nothing."""
    robot = manifest.get("robot")
    return robot if isinstance(robot, Mapping) else {}


def groups_in(manifest: Mapping[str, Any]) -> tuple[str, ...] | None:
    """The groups that the recorded joints are in; None where their names were not recorded."""
    names = robot_in(manifest).get("joint_names")
    return groups_of(map(str, names)) if isinstance(names, list) and names else None


def looks_in(manifest: Mapping[str, Any]) -> Looks:
    """The robot as it is described today; NotFound where it is not, or has other joints than were recorded."""
    recorded = robot_in(manifest)
    name, groups, dim = str(recorded.get("name", "")), groups_in(manifest), recorded.get("dim")
    looks = looks_of(name, groups)
    if looks.robot.dim != dim:
        raise NotFound(f"the episode has {dim} joints, {name} has {looks.robot.dim} today")
    if groups is not None and list(looks.robot.joint_names) != recorded["joint_names"]:
        raise NotFound(f"the joints of {name} have other names, or another order, today")
    return looks
