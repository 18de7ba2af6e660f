from __future__ import annotations

import numpy as np

import robots
from runtime.kinematics.base import IkFlag, KinematicsSettings
from runtime.kinematics.evaluation import evaluate_solution

PIPER = robots.load_robot("agilex_piper")
READY = PIPER.poses["ready"]
LIMITS = (PIPER.lower[None], PIPER.upper[None])


def poses_of(q):
    return np.stack([arm.pose(q) for arm in PIPER.arms], axis=-2)


def test_what_is_met_has_no_error_and_no_flag():
    result = evaluate_solution(PIPER, KinematicsSettings(), READY[None], poses_of(READY)[None], LIMITS)
    assert result.position_error.max() < 1e-12
    assert result.rotation_error.max() < 1e-7
    assert not result.flags.any()
    assert result.reached.all()


def test_errors_are_metres_and_radians_of_each_arm():
    targets = poses_of(READY)[None]
    targets[0, 1, :3] += [0.003, 0.0, 0.004]
    half = 0.05
    w, x, y, z = targets[0, 0, 3:]
    targets[0, 0, 3:] = [
        w * np.cos(half) - z * np.sin(half),
        x * np.cos(half) - y * np.sin(half),
        y * np.cos(half) + x * np.sin(half),
        z * np.cos(half) + w * np.sin(half),
    ]
    result = evaluate_solution(PIPER, KinematicsSettings(), READY[None], targets, LIMITS)
    np.testing.assert_allclose(result.position_error, [[0.0, 0.005]], atol=1e-12)
    np.testing.assert_allclose(result.rotation_error, [[0.1, 0.0]], atol=1e-7)
    assert (result.flags == IkFlag.OVER_TOLERANCE).all()


def test_a_joint_on_its_limit_is_told_from_one_that_moves_as_fast_as_it_may():
    q = READY.copy()
    q[1] = PIPER.upper[1]
    low, high = READY - 0.1, READY + 0.1
    q[8] = high[8]
    result = evaluate_solution(
        PIPER, KinematicsSettings(), q[None], poses_of(q)[None], (low[None], high[None])
    )
    assert result.flags[0, 0] & IkFlag.AT_LIMIT
    assert not result.flags[0, 0] & IkFlag.AT_VELOCITY
    assert result.flags[0, 1] & IkFlag.AT_VELOCITY
    assert not result.flags[0, 1] & IkFlag.AT_LIMIT


def test_a_wrist_whose_axes_line_up_is_near_singular():
    q = READY.copy()
    q[4] = 0.0  # the fourth and the sixth axis are one then
    result = evaluate_solution(PIPER, KinematicsSettings(), q[None], poses_of(q)[None], LIMITS)
    assert result.flags[0, 0] & IkFlag.NEAR_SINGULAR
    assert not result.flags[0, 1] & IkFlag.NEAR_SINGULAR
