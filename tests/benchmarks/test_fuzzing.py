"""Short forms of what `python -m benchmarks soak` does for as long as it is given."""

import pytest

from benchmarks.fuzzing import encoders


@pytest.mark.parametrize("seed", range(30))
def test_faulty_encoders_never_move_a_robot_beyond_its_limits_or_away_from_where_it_is(seed):
    assert encoders.once(seed) == []
