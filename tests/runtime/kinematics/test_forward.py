"""Forward kinematics alone."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest

import robots
from runtime.kinematics.base import ChainForward, KinematicsError
from runtime.kinematics.compiled import CompiledKinematics
from tests.sources import ROOT


@pytest.mark.parametrize("name", robots.robot_names())
def test_it_says_what_the_compiled_kinematics_say(name: str) -> None:
    robot = robots.load_robot(name)
    q = np.random.default_rng(2).uniform(
        np.maximum(robot.lower, -9), np.minimum(robot.upper, 9), (4, 3, robot.dim)
    )
    np.testing.assert_allclose(
        ChainForward(robot).forward(q), CompiledKinematics(robot).forward(q), atol=1e-14
    )


def test_joints_of_another_width_are_refused() -> None:
    with pytest.raises(KinematicsError, match=r"shape \(16,\) were given; allowed: \[\.\.\., 14\]"):
        ChainForward(robots.load_robot("agilex_piper")).forward(np.zeros(16))


def test_control_and_media_load_no_compiler() -> None:
    code = """if True:
        import sys, numpy, robots
        import runtime.processes.control.process, runtime.processes.media.process, runtime.processes.reception.process
        from runtime.spaces.end_effectors import EndEffectors
        from runtime.kinematics.base import ChainForward
        robot = robots.load_robot("agilex_piper")
        EndEffectors(robot, ChainForward(robot)).eef_of(numpy.zeros(14))
        print([name for name in ("numba", "llvmlite") if name in sys.modules])
    """
    run = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert run.stdout.strip() == "[]"
