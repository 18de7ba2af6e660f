"""Short forms of what `python -m benchmarks soak` does for as long as it is given."""

import pytest

from benchmarks.fuzzing import boxes, encoders


@pytest.mark.parametrize("seed", range(30))
def test_faulty_encoders_never_move_a_robot_beyond_its_limits_or_away_from_where_it_is(seed):
    assert encoders.once(seed) == []


@pytest.mark.parametrize("seed", range(75))
def test_no_command_has_an_end_effector_outside_its_box(seed):
    assert boxes.once(seed) == []
