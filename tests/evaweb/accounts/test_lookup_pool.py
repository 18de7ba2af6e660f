"""Whose turn it is to be looked up."""

from __future__ import annotations

import threading
from collections import Counter

import pytest
from hypothesis import given
from hypothesis import strategies as st

from evaweb.accounts.lookup_pool import FairLookupPool, LookupQueueFull
from tests.processes import PATIENCE_S


class Held:
    """Look-ups of one thread, which is kept busy until all have come."""

    def __init__(self, most):
        self.lookups, self.done = FairLookupPool(1, most), []
        self._free, begun = threading.Event(), threading.Event()
        self._first = self.lookups.submit("first", lambda: begun.set() or self._free.wait(PATIENCE_S))
        assert begun.wait(PATIENCE_S)

    def ask(self, share, name):
        return self.lookups.submit(share, lambda: self.done.append((share, name)))

    def go_on(self, answers):
        self._free.set()
        return [isinstance(answer.exception(60), LookupQueueFull) for answer in answers]


def test_each_share_has_its_turn_and_its_oldest_is_the_first():
    held = Held(most=100)
    asked = [held.ask("crowd", n) for n in range(4)] + [held.ask("a", 0), held.ask("b", 0), held.ask("a", 1)]
    assert not any(held.go_on(asked))
    assert held.done == [("crowd", 0), ("a", 0), ("b", 0), ("crowd", 1), ("a", 1), ("crowd", 2), ("crowd", 3)]


def test_where_there_is_no_room_the_newest_of_the_crowd_gives_way():
    held = Held(most=3)
    crowd = [held.ask("crowd", n) for n in range(4)]
    other = held.ask("a", 0)
    assert held.go_on([*crowd, other]) == [False, False, True, True, False]
    assert held.done == [("crowd", 0), ("a", 0), ("crowd", 1)]


def test_what_fails_fails_for_who_asked_alone():
    lookups = FairLookupPool(1)
    failed, done = lookups.submit("a", lambda: 1 / 0), lookups.submit("a", lambda: 7)
    with pytest.raises(ZeroDivisionError):
        failed.result(PATIENCE_S)
    assert done.result(PATIENCE_S) == 7


@given(st.lists(st.sampled_from("aaaaabcd"), max_size=60), st.integers(1, 12))
def test_whoever_is_turned_away_has_no_fewer_waiting_than_any_other(shares, most):
    held = Held(most)
    asked = [held.ask(share, number) for number, share in enumerate(shares)]
    turned_away = held.go_on(asked)
    waiting = Counter(share for share, _ in held.done)
    assert len(held.done) == min(most, len(shares)) == len(shares) - sum(turned_away)
    crowds = {share for share, away in zip(shares, turned_away, strict=True) if away}
    assert all(waiting[crowd] + 1 >= max(waiting.values()) for crowd in crowds)
    for share in waiting:
        mine = [number for of, number in held.done if of == share]
        assert mine == sorted(mine)
