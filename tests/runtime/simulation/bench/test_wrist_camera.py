"""Cameras on arms see what lies before the fingers."""

from __future__ import annotations

import numpy as np
import pytest

import robots
from runtime.simulation.bench.arm_frames import arm_frames
from runtime.simulation.bench.bench import wrist_camera
from runtime.simulation.bench.wrist_camera import CameraPlacement, place_wrist_camera

ROBOTS = robots.robot_names()


@pytest.mark.parametrize("name", ROBOTS)
def test_the_fingertips_are_in_the_picture_of_every_arms_camera(name):
    robot = robots.load_robot(name)
    for arm in robot.arms:
        tip = arm_frames(robot)[arm.name].tip(robot.poses["ready"])
        camera = wrist_camera(tip, 640, 480, place_wrist_camera(robot, arm.name))
        u, v = camera.project(tip[:3, 3])
        assert u == pytest.approx(319.5, abs=1)
        assert 200 < v < 400


def test_a_hand_that_hides_nothing_keeps_the_nearest_place():
    assert place_wrist_camera(robots.load_robot("agilex_piper"), "left_arm") == CameraPlacement()


def test_a_camera_is_not_put_inside_of_a_hand():
    robot = robots.load_robot("r1_lite")
    eye = place_wrist_camera(robot, "left_arm")
    assert eye.place != CameraPlacement().place
    assert np.sign(eye.up[0]) == np.sign(eye.place[0])
