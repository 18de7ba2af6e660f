from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from robots import Chain, RobotError, load_robot, urdf

TREE = """<robot name="t">
  <link name="base"/><link name="torso"/><link name="arm"/><link name="slide"/>
  <link name="hand"/><link name="tool"/>
  <joint name="lift" type="prismatic"><parent link="base"/><child link="torso"/>
    <origin xyz="0 0 1"/><axis xyz="0 0 1"/><limit lower="0" upper="1" velocity="1"/></joint>
  <joint name="turn" type="continuous"><parent link="torso"/><child link="arm"/>
    <origin xyz="0.5 0 0" rpy="0.3 -0.2 0.1"/><axis xyz="0 1 1"/></joint>
  <joint name="reach" type="prismatic"><parent link="arm"/><child link="slide"/>
    <origin xyz="0 0.1 0"/><axis xyz="1 0 0"/><mimic joint="turn" multiplier="0.5" offset="0.2"/></joint>
  <joint name="bend" type="revolute"><parent link="slide"/><child link="hand"/>
    <origin rpy="0 0 0.4"/><axis xyz="0 0 1"/><limit lower="-1" upper="1" velocity="1"/></joint>
  <joint name="mounting" type="fixed"><parent link="hand"/><child link="tool"/>
    <origin xyz="0 0 0.25" rpy="0 1.5 0"/></joint>
</robot>"""


@pytest.fixture
def tree(tmp_path: Path) -> urdf.Urdf:
    path = tmp_path / "t.urdf"
    path.write_text(TREE)
    return urdf.read(path)


@pytest.fixture
def chain(tree: urdf.Urdf) -> Chain:
    return Chain(tree, "base", "tool", ["turn", "bend"], {"lift": 0.3})


def _turned(axis: list[float], angle: float) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_rotvec(np.array(axis) / np.linalg.norm(axis) * angle).as_matrix()
    return matrix


def _moved(x: float, y: float, z: float) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, 3] = [x, y, z]
    return matrix


@pytest.mark.parametrize("q", [[0.0, 0.0], [0.7, -0.4], [-2.9, 0.99]])
def test_pinned_fixed_mimic_sliding_and_turning_joints_compose_link_by_link(
    tree: urdf.Urdf, chain: Chain, q: list[float]
) -> None:
    turn, bend = q
    expected = tree.joint("lift").origin @ _moved(0, 0, 0.3)
    expected = expected @ tree.joint("turn").origin @ _turned([0, 1, 1], turn)
    expected = expected @ tree.joint("reach").origin @ _moved(0.5 * turn + 0.2, 0, 0)
    expected = expected @ tree.joint("bend").origin @ _turned([0, 0, 1], bend) @ tree.joint("mounting").origin
    np.testing.assert_allclose(chain.forward(np.array(q)), expected, atol=1e-14)


def _numeric_jacobian(chain: Chain, q: np.ndarray, h: float = 1e-6) -> np.ndarray:
    columns = []
    for index in range(chain.size):
        ahead, behind = q.copy(), q.copy()
        ahead[index] += h
        behind[index] -= h
        after, before = chain.forward(ahead), chain.forward(behind)
        turned = Rotation.from_matrix(after[:3, :3] @ before[:3, :3].T).as_rotvec()
        columns.append(np.concatenate([after[:3, 3] - before[:3, 3], turned]) / (2 * h))
    return np.array(columns).T


def test_the_jacobian_is_the_derivative_of_the_pose_with_mimics_and_slides(chain: Chain) -> None:
    rng = np.random.default_rng(1)
    for q in rng.uniform(-1, 1, (10, 2)):
        tip, jacobian = chain.jacobian(q)
        np.testing.assert_allclose(tip, chain.forward(q), atol=1e-14)
        np.testing.assert_allclose(jacobian, _numeric_jacobian(chain, q), atol=1e-8)


def test_the_jacobian_of_a_real_arm_is_the_derivative_of_its_pose() -> None:
    arm = load_robot("agilex_piper").arms[0].chain
    assert arm is not None
    for q in np.random.default_rng(2).uniform(-1, 1, (10, 6)):
        np.testing.assert_allclose(arm.jacobian(q)[1], _numeric_jacobian(arm, q), atol=1e-8)


def test_a_batch_gives_what_single_calls_give(chain: Chain) -> None:
    q = np.random.default_rng(3).uniform(-1, 1, (4, 5, 2))
    together = chain.pose(q)
    assert together.shape == (4, 5, 7)
    for index in np.ndindex(4, 5):
        np.testing.assert_allclose(together[index], chain.pose(q[index]), atol=1e-15)


def test_a_frame_in_the_middle_gives_poses_relative_to_it(tree: urdf.Urdf, chain: Chain) -> None:
    from_torso = Chain(tree, "torso", "tool", ["turn", "bend"])
    q = np.array([0.3, 0.4])
    torso = _moved(0, 0, 1.3)
    np.testing.assert_allclose(torso @ from_torso.forward(q), chain.forward(q), atol=1e-14)


def test_a_full_turn_changes_nothing(chain: Chain) -> None:
    bend_only = Chain(urdf.read(chain._path), "slide", "tool", ["bend"])
    np.testing.assert_allclose(
        bend_only.pose(np.array([0.3])), bend_only.pose(np.array([0.3 + 2 * math.pi])), atol=1e-14
    )


def test_a_joint_on_the_way_that_nobody_moves_is_an_error(tree: urdf.Urdf) -> None:
    with pytest.raises(RobotError, match="'lift' lies between base and tool, not driven"):
        Chain(tree, "base", "tool", ["turn", "bend"])


def test_a_joint_that_moves_nothing_is_an_error(tree: urdf.Urdf) -> None:
    with pytest.raises(RobotError, match=r"'lift'.* on the way from torso to tool"):
        Chain(tree, "torso", "tool", ["lift", "turn", "bend"])


def test_mimics_in_a_circle_are_an_error(tmp_path: Path) -> None:
    path = tmp_path / "t.urdf"
    circle = TREE.replace('<axis xyz="0 1 1"/>', '<axis xyz="0 1 1"/><mimic joint="reach"/>')
    path.write_text(circle)
    with pytest.raises(RobotError, match="mimic each other in a circle"):
        Chain(urdf.read(path), "torso", "tool", ["bend"])


def test_joints_of_another_number_are_refused(chain: Chain) -> None:
    with pytest.raises(RobotError, match=r"allowed: \[..., 2\] for turn, bend"):
        chain.forward(np.zeros(3))
