import numpy as np
import pytest

from runtime.motion.timeline import DimensionKinds
from runtime.processes.control.displacement import DisplacementMonitor, stale_heartbeat
from runtime.processes.control.led import PART
from runtime.processes.control.plausibility import JointPlausibility
from tests.runtime.processes.control.test_actuator import robot, seen, settings
from tests.runtime.tick_bench import PERIOD, Bench


def test_a_sibling_that_is_silent_is_named_with_how_long():
    shared = Bench().shared
    shared.beat("coordinator", 100.0)
    shared.beat("guard", 100.0)
    allowed = {"guard": 1.0, "coordinator": 3.0}.__getitem__
    assert stale_heartbeat(shared, 100.9, allowed) == ""
    assert stale_heartbeat(shared, 101.5, allowed) == "no sign of life from guard for 1.5 s"
    shared.beat("guard", 104.0)
    assert stale_heartbeat(shared, 103.0, allowed) == ""
    assert stale_heartbeat(shared, 104.0, allowed) == "no sign of life from coordinator for 4.0 s"


def test_a_sibling_that_never_gave_a_sign_is_named_so():
    assert (
        stale_heartbeat(Bench().shared, 100.0, lambda process: 1.0)
        == "no sign of life from coordinator since it was restarted"
    )


class Held:
    """A robot that is held at 0, and what displacement says of each sample of it."""

    def __init__(self):
        self.actuator = robot(Bench())
        self.actuator.engage(np.zeros(2))
        self.judge = JointPlausibility(settings().limits, DimensionKinds())
        self.displacement = DisplacementMonitor(settings(), self.judge)
        self.now = 100.0

    def see(self, *joints, held=True):
        self.now += PERIOD
        judged = self.judge.judge(seen(*joints, captured=self.now), self.now, None)
        return self.displacement(self.actuator, judged, self.now, held)

    def miss(self, seconds):
        old = seen(0.0, 0.0, captured=self.now)
        until = self.now + seconds
        while self.now < until:
            self.now += PERIOD
            self.displacement(self.actuator, self.judge.judge(old, self.now, None), self.now, True)


def moved(robot, joint, ticks=8, held=True):
    """What is said while the arm is at `joint`, after it came there slowly."""
    for part in np.linspace(0.0, joint, 12):
        robot.see(part, 0.0, held=False)
    return [robot.see(joint, 0.0, held=held) for _ in range(ticks)]


def test_a_robot_is_displaced_beyond_the_following_error_and_only_while_it_is_held():
    held = Held()
    assert moved(held, 0.4) == [None] * 8
    assert moved(held, 0.6, held=False) == [None] * 8
    assert moved(held, 0.6)[-1] == pytest.approx([PART, 0.0])


def test_what_has_been_held_for_a_while_is_led_by_a_part_to_see_whether_it_goes_along():
    held = Held()
    moved(held, 0.4, ticks=31)
    assert [held.see(0.6, 0.0) for _ in range(8)][-1] == pytest.approx([PART, 0.0])
    assert held.displacement.goal == pytest.approx([0.6, 0.0])


def test_a_robot_is_displaced_where_several_samples_agree():
    held = Held()
    moved(held, 0.4)
    assert [held.see(0.6, 0.0) is None for _ in range(4)] == [True, True, True, False]


def test_what_was_not_seen_for_a_while_is_displaced_by_less():
    held = Held()
    assert moved(held, 0.2) == [None] * 8
    held.miss(0.7)
    assert [held.see(0.2, 0.0) is None for _ in range(5)] == [True, True, True, False, False]
