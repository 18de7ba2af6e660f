from __future__ import annotations

import random

from evaweb.core.fingerprint_cache import FingerprintCache, rounded_sum


def test_what_was_made_is_kept_until_its_fingerprint_changes():
    kept, made = FingerprintCache[int](), iter(range(10))
    assert [kept.get("one", at, lambda: next(made)) for at in (1, 1, 2, 2, 1)] == [0, 0, 1, 1, 2]


def test_the_least_recently_used_is_forgotten():
    kept, made = FingerprintCache[int](most=2), iter(range(10))
    assert [kept.get(key, 0, lambda: next(made)) for key in "abacab"] == [0, 1, 0, 2, 0, 3]


def test_the_order_in_which_numbers_are_added_up_changes_no_fingerprint():
    chance = random.Random(1)
    seconds = [chance.uniform(5, 60) for _ in range(10_000)]
    plain, steadied = set(), set()
    for _ in range(20):
        chance.shuffle(seconds)
        total = 0.0
        for number in seconds:
            total += number
        plain.add(total)
        steadied.add(rounded_sum(total))
    assert len(plain) > 1
    assert len(steadied) == 1
    assert rounded_sum(None) == 0.0
