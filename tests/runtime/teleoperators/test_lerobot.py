"""A LeRobot teleoperator as a leader."""

from __future__ import annotations

import contextlib
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import robots
from runtime.core import msgpack_arrays
from runtime.core.clock import MonotonicClock, VirtualClock
from runtime.core.errors import ConfigurationError
from runtime.teleoperators import lerobot
from tests.processes import alive, eventually
from tests.runtime.lerobot.fake_lerobot import FakeLerobot

ROBOT = robots.load_robot("dual_franka")


def config(fake: FakeLerobot, **changes: Any) -> lerobot.Config:
    (arm, _) = ROBOT.groups
    joints = {name: {"feature": "pan.pos", "unit": "degrees"} for name in arm.joints}
    device = {"type": "handle", "folder": str(fake.device)}
    table = {"python": str(fake.python), "device": device, "joints": {arm.name: joints}, "rate": 100.0}
    return lerobot.Config.model_validate(table | changes)


def test_it_leads_the_groups_that_have_features_and_its_process_ends_with_it(tmp_path: Path) -> None:
    fake = FakeLerobot(tmp_path)
    with contextlib.closing(lerobot.build(config(fake), ROBOT, MonotonicClock())) as leader:
        leader.connect()
        pose = eventually(lambda: leader.latest_pose, "a pose")
        assert pose is not None
        (arm, other) = ROBOT.groups
        np.testing.assert_allclose(pose.joints[arm.slice], math.pi / 2, rtol=1e-6)
        assert np.isnan(pose.joints[other.slice]).all()
        assert leader.problem == ""
        process = int(fake.notes()[0]["connected"])
        fake.play("raises", "uncalibrated")
        eventually(lambda: "not calibrated" in leader.problem, "a problem")
        assert "--teleop.type=handle" in leader.problem
        old = leader.latest_pose
        fake.play()
        eventually(lambda: leader.latest_pose is not old and not leader.problem, "another pose")
    assert not alive(process)


def test_a_leader_without_features_or_with_unknown_joints_is_refused(tmp_path: Path) -> None:
    fake = FakeLerobot(tmp_path)
    with pytest.raises(ConfigurationError, match=r"collection.leader.joints is missing: the description of"):
        lerobot.build(config(fake, joints={}), ROBOT, MonotonicClock())
    with pytest.raises(ConfigurationError, match=r"collection.leader.joints: tail not of dual_franka"):
        lerobot.build(config(fake, joints={"tail": {}}), ROBOT, MonotonicClock())


def test_a_pose_that_waited_is_as_old_as_its_stamp_says(tmp_path: Path) -> None:
    clock = VirtualClock(100.0)
    leader = lerobot.build(config(FakeLerobot(tmp_path)), ROBOT, clock)
    arm = ROBOT.groups[0]
    for stamp, time in ((98.5, 98.5), (100.5, 100.0)):
        state = {arm.name: np.zeros(len(arm.joints), np.float32)}
        leader.handle_message(msgpack_arrays.pack({"t": stamp, "state": state}))
        assert leader.latest_pose is not None
        assert leader.latest_pose.arrived == time
