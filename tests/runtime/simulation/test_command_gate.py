from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import robots
from runtime.core import msgpack_arrays
from runtime.simulation.bench.block_table import ResetRequest
from runtime.simulation.command_gate import CommandGate
from runtime.simulation.drives import DriveSwitch

ROBOT = robots.load_robot("agilex_piper")
HOME = ROBOT.poses["home"].astype(np.float32)


def command(action: Any = HOME, **fields: Any) -> bytes:
    return msgpack_arrays.pack({"t": 0.0, "action": action, "target": "real"} | fields)


@pytest.fixture
def gate() -> CommandGate:
    return CommandGate(ROBOT, deadline=0.3)


def test_a_whole_target_within_limits_passes(gate: CommandGate) -> None:
    target = HOME + np.where(np.asarray(ROBOT.upper) > 0.01, 0.01, -0.01).astype(np.float32)
    accepted = gate.accept(command(target), 0.0)
    assert accepted is not None
    assert accepted.target is not None
    np.testing.assert_allclose(accepted.target, target, atol=1e-6)
    assert gate.refused == {}


@pytest.mark.parametrize(
    ("action", "reason"),
    [
        (HOME[:13], "dimension"),
        (HOME[None], "dimension"),
        (np.where(np.arange(14) == 3, np.nan, HOME), "not_finite"),
        (np.where(np.arange(14) == 3, np.inf, HOME), "not_finite"),
        (np.where(np.arange(14) == 0, 3.0, HOME), "limits"),
        (np.where(np.arange(14) == 6, -0.01, HOME), "limits"),
        (np.zeros(14, np.int64), "malformed"),
        ([0.0] * 14, "malformed"),
        (None, "malformed"),
    ],
)
def test_a_target_that_no_arm_may_be_given_is_refused_and_counted(
    gate: CommandGate, action: Any, reason: str
) -> None:
    assert gate.accept(command(action), 0.0) is None
    assert gate.refused == {reason: 1}
    assert gate.is_silent(0.0)


def test_limits_that_were_rounded_to_float32_are_not_violations(gate: CommandGate) -> None:
    for bound in (ROBOT.lower, ROBOT.upper):
        accepted = gate.accept(command(bound.astype(np.float32)), 0.0)
        assert accepted is not None
        assert accepted.target is not None
        assert (accepted.target >= ROBOT.lower).all()
        assert (accepted.target <= ROBOT.upper).all()


@pytest.mark.parametrize(
    "payload", [b"", b"\xc1", msgpack_arrays.pack([1]), msgpack_arrays.pack({"target": 3})]
)
def test_garbage_is_refused_as_malformed(gate: CommandGate, payload: bytes) -> None:
    assert gate.accept(payload, 0.0) is None
    assert gate.refused == {"malformed": 1}


def test_without_a_target_field_it_is_meant_for_the_robot(gate: CommandGate) -> None:
    accepted = gate.accept(msgpack_arrays.pack({"t": 0.0, "action": HOME}), 0.0)
    assert accepted is not None
    assert accepted.target is not None


def test_a_target_for_the_simulation_is_ignored_without_a_word(gate: CommandGate) -> None:
    assert gate.accept(command(target="sim"), 0.0) is None
    assert gate.refused == {}


def test_an_unknown_target_is_refused(gate: CommandGate) -> None:
    assert gate.accept(command(target="fire"), 0.0) is None
    assert gate.refused == {"unknown_target": 1}


@pytest.mark.parametrize("word", ["collect_start", "collect_stop", "hil_start", "hil_stop"])
def test_control_words_pass_without_counting_as_a_command(gate: CommandGate, word: str) -> None:
    accepted = gate.accept(command(np.zeros(14, np.float32), target=word), 0.0)
    assert accepted is not None
    assert accepted.control == word
    assert accepted.target is None
    assert gate.is_silent(0.0)


def test_it_is_silent_after_the_deadline_by_our_own_clock(gate: CommandGate) -> None:
    assert gate.is_silent(100.0)
    gate.accept(command(t=9e9), 100.0)
    assert not gate.is_silent(100.3)
    assert gate.is_silent(100.31)


def test_a_command_that_has_waited_longer_than_the_deadline_is_stale(gate: CommandGate) -> None:
    """As after the node stood still: what was sent meanwhile is there at once, oldest first."""
    ahead = 5e4  # the client's clock is another machine's
    for tick in range(30):
        assert gate.accept(command(t=ahead + tick / 10, seq=tick), tick / 10) is not None
    queued = [gate.accept(command(t=ahead + tick / 10, seq=tick), 5.05) for tick in range(30, 51)]
    assert [accepted is not None for accepted in queued] == [False] * 18 + [True] * 3
    assert gate.refused == {"stale": 18}
    assert gate.ack == 50


def test_a_queue_of_stale_commands_ends_no_silence(gate: CommandGate) -> None:
    gate.accept(command(t=1.0), 1.0)
    for tick in range(5):
        gate.accept(command(t=1.1 + tick / 100), 4.0)
    assert gate.is_silent(4.0)


@pytest.mark.parametrize("stamps", [[0.0] * 40, [None] * 40, [float("nan")] * 40, list(range(40, 0, -1))])
def test_a_client_without_a_clock_that_goes_on_is_judged_by_arrival_alone(
    gate: CommandGate, stamps: list[Any]
) -> None:
    for tick, stamp in enumerate(stamps):
        assert gate.accept(command(t=stamp), tick / 2) is not None
    assert gate.refused == {}


def test_a_client_whose_clock_jumps_is_understood_at_once(gate: CommandGate) -> None:
    clock = [tick / 30 for tick in range(20)]
    clock += [9e5 + one for one in clock] + [one - 400 for one in clock]
    for tick, stamp in enumerate(clock):
        assert gate.accept(command(t=stamp), tick / 30) is not None
    assert gate.refused == {}


def test_what_was_obeyed_last_is_acknowledged_by_its_number(gate: CommandGate) -> None:
    assert gate.ack is None
    gate.accept(command(master="a", seq=7), 0.0)
    assert gate.ack == 7
    gate.accept(command(HOME[:3], master="a", seq=8), 0.1)
    gate.accept(command(master="b", seq=90), 0.2)
    assert gate.ack == 7
    gate.accept(command(target="collect_start", master="a", seq=9), 0.3)
    assert gate.ack == 9
    gate.accept(command(master="b", seq="x"), 2.0)
    assert (gate.master, gate.ack) == ("b", None)
    gate.accept(command(), 4.0)  # an older client does not number
    assert (gate.master, gate.ack) == ("anonymous", None)


def test_the_first_master_rules_until_it_is_silent_for_a_second(gate: CommandGate) -> None:
    assert gate.accept(command(master="a"), 0.0) is not None
    assert gate.accept(command(master="b"), 0.5) is None
    assert gate.refused == {"other_master": 1}
    assert gate.accept(command(master="a"), 0.9) is not None
    assert gate.accept(command(master="b"), 1.8) is None
    assert gate.accept(command(master="b"), 1.91) is not None
    assert gate.master == "b"
    assert gate.accept(command(master="a"), 2.0) is None
    assert gate.refused == {"other_master": 3}


def test_refused_attempts_of_another_do_not_prolong_nor_end_the_reign(gate: CommandGate) -> None:
    gate.accept(command(master="a"), 0.0)
    for tenth in range(1, 11):
        assert gate.accept(command(master="b"), tenth / 10) is None
    assert gate.accept(command(master="b"), 1.01) is not None


def test_a_client_without_a_name_is_a_master_like_any_other(gate: CommandGate) -> None:
    assert gate.accept(command(), 0.0) is not None
    assert gate.master == "anonymous"
    assert gate.accept(command(master="b"), 0.1) is None
    assert gate.accept(command(), 0.2) is not None


def test_control_words_of_another_client_are_refused(gate: CommandGate) -> None:
    gate.accept(command(master="a"), 0.0)
    assert gate.accept(command(target="collect_start", master="b"), 0.1) is None
    assert gate.refused == {"other_master": 1}


WISH = {"target": "scene_reset", "id": "one", "seed": 7}


def test_a_wish_to_lay_the_bench_passes_where_there_is_one() -> None:
    gate = CommandGate(ROBOT, deadline=0.3, bench=True)
    positions = {"block": [0.1, 0.2, 30.0], "plate": [0.1, 0.37]}
    for arrival, wish, expected in (
        (0.0, WISH, ResetRequest("one", 7, None)),
        (
            2.0,
            WISH | {"positions": None, "master": "first", "t": 1.0, "seq": 3},
            ResetRequest("one", 7, None),
        ),
        (4.0, WISH | {"positions": positions}, ResetRequest("one", 7, positions)),
    ):
        accepted = gate.accept(msgpack_arrays.pack(wish), arrival)
        assert accepted is not None
        assert accepted.reset == expected
        assert accepted.target is accepted.control is None
    assert gate.refused == {}
    assert gate.is_silent(0.0)


def test_a_node_without_a_bench_refuses_the_wish(gate: CommandGate) -> None:
    assert gate.accept(msgpack_arrays.pack(WISH), 0.0) is None
    assert gate.refused == {"no_bench": 1}


@pytest.mark.parametrize(
    "wrong",
    [
        {"id": ""},
        {"id": 3},
        {"id": "x" * 129},
        {"seed": -1},
        {"seed": True},
        {"seed": 1.0},
        {"seed": None},
        {"positions": [1, 2]},
    ],
)
def test_a_wish_of_the_wrong_shape_is_refused(wrong: dict[str, Any]) -> None:
    gate = CommandGate(ROBOT, deadline=0.3, bench=True)
    assert gate.accept(msgpack_arrays.pack(WISH | wrong), 0.0) is None
    assert gate.refused == {"malformed": 1}


def test_the_bench_is_not_laid_for_a_second_client_while_the_first_commands() -> None:
    gate = CommandGate(ROBOT, deadline=0.3, bench=True)
    gate.accept(command(master="first"), 0.0)
    assert gate.accept(msgpack_arrays.pack(WISH | {"master": "second"}), 0.5) is None
    assert gate.refused == {"other_master": 1}


def test_the_drives_are_switched_by_anybody_who_does_not_become_the_master_by_it(gate: CommandGate) -> None:
    gate.accept(command(master="station"), 0.0)
    accepted = gate.accept(command(target="drives_fault", fault="hot", master="hand"), 0.1)
    assert accepted is not None
    assert accepted.switch == DriveSwitch(False, "hot")
    assert (gate.master, gate.refused) == ("station", {})
    assert gate.accept(command(target="drives_fault", fault=7), 0.2) is None
    assert gate.refused == {"malformed": 1}
