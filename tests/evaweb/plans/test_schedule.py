import json
from collections import Counter
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from evaweb.core.canonical_json import canonical, difference, digest
from evaweb.core.errors import EvaError
from evaweb.plans.commitment import draw_codes, make_commitment, verify_commitment
from evaweb.plans.schedule import IMBALANCE, RANDOM, Condition, counts_of, schedule
from evaweb.plans.seeded_draws import SeededDraws, new_key

KEY = bytes(range(32))
JSON = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**53), 2**53) | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=3), inner, max_size=3),
    max_leaves=8,
)
DOCUMENTS = st.dictionaries(st.text(max_size=4), JSON, max_size=4)


def conditions(n):
    return [Condition("cups", i + 1) for i in range(n)]


def test_the_canonical_form_knows_no_order_and_no_space():
    assert canonical({"b": [1, 2.0, 0.5], "a": "ü"}) == '{"a":"ü","b":[1,2,0.5]}'.encode()
    assert digest({"a": 1, "b": 2}) == digest({"b": 2, "a": 1.0})
    assert digest({"a": True}) != digest({"a": 1})


@given(DOCUMENTS)
def test_what_was_written_and_read_has_the_same_digest_and_no_difference(document):
    again = json.loads(canonical(document))
    assert digest(again) == digest(document)
    assert difference(document, again) == []


@given(DOCUMENTS, DOCUMENTS)
def test_two_plans_differ_just_where_their_digests_do(one, other):
    assert (difference(one, other) == []) == (digest(one) == digest(other))


def test_a_difference_says_where():
    old = {"trials": 10, "scenes": ["cups", "plates"], "rule": {"alpha": 0.05}}
    new = {"trials": 20, "scenes": ["cups"], "rule": {"alpha": 0.05, "stop": True}}
    assert difference(old, new) == [
        "rule.stop: new, true",
        'scenes[1]: gone, was "plates"',
        "trials: 10 -> 20",
    ]


@pytest.mark.parametrize(
    ("document", "said"),
    [
        ({"a": {"b": float("nan")}}, "a.b = nan"),
        ({"a": [object()]}, r"a\[0\] is a object"),
        ({"a": {1: 2}}, "a has the key 1"),
    ],
)
def test_what_has_no_canonical_form_is_named(document, said):
    with pytest.raises(EvaError, match=said):
        canonical(document)


def test_draws_stay_what_they_are_for_ever():
    """A change of these numbers would change every schedule that was committed to."""
    chance = SeededDraws(KEY, "example")
    assert [chance.below(10) for _ in range(8)] == [1, 7, 9, 1, 8, 2, 7, 4]
    assert SeededDraws(KEY, "example").shuffled("abcdef") == list("baefcd")


def test_draws_are_uniform_and_independent_of_each_other():
    counts = Counter(SeededDraws(KEY, f"trial {i}").below(3) for i in range(3000))
    assert all(900 < counts[i] < 1100 for i in range(3))
    orders = Counter(tuple(SeededDraws(KEY, f"order {i}").shuffled("abc")) for i in range(1200))
    assert len(orders) == 6
    assert min(orders.values()) > 140


@given(st.integers(1, 5), st.integers(1, 6), st.integers(1, 4), st.binary(min_size=32, max_size=32))
def test_every_checkpoint_meets_every_condition_equally_often_in_blocks(k, n, repetitions, key):
    names = [f"policy {i}" for i in range(k)]
    units = schedule(checkpoints=names, conditions=conditions(n), repetitions=repetitions, key=key)
    assert [u.index for u in units] == list(range(k * n * repetitions))
    cells = Counter((u.checkpoint, u.condition) for u in units)
    assert set(cells.values()) == {repetitions}
    assert len(cells) == k * n
    for start in range(0, len(units), k):
        block = units[start : start + k]
        assert {u.checkpoint for u in block} == set(names)
        assert len({(u.block, u.condition, u.repetition) for u in block}) == 1
    for start in range(0, len(units), k * n):
        assert {u.condition for u in units[start : start + k * n]} == set(conditions(n))


@given(st.integers(2, 5), st.binary(min_size=32, max_size=32))
def test_in_as_many_blocks_as_checkpoints_each_comes_once_at_each_place(k, key):
    names = [f"policy {i}" for i in range(k)]
    units = schedule(
        checkpoints=names, conditions=conditions(2 * k), repetitions=1, key=key, latin=True
    )  # plans of format 5 and before
    for start in range(0, len(units), k * k):
        places = Counter((u.checkpoint, u.place) for u in units[start : start + k * k])
        assert set(places.values()) == {1}


def test_what_ran_before_says_nothing_of_the_order_within_a_block():
    """Of three checkpoints each order follows each as often as any, within four standard errors."""
    units = schedule(checkpoints=["a", "b", "c"], conditions=conditions(40), repetitions=90, key=KEY)
    orders = ["".join(u.checkpoint for u in units[i : i + 3]) for i in range(0, len(units), 3)]
    follow = Counter(pairwise(orders))
    assert len(follow) == 36
    assert all(abs(count - 100) < 40 for count in follow.values())


def test_the_same_key_gives_the_same_schedule_and_another_another():
    def made(key):
        return schedule(checkpoints=["a", "b"], conditions=conditions(5), repetitions=4, key=key)

    assert made(KEY) == made(KEY)
    assert made(KEY) != made(new_key())


@pytest.mark.parametrize(
    ("given_", "said"),
    [
        ({"checkpoints": []}, "no checkpoint"),
        ({"checkpoints": ["a", "a"]}, "checkpoint a is named twice"),
        ({"conditions": []}, "no condition"),
        ({"repetitions": 0}, "repetitions = 0"),
        ({"repetitions": 10_001}, "allowed: 20000"),
    ],
)
def test_plans_that_cannot_be_carried_out_are_refused(given_, said):
    plan = {"checkpoints": ["a", "b"], "conditions": conditions(1), "repetitions": 1, "key": KEY} | given_
    with pytest.raises(EvaError, match=said):
        schedule(**plan)


def test_each_trial_has_a_code_of_its_own():
    found = draw_codes(KEY, 3000)
    assert len(set(found)) == 3000
    assert all(len(code) == 5 and not set(code) & set("0O1I") for code in found)
    assert draw_codes(KEY, 10) == found[:10]
    assert draw_codes(new_key(), 10) != found[:10]


def test_a_commitment_holds_plan_schedule_and_key():
    units = schedule(checkpoints=["a", "b"], conditions=conditions(3), repetitions=1, key=KEY)
    other = schedule(checkpoints=["a", "b"], conditions=conditions(3), repetitions=1, key=new_key())
    plan = digest({"name": "cups"})
    committed = make_commitment(plan, units, KEY)
    assert verify_commitment(plan, units, KEY, committed)
    assert not verify_commitment(digest({"name": "cup"}), units, KEY, committed)
    assert not verify_commitment(plan, units, bytes(32), committed)
    assert other == units or not verify_commitment(plan, other, KEY, committed)
    with pytest.raises(EvaError, match="a key of 3 bytes; allowed: 32"):
        make_commitment(plan, units, b"abc")


# --- random order ---------------------------------------------------------------------------------------------


def in_random_order(n, repetitions, key=KEY):
    return schedule(
        checkpoints=["a", "b"], conditions=conditions(n), repetitions=repetitions, key=key, allocation=RANDOM
    )


@given(st.integers(1, 6), st.integers(5, 20), st.binary(min_size=32, max_size=32))
def test_in_random_order_no_checkpoint_is_far_ahead_at_any_condition(n, repetitions, key):
    units = in_random_order(n, repetitions, key)
    ahead = Counter()
    for unit in units:
        ahead[unit.condition] += 1 if unit.checkpoint == "a" else -1
        assert abs(ahead[unit.condition]) <= IMBALANCE
    assert Counter(unit.block for unit in units) == Counter(dict.fromkeys(range(n * repetitions), 2))
    named = {(unit.condition, unit.repetition) for unit in units}
    assert len(named) == len(units)  # a number says nothing of the checkpoint
    counts = counts_of(units, ["a", "b"])
    assert counts[-1] == tuple(Counter(unit.checkpoint for unit in units)[name] for name in "ab")
    assert units == in_random_order(n, repetitions, key)


def test_of_two_checkpoints_in_random_order_what_was_tells_little_of_what_comes():
    """Somebody who recognises both and guesses the one that is behind is right in 58 of 100 trials; 75 in pairs."""
    right = made = 0
    for seed in range(40):
        ahead = Counter()
        for unit in in_random_order(5, 20, bytes([seed]) * 32):
            step = 1 if unit.checkpoint == "a" else -1
            behind = -ahead[unit.condition]
            right += 0.5 if behind == 0 else float(behind * step > 0)
            made += 1
            ahead[unit.condition] += step
    assert 0.55 < right / made < 0.61
