"""Ways in joints that motions of ours may take."""

from __future__ import annotations

import re
from itertools import pairwise
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from runtime.core.errors import RuntimeFault
from runtime.motion.timeline import DimensionKinds
from runtime.processes.coordinator.path_check import PathCheck
from runtime.safety.filter import Limits, SafetySettings, WorkspaceBox
from tests.runtime.collision_samples import collisions, robot, turned


def ways(**safety: Any) -> PathCheck:
    own = robot()
    grippers = np.isin(np.arange(own.dim), own.gripper_dims)
    limits = Limits(own.joint_names, own.lower, own.upper, own.velocity, grippers, np.zeros(own.dim, bool))
    settings = SimpleNamespace(safety=SafetySettings(**safety))
    spec: Any = SimpleNamespace(robot=own, limits=limits, deployment=settings, dims=DimensionKinds())
    return PathCheck(spec)


def test_a_way_into_the_other_arm_is_refused_with_the_pair_where_and_what_to_do() -> None:
    with pytest.raises(RuntimeFault) as refused:
        ways().check("move", turned(0.0), turned(1.6))
    said = str(refused.value)
    assert re.match(
        r"move: left_arm/link[78] and right_arm/link[78] would be \d+ mm apart after \d+ % of the way", said
    )
    assert said.endswith("go by another pose, or move the robot by hand first")
    share = int(re.search(r"(\d+) %", said)[1])  # type: ignore[index]
    assert 55 < share < 66  # they meet at about 1 rad of 1.6


def test_what_policies_are_only_warned_of_or_not_judged_for_is_refused_to_motions_of_ours() -> None:
    for mode in ("off", "warn", "refuse"):
        with pytest.raises(RuntimeFault, match="would be"):
            ways(collision=mode).check("move", turned(0.0), turned(1.6))


def test_a_way_that_begins_in_a_collision_may_part() -> None:
    assert collisions().nearest(turned(1.4)) is not None
    ways().check("move", turned(1.2), turned(0.0))
    ways().check("move", turned(1.2), turned(1.2))
    with pytest.raises(RuntimeFault, match="deep"):
        ways().check("move", turned(1.2), turned(1.4))


def test_a_short_way_is_looked_at_as_well_as_a_long_one() -> None:
    with pytest.raises(RuntimeFault, match="after 100 % of the way"):
        ways().check("move", turned(0.999), turned(1.003))


def test_what_was_accepted_is_not_refused_by_control_half_way() -> None:
    """Control judges at other postures, with the margin of the deployment."""
    own, margin = ways(), SafetySettings().collision_margin
    rng = np.random.default_rng(5)
    accepted = 0
    for _ in range(60):
        start, goal = (turned(rng.uniform(0.8, 1.05)) for _ in range(2))
        goal[8] += rng.uniform(-0.2, 0.2)
        try:
            own.check("move", start, goal)
        except RuntimeFault:
            continue
        accepted += 1
        steps = start + np.linspace(0, 1, 37)[:, None] * (goal - start)
        for before, after in pairwise(steps):
            assert collisions(margin).closer_pair(after, before) is None
    assert accepted > 5


def test_boxes_hold_on_the_whole_way() -> None:
    here = robot().group("left_arm").pose(turned(0.0))[:3]
    box = WorkspaceBox(lower=(here - 0.05).tolist(), upper=(here + 0.05).tolist())
    with pytest.raises(RuntimeFault, match="home: left_arm would leave the workspace box on its way"):
        ways(workspace={"left_arm": box}).check("home", turned(0.0), turned(0.6))
    ways(workspace={"left_arm": box}).check("home", turned(0.6), turned(0.0))
