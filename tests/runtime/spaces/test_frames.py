from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from robots import Body, Robot, load_robot
from robots.rotations import transform_of
from runtime.core.errors import ConfigurationError
from runtime.spaces.frames import Frame
from tests.examples import some
from tests.runtime.odd_robot import odd_robot

TORSO = load_robot("r1_lite", ["left_arm", "right_arm", "torso"])
BODY = load_robot("agibot_g2")
TWO_BASES = load_robot("agilex_piper")
FRAMES = [(TORSO, "torso_link3"), (BODY, "base_link"), (BODY, "body_link2"), (TWO_BASES, "world")]


def joints(robot: Robot, seed: int, rows: int = 1) -> np.ndarray:
    lower, upper = np.maximum(robot.lower, -3), np.minimum(robot.upper, 3)
    return np.random.default_rng(seed).uniform(lower, upper, (rows, robot.dim))


def some_vectors(robot: Robot, seed: int, rows: int) -> np.ndarray:
    chance = np.random.default_rng(seed)
    vectors = chance.normal(size=(rows, len(robot.arms), 8))
    vectors[..., 3:7] /= np.linalg.norm(vectors[..., 3:7], axis=-1, keepdims=True)
    return vectors


def placed(robot: Robot, q: np.ndarray, name: str, arm: int) -> np.ndarray:
    """The frame in the scene [4, 4], by the drawing's own poses."""
    if name == robot.mount_frame:
        return transform_of(robot.stand)
    body = Body(robot)
    return body.poses(q)[body.link_of(robot.arms[arm].name, name)]


@pytest.mark.exhaustive
@settings(max_examples=some(40))
@given(st.sampled_from(FRAMES), st.integers(0, 1000), st.booleans())
def test_a_pose_is_the_same_place_in_the_scene_whatever_frame_it_is_given_in(
    case: tuple[Robot, str], seed: int, row_by_row: bool
) -> None:
    robot, name = case
    q, vectors = joints(robot, seed, 3 if row_by_row else 1), some_vectors(robot, seed, 3)
    told = Frame(robot, name, "pose").express(vectors, q)
    for row in range(3):
        at = q[row if row_by_row else 0]
        for arm in range(len(robot.arms)):
            own = placed(robot, at, str(robot.arms[arm].frame), arm) @ transform_of(vectors[row, arm, :7])
            there = placed(robot, at, name, arm) @ transform_of(told[row, arm, :7])
            np.testing.assert_allclose(own, there, atol=1e-9)
    np.testing.assert_array_equal(told[..., 7], vectors[..., 7])


@settings(max_examples=some(40))
@given(st.sampled_from(FRAMES), st.integers(0, 1000))
def test_the_way_there_and_back_is_exact(case: tuple[Robot, str], seed: int) -> None:
    robot, name = case
    frame, q, vectors = Frame(robot, name, "pose"), joints(robot, seed), some_vectors(robot, seed, 4)
    back = frame.resolve(frame.express(vectors, q), q)
    np.testing.assert_allclose(back[..., :3], vectors[..., :3], atol=1e-9)
    first = Rotation.from_quat(vectors[..., 3:7].reshape(-1, 4), scalar_first=True)
    second = Rotation.from_quat(back[..., 3:7].reshape(-1, 4), scalar_first=True)
    assert (first.inv() * second).magnitude().max() < 1e-9


@pytest.mark.parametrize("name", ["", "base_link"])
def test_each_arms_own_frame_changes_nothing_to_the_last_bit(name: str) -> None:
    frame, vectors = Frame(TWO_BASES, name, "pose"), some_vectors(TWO_BASES, 1, 3)
    assert frame.own
    assert frame.express(vectors, joints(TWO_BASES, 1)) is vectors
    assert frame.resolve(vectors, joints(TWO_BASES, 1)) is vectors


def test_arms_that_are_mounted_apart_are_apart_in_the_mount_frame(tmp_path: Path) -> None:
    robot = odd_robot(tmp_path)
    vectors = np.zeros((1, 2, 8))
    vectors[..., 3] = 1.0
    told = Frame(robot, "bench", "pose").express(vectors, joints(robot, 0))
    np.testing.assert_allclose(told[0, 0, :7], [0.3, -0.1, 0.2, 0.6, 0, 0.8, 0], atol=1e-12)
    np.testing.assert_allclose(told[0, 1, :7], [-0.3, 0, 0, np.sqrt(0.5), 0, 0, np.sqrt(0.5)], atol=1e-12)


def test_a_torso_that_moves_takes_its_frame_along() -> None:
    frame, vectors = Frame(BODY, "base_link", "pose"), some_vectors(BODY, 3, 1)
    here = joints(BODY, 0)
    there = here.copy()
    there[0, BODY.group("body").slice] += 0.1
    elsewhere = here.copy()
    elsewhere[0, BODY.group("left_arm").slice] += 0.1
    assert np.abs(frame.express(vectors, here) - frame.express(vectors, there)).max() > 0.01
    np.testing.assert_array_equal(frame.express(vectors, here), frame.express(vectors, elsewhere))


def test_what_is_no_frame_is_named_with_what_is() -> None:
    said = (
        r"policy.action_pose.frame = 'moon' is no frame of agilex_piper; allowed: .*world.*base_link.*link3"
    )
    with pytest.raises(ConfigurationError, match=said):
        Frame(TWO_BASES, "moon", "policy.action_pose")


@pytest.mark.parametrize(("robot", "link"), [(TWO_BASES, "link3"), (TORSO, "right_gripper_link")])
def test_a_frame_that_an_arm_moves_itself_is_refused(robot: Robot, link: str) -> None:
    with pytest.raises(
        ConfigurationError, match=f"pose.frame = '{link}' moves with .*_arm .*allowed: a frame"
    ):
        Frame(robot, link, "pose")
