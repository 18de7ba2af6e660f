import numpy as np
import pytest

from runtime.processes.control.actuator import TickResult
from runtime.processes.control.behaviours import Target
from runtime.processes.control.telemetry import LimitingMonitor, ProximityMonitor, Telemetry
from runtime.safety.collision import Collision
from tests.runtime.tick_bench import Bench, following, wave


class Said(list):
    def __call__(self, kind, text):
        self.append((kind, text))


def limited(change, what="a limited from 1.0000 to 0.5000"):
    return TickResult(0.0, None, np.zeros(2), limited=what, change=change)


def test_changes_are_told_when_they_begin_and_summed_up_when_they_are_over():
    limiting = LimitingMonitor(said := Said())
    limiting.update(limited(0.1), 10.0)
    limiting.update(limited(0.5, "b limited from 2.0000 to 1.5000"), 10.1)
    limiting.update(TickResult(0.0), 10.5)
    limiting.update(limited(0.2), 10.9)
    limiting.update(TickResult(0.0), 11.8)
    assert said == [("limited", "a limited from 1.0000 to 0.5000")]
    limiting.update(TickResult(0.0), 11.9)
    assert said[1:] == [("limited_sum", "3 actions were limited, worst: b limited from 2.0000 to 1.5000")]
    limiting.update(limited(0.2), 12.0)
    assert said[2][0] == "limited"


def test_rounding_at_a_limit_is_no_news():
    limiting = LimitingMonitor(said := Said())
    limiting.update(limited(1e-5), 10.0)
    limiting.close()
    assert said == []


def test_closing_what_was_never_limited_says_nothing():
    limiting = LimitingMonitor(said := Said())
    limiting.close()
    limiting.update(limited(0.2), 10.0)
    limiting.close()
    limiting.close()
    assert [kind for kind, _ in said] == ["limited", "limited_sum"]


def near(distance, other="right_arm/hand"):
    return TickResult(0.0, None, np.zeros(2), near=Collision("left_arm/hand", other, distance))


def test_what_comes_near_is_told_once_and_how_near_it_came_when_it_is_over():
    nearing = ProximityMonitor(said := Said())
    nearing.update(near(0.004), 10.0)
    nearing.update(near(-0.01, "table"), 10.1)
    nearing.update(near(-0.002), 10.2)
    nearing.update(TickResult(0.0), 10.9)
    assert said == [("near", "left_arm/hand and right_arm/hand would be 4 mm apart")]
    nearing.update(TickResult(0.0), 11.2)
    text = "3 actions came too near, nearest: left_arm/hand and table would collide (10 mm deep)"
    assert said[1:] == [("near_sum", text)]
    nearing.update(near(0.004), 12.0)
    nearing.close()
    nearing.close()
    assert [kind for kind, _ in said] == ["near", "near_sum", "near", "near_sum"]


@pytest.mark.parametrize(
    ("sent", "simulated", "source"),
    [
        (TickResult(0.0), False, "none"),
        (TickResult(0.0, Target(np.zeros(2), "policy", "policy"), np.zeros(2)), False, "policy"),
        (TickResult(0.0, Target(np.zeros(2), "policy", "policy"), np.zeros(2)), True, "sim"),
        (TickResult(0.0, Target(np.zeros(2), "policy", "policy"), np.zeros(2), refused=True), False, "hold"),
        (TickResult(0.0, Target(np.zeros(2), "policy", "policy"), np.zeros(2), refused=True), True, "sim"),
        (TickResult(0.0, None, np.zeros(2)), False, "hold"),
        (TickResult(0.0, None, np.zeros(2)), True, "sim"),
        (TickResult(0.0, Target(np.zeros(2), "hold", None), np.zeros(2)), True, "hold"),
        (TickResult(0.0, Target(np.zeros(2), "estop", None), np.zeros(2)), False, "estop"),
    ],
)
def test_a_record_says_what_filled_its_tick(sent, simulated, source):
    bench = Bench()
    bench.observe()
    report = Telemetry(bench.shared)
    report.begin_tick(3, 100.0)
    report.add_tick(bench.tick._eyes.read_latest(), sent, simulated)
    (record,) = bench.records()
    assert (record.source, record.step, record.planned) == (source, 3, 100.0)


def test_a_restarted_control_goes_on_counting():
    bench = following(Bench())
    bench.tick.status["missed"] = 5
    bench.run(2)
    assert Telemetry(bench.shared).status["missed"] == 5


def test_what_leads_a_step_is_the_chunk_with_the_largest_part():
    bench = following(Bench({"kind": "async", "blend_window": 5}), wave(60))
    bench.run(2)
    bench.chunk(2, wave(60) + 0.01, step=0)
    leading = []
    for _ in range(5):
        bench.run()
        leading.append((int(bench.status["chunk"]), int(bench.status["chunks"])))
    assert leading == [(1, 1), (1, 2), (1, 2), (2, 2), (2, 1)]
