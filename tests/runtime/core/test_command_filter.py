from __future__ import annotations

import numpy as np
import pytest

from runtime.core import msgpack_arrays
from runtime.core.command_filter import CommandFilter


def message(**fields: object) -> bytes:
    return msgpack_arrays.pack({"t": 1.0, "action": np.array([9.0, -9.0], np.float32), **fields})


def test_without_limits_any_finite_target_of_the_dimension_is_accepted_and_acknowledged() -> None:
    commands = CommandFilter(2, deadline=0.3)
    target = commands.accept_target(message(master="a", seq=7), 10.0)
    assert target is not None
    assert target.tolist() == [9.0, -9.0]
    assert (commands.master, commands.ack, commands.is_silent(10.2)) == ("a", 7, False)


def test_with_one_clock_even_the_first_command_of_a_master_is_stale() -> None:
    other, same = CommandFilter(2, deadline=0.3), CommandFilter(2, deadline=0.3, same_clock=True)
    assert other.accept_target(message(), 10.0) is not None
    assert same.accept_target(message(), 10.0) is None
    assert same.refused == {"stale": 1}
    assert same.accept_target(message(), 1.2) is not None
    assert same.sent == 1.0


@pytest.mark.parametrize("stamp", [None, "1.0", float("nan"), 11.0])
def test_with_one_clock_a_stamp_that_is_absent_or_of_the_future_is_refused(stamp: object) -> None:
    same = CommandFilter(2, deadline=0.3, same_clock=True)
    assert same.accept_target(message(t=stamp), 10.0) is None
    assert same.refused == {"stale": 1}


@pytest.mark.parametrize(("target", "refused"), [("sim", {}), ("hil_start", {"unknown_target": 1})])
def test_a_message_that_is_not_for_the_robot_is_no_target(target: str, refused: dict[str, int]) -> None:
    commands = CommandFilter(2, deadline=0.3)
    assert commands.accept_target(message(target=target, seq=1), 10.0) is None
    assert commands.refused == refused
    assert commands.ack is None
    assert commands.is_silent(10.0)
