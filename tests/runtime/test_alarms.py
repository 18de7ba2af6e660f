import numpy as np
import pytest

from runtime.alarms import Displacement, silent_sibling
from tests.runtime.test_actuator import robot, seen, settings
from tests.runtime.tick_bench import Bench


def test_a_sibling_that_is_silent_is_named_with_how_long():
    page = Bench().page
    page.beat("main", 100.0)
    page.beat("guard", 100.0)
    assert silent_sibling(page, 100.9, 1.0) == ""
    page.beat("main", 101.0)
    assert silent_sibling(page, 101.5, 1.0) == "no sign of life from guard for 1.5 s"


def test_a_sibling_that_never_gave_a_sign_is_named_so():
    assert silent_sibling(Bench().page, 100.0, 1.0) == "no sign of life from main since it was restarted"


@pytest.fixture
def actuator():
    held = robot(Bench())
    held.engage(np.zeros(2))
    return held


def test_a_robot_is_displaced_beyond_the_following_error_and_only_while_it_is_held(actuator):
    displacement = Displacement(settings())
    assert displacement(actuator, seen(0.4, 0.0), 100.0, True) is None
    assert displacement(actuator, seen(0.6, 0.0), 100.0, False) is None
    assert displacement(actuator, seen(0.6, 0.0), 100.0, True) == pytest.approx([0.6, 0.0])


def test_who_was_not_seen_for_a_while_is_displaced_by_less(actuator):
    displacement = Displacement(settings())
    for tick in range(7):
        assert displacement(actuator, seen(0.2, 0.0, captured=99.0), 100.0 + 0.1 * tick, True) is None
    assert displacement(actuator, seen(0.2, 0.0, captured=100.7), 100.7, True) == pytest.approx([0.2, 0.0])
    assert displacement(actuator, seen(0.2, 0.0, captured=100.8), 100.8, True) is None
