import numpy as np
import pytest

from runtime.ipc.observation_reader import ObservationReader
from tests.runtime.tick_bench import Bench


def test_before_the_first_observation_nothing_is_measured():
    seen = ObservationReader(Bench(seen=False).shared).read_latest()
    assert (seen.sequence, seen.measured) == (0, False)
    assert not seen.is_fresh(0.0, 1.0)


def test_the_newest_observation_is_read_once():
    bench = Bench()
    eyes = ObservationReader(bench.shared)
    bench.measured = np.array([0.25, -0.5])
    bench.observe()
    first = eyes.read_latest()
    assert first.joints.tolist() == first.qpos.tolist() == [0.25, -0.5]
    assert eyes.read_latest() is first
    bench.observe()
    assert eyes.read_latest().sequence == first.sequence + 1


def test_ages_are_those_of_each_part():
    bench = Bench()
    bench.observe(captured={"joints": 99.0, "cam": 98.0})
    seen = ObservationReader(bench.shared).read_latest()
    assert seen.is_fresh(99.2, 0.2 + 1e-9)
    assert not seen.is_fresh(99.3, 0.2)
    assert seen.picture_ages(100.0) == {"cam": pytest.approx(2.0)}


def test_a_picture_that_never_came_has_no_age():
    bench = Bench()
    bench.observe(captured={"joints": 99.0})
    assert np.isnan(ObservationReader(bench.shared).read_latest().picture_ages(100.0)["cam"])


def test_a_joint_that_is_no_number_is_no_measurement():
    bench = Bench()
    bench.observe(qpos=np.array([np.nan, 0.0], np.float32))
    assert not ObservationReader(bench.shared).read_latest().is_fresh(bench.clock.now(), 1.0)
