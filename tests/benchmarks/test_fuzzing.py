"""Short forms of what `python -m benchmarks soak` does for as long as it is given."""

import json
import logging

import numpy as np
import pytest

from benchmarks import soak
from benchmarks.fuzzing import answers, boxes, compliant, encoders, rtc_prefix

# Found by a soak of half an hour: an arm that is pushed on while the command is led to it.
PUSHED_ON = (1025813277, 1025813317, 1025813379)
_GATE = (0, PUSHED_ON[0])  # a scenario costs seconds of processor time


def seeds(*every):
    """All of them; most are labs."""
    return [seed if seed in _GATE else pytest.param(seed, marks=pytest.mark.exhaustive) for seed in every]


@pytest.mark.some(1)
@pytest.mark.parametrize("seed", seeds(*range(30), *PUSHED_ON))
def test_faulty_encoders_never_move_a_robot_beyond_its_limits_or_away_from_where_it_is(seed):
    assert encoders.once(seed) == []


@pytest.mark.parametrize("seed", seeds(*range(20)))
def test_nothing_that_is_done_to_an_arm_that_stands_below_its_command_moves_it(seed):
    assert compliant.once(seed) == []


@pytest.mark.exhaustive
def test_an_arm_that_sinks_is_noticed(monkeypatch):
    """As before: an e-stop leads the command to the reading."""
    monkeypatch.setattr(
        "runtime.processes.control.steady_error.SteadyError.unchanged_joints",
        lambda self, actuator, measured, now: np.zeros(len(measured), bool),
    )
    found = [text for seed in range(3) for text in compliant.once(seed)]
    assert any("moves an arm that stands" in text for text in found)


@pytest.mark.parametrize("seed", seeds(*range(75)))
def test_no_command_has_an_end_effector_outside_its_box(seed):
    assert boxes.once(seed) == []


@pytest.mark.parametrize("seed", seeds(*range(16)))
def test_what_a_request_declares_fixed_is_what_control_plans_for_these_steps(seed):
    assert rtc_prefix.once(seed) == []


@pytest.mark.exhaustive
def test_a_plan_that_is_another_one_than_was_declared_is_noticed(monkeypatch):
    """As before: the rows of the newest answer as it was given, whatever control has blended."""
    monkeypatch.setattr("runtime.processes.coordinator.inference.rtc_prefix._shares", lambda merged: {})
    found = [text for seed in range(4) for text in rtc_prefix.once(seed)]
    assert any("off in number" in text for text in found)


@pytest.mark.parametrize("seed", seeds(*range(24)))
def test_an_answer_that_comes_twice_answers_no_other_question(seed):
    assert answers.once(seed) == []


def test_answers_that_are_off_by_one_are_noticed(monkeypatch):
    """As before: what comes next is the answer."""
    monkeypatch.setattr("runtime.policies.websocket_link.WebsocketLink._require_silence", lambda *given: None)
    monkeypatch.setattr("runtime.policies.websocket.WebsocketPolicy._mismatch_reason", lambda *given: "")
    monkeypatch.setattr("runtime.policies.openpi.OpenpiPolicy._mismatch_reason", lambda *given: "")
    found = [text for seed in range(8) for text in answers.once(seed)]
    assert any("has an answer that begins" in text for text in found)


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
    assert {"answers", "boxes", "encoders", "rtc_prefix"} <= set(soak.fuzzers())


def test_what_leaks_and_grows_is_seen():
    before, kept = soak.held_resources(), []
    kept.append(open(__file__))  # noqa: SIM115
    kept.append(b"x" * 40_000_000)
    after = soak.held_resources()
    kept[0].close()
    missed = {figure.name for figure in soak._grown([before, after]) if figure.holds is False}
    assert missed == {"leaks.files"}
    assert after.memory_mb - before.memory_mb > 30


@pytest.mark.parametrize(
    ("leaked", "rounds", "holds"), [(0.0, 200, True), (0.1, 200, False), (0.1, 199, None)]
)
def test_what_comes_and_goes_is_no_growth_and_too_few_rounds_say_nothing(leaked, rounds, holds):
    memory = 250.0 + np.random.default_rng(3).normal(0.0, 3.0, rounds) + leaked * np.arange(rounds)
    figures = soak._grown([soak.HeldResources(5, 1, 0, mb) for mb in memory])
    assert {figure.name: figure.holds for figure in figures}["growth.memory"] is holds


def test_warnings_that_scenarios_provoke_are_not_shown_and_errors_are(caplog):
    log = logging.getLogger("runtime.policies.somewhere")

    def provoking(seed):
        log.warning("doubted")
        log.error("broken")
        return []

    soak.measure(0.0, {"provoking": provoking}, 7)
    log.warning("afterwards")
    assert [record.getMessage() for record in caplog.records] == ["broken", "afterwards"]
