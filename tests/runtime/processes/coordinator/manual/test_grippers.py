"""Grippers by hand."""

from __future__ import annotations

from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import robots
from runtime.core.errors import RuntimeFault
from runtime.ipc.command_arguments import GripperRequest
from runtime.processes.coordinator.manual.grippers import Grippers


@cache
def robot() -> Any:
    return robots.load_robot("agilex_piper")


def grippers() -> Grippers:
    made = robot()
    limits = SimpleNamespace(lower=made.lower, upper=made.upper)
    spec: Any = SimpleNamespace(robot=made, limits=limits)
    return Grippers(spec)


def at(value: float = 0.05) -> np.ndarray:
    return np.full(robot().dim, value)


LEFT, RIGHT = 6, 13


def test_where_nothing_else_moves_a_gripper_is_moved_and_nothing_but_it() -> None:
    grip = grippers().plan_request(GripperRequest(arm="left_arm", action="open"), at(), free=True)
    assert grip.goal is not None
    assert grip.goal[LEFT] == robot().group("left_arm").gripper.open
    assert np.isnan(np.delete(grip.goal, LEFT)).all()
    assert np.isnan(grip.locks).all()


def test_while_a_policy_drives_it_is_locked_where_it_is_wanted() -> None:
    grip = grippers().plan_request(GripperRequest(arm="right_arm", action="close"), at(), free=False)
    assert grip.goal is None
    assert grip.locks[RIGHT] == robot().group("right_arm").gripper.close
    assert np.isnan(np.delete(grip.locks, RIGHT)).all()


def test_a_lock_keeps_it_where_it_is_told_to_be_and_unlocking_gives_it_back() -> None:
    hand = grippers()
    hand.lock(hand.plan_request(GripperRequest(action="lock"), at(0.03), free=False).locks)
    assert np.allclose(hand.locks[[LEFT, RIGHT]], 0.03)
    assert hand.status(at(0.03)) == {
        "left_arm": {"locked": True, "at": pytest.approx(0.03)},
        "right_arm": {"locked": True, "at": pytest.approx(0.03)},
    }
    hand.lock(hand.plan_request(GripperRequest(arm="left_arm", action="unlock"), at(), free=False).locks)
    assert np.isnan(hand.locks[LEFT])
    assert not np.isnan(hand.locks[RIGHT])


def test_a_locked_gripper_that_is_opened_by_hand_stays_locked_there() -> None:
    hand = grippers()
    hand.lock(hand.plan_request(GripperRequest(arm="left_arm", action="lock"), at(), free=True).locks)
    grip = hand.plan_request(GripperRequest(arm="left_arm", action="open"), at(), free=True)
    assert grip.goal is not None
    assert grip.locks[LEFT] == grip.goal[LEFT]


def test_an_arm_without_a_gripper_is_refused_with_those_that_have_one() -> None:
    with pytest.raises(RuntimeFault, match=r"arm = 'head'; agilex_piper has grippers on left_arm, right_arm"):
        grippers().plan_request(GripperRequest(arm="head", action="open"), at(), free=True)


def test_what_is_still_on_its_way_to_its_lock_is_locked_where_it_is() -> None:
    hand = grippers()
    hand.locks[LEFT], hand.locks[RIGHT] = 0.1, 0.05
    standing = hand.settled_locks(at(0.05))
    assert (standing[LEFT], standing[RIGHT]) == (0.05, 0.05)
    assert np.isnan(np.delete(standing, [LEFT, RIGHT])).all()
    assert hand.locks[LEFT] == 0.1  # asked, not changed
