"""Which links are looked at, how far they are apart, and what is wrong with a description."""

from __future__ import annotations

import os
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import robots
from robots import Robot
from robots.body import Body
from robots.capsules import Capsule, capsules
from robots.clearance import MARGIN, Clearance, collision_problems
from robots.description import TABLE
from robots.rotations import Float64
from tests.examples import some
from tests.robots.conftest import Edit

NAMES = robots.robot_names()


@cache
def clearance(name: str = "agilex_piper") -> Clearance:
    return Clearance(robots.load_robot(name))


def between(one: str, other: str, name: str = "agilex_piper") -> list[int]:
    wanted = {one, other}
    return [index for index, pair in enumerate(clearance(name).pairs) if set(pair) == wanted]


def balls(capsule: Capsule, pose: Float64, count: int = 300) -> Float64:
    """Points [n, 3] along the capsule's line, in the scene."""
    along = capsule.start + np.linspace(0, 1, count)[:, None] * (capsule.end - capsule.start)
    return np.asarray(along @ pose[:3, :3].T + pose[:3, 3])


def fingers(robot: Robot) -> set[str]:
    """What grippers move, with what is fixed to it."""
    body = Body(robot)
    moved = body.moving_mask()[:, list(robot.gripper_dims)].any(axis=1)
    return {part for part, moves in zip(body.parts, moved, strict=True) if moves}


def sampled(name: str, one: str, other: str, q: Float64) -> float:
    """The distance of two links, or of a link and the table, from many points along their capsules."""
    robot = robots.load_robot(name)
    body, made = Body(robot), capsules(robot)
    poses = body.poses(q)

    def dense(part: str) -> list[tuple[Float64, float]]:
        link = part.partition("/")[2]
        return [(balls(capsule, poses[body.part(part)]), capsule.radius) for capsule in made[link]]

    if other == TABLE:
        finger = one in fingers(robot)
        return min(float(points[:, 2].min()) - (0.0 if finger else radius) for points, radius in dense(one))
    return min(
        float(np.linalg.norm(a[:, None] - b[None], axis=-1).min()) - r - s
        for a, r in dense(one)
        for b, s in dense(other)
    )


@pytest.mark.some(1)
@settings(max_examples=some(40))
@given(seed=st.integers(0, 10**6))
@pytest.mark.parametrize("name", ["agilex_piper", "ur5e"])
def test_distances_are_those_of_many_points_along_the_capsules(name: str, seed: int) -> None:
    robot, looked = robots.load_robot(name), clearance(name)
    rng = np.random.default_rng(seed)
    q = rng.uniform(robot.lower, robot.upper)
    found = looked.distances(q)
    pair = looked.pairs[int(rng.integers(len(looked.pairs)))]
    least = min(found[index] for index in between(*pair, name))
    assert least == pytest.approx(sampled(name, *pair, q), abs=2e-3)


def test_a_path_is_judged_as_each_of_its_postures_alone() -> None:
    robot, looked = robots.load_robot("agilex_piper"), clearance()
    way = np.random.default_rng(3).uniform(robot.lower, robot.upper, (130, robot.dim))
    together = looked.distances(way)
    assert together.shape == (130, len(looked.pairs))
    for index in (0, 15, 16, 129):
        assert np.allclose(together[index], looked.distances(way[index]), atol=1e-9)
    assert looked.distances(way.reshape(2, 65, -1)).shape == (2, 65, len(looked.pairs))


def test_neighbours_are_not_looked_at_and_links_beyond_two_joints_are() -> None:
    assert not between("left_arm/link1", "left_arm/link2")
    assert not between("left_arm/base_link", "left_arm/link1")
    assert not between("left_arm/link6", "left_arm/gripper_base")  # rigidly connected
    assert not between("left_arm/link7", "left_arm/link8")  # fingers of one gripper
    assert not between("left_arm/gripper_base", "left_arm/link7")
    assert not between("left_arm/link5", "left_arm/link7")  # one joint of the arm between them
    assert between("left_arm/base_link", "left_arm/gripper_base")


def test_arms_are_looked_at_against_each_other_but_not_what_nothing_moves() -> None:
    assert between("left_arm/link7", "right_arm/link8")
    assert between("left_arm/base_link", "right_arm/link1")
    assert not between("left_arm/base_link", "right_arm/base_link")


def test_the_table_is_looked_at_under_what_can_come_down_to_it() -> None:
    assert between("left_arm/gripper_base", TABLE)
    assert between("left_arm/link3", TABLE)
    assert not between("left_arm/base_link", TABLE)  # stands on it
    assert not between("left_arm/link1", TABLE)  # only turns about the vertical
    assert between("left_arm/link7", TABLE)  # a finger


@pytest.mark.some(2)
@pytest.mark.parametrize("name", NAMES)
def test_fingers_may_touch_the_table_and_dip_in_a_little_but_no_more(name: str) -> None:
    robot, looked = robots.load_robot(name), clearance(name)
    jaws = fingers(robot)
    over = {one for one, other in looked.pairs if other == TABLE}
    assert jaws
    assert jaws & {part for pair in looked.pairs for part in pair} <= over
    still = {"arm/gripper_link": [-0.01, 0.02]} if name == "so101" else {}  # its fixed finger, and its body
    for (one, other), least in zip(looked.pairs, looked.touch_thresholds(0.02), strict=True):
        if other == TABLE and one in still:
            still[one].remove(float(least))
        else:
            assert least == (-0.01 if other == TABLE and one in jaws else 0.02)
    assert all(left == [] for left in still.values())


def test_what_touches_at_nearly_every_posture_is_left_out_alike_in_both_arms() -> None:
    own = [
        [pair for pair in clearance().pairs if all(side in part for part in pair)]
        for side in ("left_arm", "right_arm")
    ]
    assert own[0] == [tuple(part.replace("right", "left") for part in pair) for pair in own[1]]
    assert own[0]
    robot = robots.load_robot("agilex_piper")
    way = np.random.default_rng(7).uniform(robot.lower, robot.upper, (400, robot.dim))
    assert (clearance().distances(way) < MARGIN).mean(axis=0).max() < 0.99


def test_ignored_pairs_are_of_one_arm_unless_they_name_two(edited: Edit) -> None:
    ignored = '["link3", "link7"], ["left_arm/link8", "right_arm/link8"], ["link4", "table"], '
    looked = Clearance(robots.load_robot(edited(("ignore = [", f"ignore = [{ignored}"))))
    pairs = {frozenset(pair) for pair in looked.pairs}
    every = {frozenset(pair) for pair in clearance().pairs}
    gone = {
        ("left_arm/link3", "left_arm/link7"),
        ("right_arm/link3", "right_arm/link7"),
        ("left_arm/link8", "right_arm/link8"),
        ("left_arm/link4", TABLE),
        ("right_arm/link4", TABLE),
    }
    assert every - pairs == {frozenset(pair) for pair in gone}
    assert frozenset(("left_arm/link3", "right_arm/link7")) in pairs


@pytest.mark.parametrize("name", NAMES)
def test_no_robot_touches_itself_or_the_table_at_a_named_pose(name: str) -> None:
    robot = robots.load_robot(name)
    assert collision_problems(robot) == []
    looked = clearance(name)
    assert looked.distances(robot.poses["home"]).min() >= MARGIN
    if len(robot.arms) > 1:
        one, other = (arm.name for arm in robot.arms[:2])
        assert any(a.startswith(one) and b.startswith(other) for a, b in looked.pairs)
    assert any(TABLE in pair for pair in looked.pairs)


@pytest.mark.skipif("EVA_SAMPLE_EPISODE" not in os.environ, reason="EVA_SAMPLE_EPISODE is not set")
def test_nothing_touches_in_a_real_demonstration() -> None:
    import pyarrow.parquet

    file = next(Path(os.environ["EVA_SAMPLE_EPISODE"]).glob("data/*/*.parquet"))
    table = pyarrow.parquet.read_table(file, columns=["observation.qpos"])
    qpos = np.array(table["observation.qpos"].to_pylist(), dtype=np.float64)
    assert clearance().distances(qpos).min() > MARGIN


def test_a_pose_that_touches_is_named_with_the_pair_and_what_to_do(edited: Edit) -> None:
    robot = robots.load_robot(edited(('ignore = [["link2", "link4"], ', "ignore = [")))
    said = collision_problems(robot)
    assert len(said) == 2
    assert said[0].startswith("poses.home: left_arm/link2 and left_arm/link4 are -18 mm apart, needed: 5")
    assert "collision.ignore" in said[0]


def test_a_robot_of_which_nothing_is_looked_at_is_a_problem(edited: Edit) -> None:
    folder = edited()
    robot = robots.load_robot(folder)
    links = sorted(capsules(robot))
    file = folder / "robot.toml"
    head = file.read_text().partition("[collision]")[0]
    file.write_text(f"{head}\n[collision]\nwithout = {links}\n")
    bare = robots.load_robot(folder)
    assert Clearance(bare).distances(bare.poses["home"]).shape == (0,)
    assert collision_problems(bare) == [
        "collision: no two links are looked at; links need shapes, or capsules in robot.toml"
    ]
