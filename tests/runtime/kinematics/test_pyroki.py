from __future__ import annotations

import sys

import numpy as np
import pytest

import robots
from runtime.core.errors import SetupError
from runtime.kinematics import compiled, pyroki

RATE = 30.0


@pytest.fixture(scope="module", params=["agilex_piper", "ur5e"])
def both(request):
    """A robot, PyRoki's kinematics of it, and the default ones."""
    pytest.importorskip("pyroki", reason="PyRoki is not installed: it is on no package index")
    robot = robots.load_robot(request.param)
    return robot, pyroki.build(pyroki.Config(), robot), compiled.build(compiled.Config(), robot)


def smooth(robot, rows=50, by=0.2):
    """Joints [rows, D] on a smooth way from a posture well within the limits, and their poses."""
    moving = np.isin(np.arange(robot.dim), np.concatenate([arm.joint_dims for arm in robot.arms]))
    ready = robot.poses["ready"]
    start = np.where(moving, np.clip(ready, robot.lower + by, robot.upper - by), ready)
    q = start + by * np.sin(np.linspace(0, 2 * np.pi, rows))[:, None] * moving
    return q, np.stack([arm.pose(q) for arm in robot.arms], axis=1)


def test_without_pyroki_the_error_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "pyroki", None)
    with pytest.raises(SetupError, match=r"kinematics\.kind = \"pyroki\".*from their repositories.*compiled"):
        pyroki.build(pyroki.Config(), robots.load_robot("agilex_piper"))


def test_nothing_of_pyroki_is_imported_by_choosing_another_backend():
    assert "pyroki" not in sys.modules or "jaxls" in sys.modules  # only the fixture of this module imports it
    assert not hasattr(pyroki, "jax")


def test_reachable_poses_are_met_as_by_the_default_backend(both):
    robot, theirs, ours = both
    q, poses = smooth(robot)
    found, wanted = theirs.solve(poses, q[0], 1 / RATE, q[0]), ours.solve(poses, q[0], 1 / RATE, q[0])
    assert found.reached.all()
    assert found.position_error.max() < 5e-5
    assert np.degrees(found.rotation_error.max()) < 0.02
    np.testing.assert_allclose(found.q, wanted.q, atol=2e-3)


def test_limits_and_velocities_hold_also_out_of_reach(both):
    robot, theirs, _ = both
    q, poses = smooth(robot)
    poses[:, :, 0] += 2.0
    result = theirs.solve(poses, q[0], 1 / RATE, q[0])
    assert not result.reached.any()
    assert (result.q >= robot.lower).all()
    assert (result.q <= robot.upper).all()
    steps = np.abs(np.diff(np.concatenate([q[:1], result.q]), axis=0))
    assert (steps <= robot.velocity / RATE * (1 + 1e-9) + 1e-12).all()


def test_stale_rows_are_free_and_the_first_executed_one_is_bound_to_the_anchor(both):
    robot, theirs, _ = both
    q, poses = smooth(robot)
    arm = robot.arms[0].joint_dims
    anchor = q[10].copy()
    anchor[arm] += 0.05
    result = theirs.solve(poses, q[0], 1 / RATE, anchor, 10)
    assert (np.abs(result.q[10, arm] - anchor[arm]) <= robot.velocity[arm] / RATE + 1e-9).all()
    assert np.abs(result.q[5] - q[5]).max() < 0.05
