"""Short forms of what `python -m benchmarks soak` does for as long as it is given."""

import json

import pytest

from benchmarks import soak
from benchmarks.fuzzing import boxes, encoders


@pytest.mark.parametrize("seed", range(30))
def test_faulty_encoders_never_move_a_robot_beyond_its_limits_or_away_from_where_it_is(seed):
    assert encoders.once(seed) == []


@pytest.mark.parametrize("seed", range(75))
def test_no_command_has_an_end_effector_outside_its_box(seed):
    assert boxes.once(seed) == []


def test_a_soak_goes_through_all_fuzzers_and_names_what_they_find():
    asked = []
    report = soak.measure(
        0.0,
        {"sound": lambda seed: asked.append(seed) or [], "broken": lambda seed: [f"seed {seed}: broke"]},
        7,
    )
    figures = {figure.name: figure for figure in report.figures}
    assert asked == [7]
    assert figures["violations.sound"].holds
    assert not figures["violations.broken"].holds
    assert {"fuzzer": "broken", "seed": 7, "violation": "seed 7: broke"} in json.loads(report.json())["rows"]
    assert figures["leaks.files"].holds


def test_every_fuzzer_is_part_of_a_soak():
    assert {"boxes", "encoders"} <= set(soak.fuzzers())


def test_what_leaks_and_grows_is_seen():
    before, kept = soak.held(), []
    kept.append(open(__file__))  # noqa: SIM115
    kept.append(b"x" * 40_000_000)
    missed = {figure.name for figure in soak._grown(before, soak.held()) if figure.holds is False}
    kept[0].close()
    assert missed == {"leaks.files", "growth.memory"}
