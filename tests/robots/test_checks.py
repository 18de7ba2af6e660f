"""Forward kinematics of the seven robots against poses that another program computed from published descriptions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from robots import Group, Robot, load_robot, urdf
from robots.chain import Chain
from robots.rotations import matrix_of_quaternion, transform_of

Numbers = tuple[float, ...]

# robot, arm, joints; below: frame, x y z [m], qw qx qy qz of the arm's end-effector link there
TABLE = """
agilex_piper left_arm 0.0 0.0 0.0 0.0 0.0 0.0
  base_link    0.056142472 -0.000000056  0.213193093  0.737256126  0.000002326  0.675613354 -0.000004995
agilex_piper left_arm 0.6848 0.6745 -2.3976 -1.6873 0.7644 1.729
  base_link   -0.192737485 -0.238235330  0.629910270  0.840525911  0.397566517 -0.029771476  0.366838817
agilex_piper right_arm 0.0 0.0 0.0 0.0 0.0 0.0
  base_link    0.056142472 -0.000000056  0.213193093  0.737256126  0.000002326  0.675613354 -0.000004995
agilex_piper right_arm -1.0014 1.0567 -2.4292 -1.3113 0.4163 0.6165
  base_link   -0.073508342  0.048724792  0.721159201  0.635867633  0.213463921  0.075552096 -0.737832900
arx_r5 left_arm 0.0 0.0 0.0 0.0 0.0 0.0
  base_link    0.100200000  0.000000441  0.163500000  1.000000000  0.000000000  0.000000000  0.000000000
arx_r5 left_arm -0.0708 1.9474 2.1702 -0.711 0.3576 -0.8907
  base_link    0.427274292 -0.039172726  0.415872881  0.840818153 -0.439617447  0.304722091 -0.083101033
arx_r5 right_arm 0.0 0.0 0.0 0.0 0.0 0.0
  base_link    0.100200000  0.000000441  0.163500000  1.000000000  0.000000000  0.000000000  0.000000000
arx_r5 right_arm -0.8194 -1.7486 -0.2483 1.4816 -1.3468 -2.2399
  base_link   -0.019133519  0.056596843  0.104926414  0.759056187  0.453015324  0.222240033  0.411363817
dual_franka left_arm -1.88733017 -0.98627802 1.34066187 -1.77472402 0.08241637 1.8024626 0.79725709
  base_link    0.539877779 -0.142724116  0.492681717  0.441828091  0.863104924 -0.244495792  0.007722415
  workcell     0.578344595  0.109038167  0.558289527  0.766934915  0.495031426 -0.408146809 -0.013073083
dual_franka left_arm -0.2981 1.6027 -0.0005 -1.4666 0.6011 2.4877 2.2447
  base_link    0.384731011 -0.085393625 -0.357191690  0.062462676  0.370856801 -0.881188308 -0.286480040
  workcell     0.251464063 -0.427724551 -0.037258133  0.166142555  0.073341598 -0.976799076  0.113495488
dual_franka right_arm -1.88733017 -0.98627802 1.34066187 -1.77472402 0.08241637 1.8024626 0.79725709
  base_link    0.539877779 -0.142724116  0.492681717  0.441828091  0.863104924 -0.244495792  0.007722415
  workcell     0.692867086 -0.251829618  0.339255525  0.009039106  0.999876812  0.004469486 -0.012028298
dual_franka right_arm 1.8182 1.6965 2.2861 -2.1385 2.3631 2.2229 1.6119
  base_link   -0.481243169  0.085780174  0.801984125  0.826410597 -0.000857084 -0.187082090 -0.531079167
  workcell    -0.220791219 -0.817609821  0.528177319  0.849075797  0.393911704  0.088250802 -0.340757475
r1_lite left_arm 0.0 0.0 0.0 0.0 0.0 0.0
  base_link    0.206670903  0.333509760  0.987323364  0.999975500  0.000000000  0.006999943  0.000000000
  torso_link3  0.058853000  0.334999430  0.333845000  1.000000000  0.000000000 -0.000000000  0.000000000
r1_lite left_arm 1.2898 1.2819 -0.1772 -1.3632 1.0723 -2.1665
  base_link    0.113230177  0.537543606  1.111764718  0.194955932 -0.324106508 -0.869091666  0.318789637
  torso_link3 -0.036320691  0.539033276  0.456966031  0.188867564 -0.326330076 -0.870435053  0.316513100
r1_lite right_arm 0.0 0.0 0.0 0.0 0.0 0.0
  base_link    0.206670903 -0.336490240  0.987323364  0.999975500  0.000000000  0.006999943  0.000000000
  torso_link3  0.058853000 -0.335000570  0.333845000  1.000000000  0.000000000 -0.000000000  0.000000000
r1_lite right_arm 1.5486 1.4012 -1.7789 -0.2736 0.9994 0.6325
  base_link    0.070638827 -0.142259178  1.426716726  0.236436514  0.175318566 -0.009236081  0.955654681
  torso_link3 -0.083317051 -0.140769508  0.771290915  0.236366070  0.168624742 -0.010890897  0.956858488
so101 arm 0.0 0.0 0.0 0.0 0.0
  base_link    0.391361470 -0.000009212  0.226469710  0.706900467  0.017206475  0.706894164  0.017213607
so101 arm 0.8123 -0.6321 0.9417 1.1034 -0.7512
  base_link    0.136240987 -0.095032312  0.029676413  0.078818030  0.719338427  0.690173680 -0.000487447
ur5e arm -3.347579781 -1.288271443 1.428681676 1.511682196 1.602302194 -0.215132062
  base_link   -0.401227474 -0.043022457  0.235358591  0.736848177  0.001195781  0.676002987  0.008561322
ur5e arm -2.4502 -0.6748 -2.1068 0.7631 -1.1308 1.0133
  base_link    0.034150924 -0.304891846  0.373140934  0.140339706  0.682080874 -0.288375708 -0.657198523
agibot_g2 left_arm 0.739033 -0.717023 -1.524419 -1.537612 0.27811 -0.925845 -0.839257
  base_link    0.661329049  0.313090145  0.941720356  0.159543241 -0.231920733  0.776770196 -0.563370917
  body_link5   0.511180351  0.313090145  0.348942526  0.340763981 -0.090388764  0.716034840 -0.602498040
agibot_g2 left_arm 1.9065 0.0441 -0.7785 0.9945 -0.9203 -0.6424 1.1676
  base_link    0.390498585  0.625650748  1.512487805  0.877434353  0.185094482  0.440273526 -0.044813067
  body_link5   0.006161720  0.625650748  0.728522297  0.957290969  0.190440481  0.217544989  0.000775421
agibot_g2 right_arm -0.739033 -0.717023 1.524419 -1.537612 -0.27811 -0.925845 0.839257
  base_link    0.661328149 -0.313090142  0.941722794  0.159541665  0.231919202  0.776769302  0.563373227
  body_link5   0.511178421 -0.313090142  0.348944266  0.340762237  0.090386725  0.716034349  0.602499916
agibot_g2 right_arm 0.3917 -1.2599 0.1301 -0.6596 -2.0553 0.9757 0.2193
  base_link    0.888728053 -0.191873671  1.305868062  0.953096802 -0.110679964  0.269542479  0.081873583
  body_link5   0.543347937 -0.191873671  0.777053616  0.989905564 -0.127054735  0.033669529  0.053013513
"""


@dataclass(frozen=True)
class Check:
    """An arm's end-effector link at joints `q`: x, y, z, qw, qx, qy, qz in each frame."""

    robot: str
    arm: str
    q: Numbers
    poses: dict[str, Numbers]


def _checks() -> list[Check]:
    checks: list[Check] = []
    for line in TABLE.strip().splitlines():
        words = line.split()
        if line.startswith(" "):
            checks[-1].poses[words[0]] = tuple(map(float, words[1:]))
        else:
            checks.append(Check(words[0], words[1], tuple(map(float, words[2:])), {}))
    return checks


CHECKS = _checks()
TOLERANCE = 5e-9  # m, and of a quaternion: the digits given, 9, and what the sums of both programs round
CASES = [
    pytest.param(check, frame, id=f"{check.robot}-{check.arm}-{number % 2}-{frame}")
    for number, check in enumerate(CHECKS)
    for frame in check.poses
]
PINNED = {  # joints of a torso or body and of a head, as they stood for the check
    "r1_lite": {"torso_joint1": -0.657, "torso_joint2": 1.516, "torso_joint3": 0.845},
    "agibot_g2": {
        "idx01_body_joint1": -0.83423,
        "idx02_body_joint2": 1.2172,
        "idx03_body_joint3": 0.10025,
        "idx04_body_joint4": 0.0,
        "idx05_body_joint5": 0.0,
    },
}


@pytest.mark.parametrize(("check", "frame"), CASES)
def test_the_end_effector_is_where_another_program_has_it(check: Check, frame: str) -> None:
    robot = load_robot(check.robot)
    arm = robot.group(check.arm)
    tree = urdf.read(robot.urdf)
    start = tree.root if frame == robot.mount_frame else frame
    assert arm.eef_link is not None
    chain = Chain(tree, start, arm.eef_link, arm.urdf_joints, PINNED.get(check.robot))
    found = chain.forward(np.array(check.q))
    if frame == robot.mount_frame:
        found = transform_of(arm.mount) @ found
    _assert_same(found, check.poses[frame])


@pytest.mark.parametrize("check", CHECKS, ids=lambda check: f"{check.robot}-{check.arm}-{check.q[0]}")
def test_the_pose_in_the_frame_that_the_arm_declares_is_among_the_checks(check: Check) -> None:
    robot = load_robot(check.robot)
    arm = robot.group(check.arm)
    assert arm.frame in check.poses
    _assert_same(arm.transform(_standing(robot, arm, check)), check.poses[arm.frame])


def _standing(robot: Robot, arm: Group, check: Check) -> np.ndarray:
    """The robot's vector at home, but for the arm's own joints and for what carries it."""
    q = robot.poses["home"].copy()
    for group in robot.groups:
        for name, dim in zip(group.urdf_joints, group.joint_dims, strict=True):
            q[dim] = PINNED.get(check.robot, {}).get(name, q[dim])
    q[arm.joint_dims] = check.q
    return q


def _assert_same(found: np.ndarray, wanted: Numbers) -> None:
    position, wxyz = np.array(wanted[:3]), np.array(wanted[3:])
    np.testing.assert_allclose(found[:3, 3], position, rtol=0, atol=TOLERANCE)
    turned = matrix_of_quaternion(wxyz / np.linalg.norm(wxyz))
    np.testing.assert_allclose(found[:3, :3], turned, rtol=0, atol=2 * TOLERANCE)
