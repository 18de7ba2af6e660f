import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from runtime.core.errors import RuntimeFault
from runtime.ipc.command_arguments import (
    LARGEST,
    BenchRequest,
    Checkpoint,
    Nothing,
    RunRequest,
    SetUpRequest,
    read,
)

REFUSED = {
    "an unknown key": (
        SetUpRequest,
        {"polcy": {}},
        "say: polcy = {}: unknown key (did you mean policy?); "
        "allowed here: bench, checkpoint, collect, least, policy, strategy, task",
    ),
    "an unknown key of a table": (
        SetUpRequest,
        {"bench": {"seed": 1, "positons": {"block": [0.0, 0.3, 0.0]}}},
        "say: bench.positons = {'block': [0.0, 0.3, 0.0]}: unknown key (did you mean positions?); "
        "allowed here: choices, factors, id, of, positions, schema_digest, seed",
    ),
    "no table": (SetUpRequest, {"policy": "openpi"}, "say: policy = 'openpi': must be a table"),
    "no seed": (SetUpRequest, {"bench": {}}, "say: bench.seed is missing"),
    "a seed below zero": (SetUpRequest, {"bench": {"seed": -1}}, "say: bench.seed = -1: "),
    "a seed that a browser cannot count": (SetUpRequest, {"bench": {"seed": 2**53}}, "say: bench.seed = "),
    "a seed that is a truth": (SetUpRequest, {"bench": {"seed": True}}, "say: bench.seed = True: "),
    "a place of one number": (
        SetUpRequest,
        {"bench": {"seed": 1, "positions": {"block": [1]}}},
        "say: bench.positions.block = [1]: List should have at least 2 items",
    ),
    "a place that is nowhere": (
        SetUpRequest,
        {"bench": {"seed": 1, "positions": {"plate": [0.1, float("nan")]}}},
        "say: bench.positions.plate.1 = nan: ",
    ),
    "an array in a table": (
        SetUpRequest,
        {"policy": {"a": [np.zeros(2)]}},
        "say: policy.a.0 = array([0., 0.]): input was not a valid JSON value",
    ),
    "no end": (RunRequest, {"duration_s": 0}, "say: duration_s = 0: Input should be greater than 0"),
    "an infinite time": (RunRequest, {"duration_s": float("inf")}, "say: duration_s = inf: "),
    "a time in words": (RunRequest, {"duration_s": "20"}, "say: duration_s = '20': "),
    "an operator without a name": (RunRequest, {"operator": 7}, "say: operator = 7: "),
    "no number in JSON": (RunRequest, {"trial": {"a": {"b": [float("nan")]}}}, "say: trial.a.b.0 = nan: "),
    "bytes": (RunRequest, {"trial": {"a": b"x"}}, "say: trial.a = b'x': input was not a valid JSON value"),
    "too much": (
        RunRequest,
        {"trial": {"a": "x" * LARGEST}},
        f"must be at most {LARGEST} characters of JSON",
    ),
    "a key that is a number": (RunRequest, {7: 1}, "say: 7 = 7: "),
    "a word too many": (Nothing, {"now": True}, "say takes no arguments; given: now"),
}


@pytest.mark.parametrize(("model", "arguments", "sentence"), REFUSED.values(), ids=REFUSED.keys())
def test_what_is_wrong_is_named_with_what_was_given_and_what_is_allowed(model, arguments, sentence):
    with pytest.raises(RuntimeFault) as refused:
        read("say", model, arguments)
    assert sentence in str(refused.value)
    assert len(str(refused.value)) < 1000


def test_a_set_up_without_arguments_changes_nothing():
    asked = read("setup", SetUpRequest, {})
    assert asked.changes == {}
    assert (asked.checkpoint, asked.bench) == (None, None)


def test_only_policy_and_task_change_the_deployment():
    asked = read(
        "setup",
        SetUpRequest,
        {
            "policy": {"url": "ws://127.0.0.1:9"},
            "task": "",
            "checkpoint": {"id": 3, "name": "A"},
            "bench": {"id": "r", "seed": 2, "positions": {"block": [0, 0.3, 45]}},
        },
    )
    assert asked.changes == {"policy": {"url": "ws://127.0.0.1:9"}, "task": ""}
    assert asked.checkpoint == Checkpoint(id=3, name="A")
    assert asked.bench == BenchRequest(id="r", seed=2, positions={"block": [0.0, 0.3, 45.0]})


def test_what_is_none_is_absent():
    arguments = {"policy": None, "task": None, "checkpoint": None, "bench": None}
    assert read("setup", SetUpRequest, arguments) == SetUpRequest()
    assert read("run", RunRequest, {"trial": None, "operator": None, "duration_s": None}) == RunRequest()


json_maps = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(2**53), 2**53)
    | st.floats(allow_nan=False, allow_infinity=False)
    | st.text(),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(), inner, max_size=3),
    max_leaves=10,
)


@given(st.dictionaries(st.text(), json_maps, max_size=3))
def test_a_trial_is_kept_as_it_is(trial):
    assert read("run", RunRequest, {"trial": trial}).trial == trial


@given(st.dictionaries(st.text() | st.integers(), json_maps | st.binary(), max_size=3))
def test_whatever_comes_it_is_taken_or_refused_with_a_sentence(arguments):
    for model in (SetUpRequest, RunRequest, Nothing):
        if set(arguments) <= set(model.model_fields):
            assert read("say", model, arguments) == model()
        else:
            with pytest.raises(RuntimeFault, match=r"^say"):
                read("say", model, arguments)
