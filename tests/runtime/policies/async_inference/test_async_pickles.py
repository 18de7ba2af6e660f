from __future__ import annotations

import contextlib
import json
import os
import pickle
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from runtime.core.errors import CodecError
from runtime.policies.async_inference.pickles import (
    MODULES,
    RemotePolicyConfig,
    TimedObservation,
    dump,
    load_actions,
)

VECTORS = Path(__file__).parents[2] / "vectors"
REPLIES = ["lerobot_timed_actions_views", "lerobot_timed_actions_clones", "lerobot_real_server_reply"]
LIMIT = 1 << 20
HELPERS = MODULES["0.4"]


def vector(name: str) -> bytes:
    return (VECTORS / f"{name}.bin").read_bytes()


def named(module: str, name: str) -> bytes:
    return f"c{module}\n{name}\n".encode()


def text(word: str) -> bytes:
    return b"X" + struct.pack("<I", len(word)) + word.encode()


def test_an_observation_has_the_bytes_of_the_real_client() -> None:
    picture = np.arange(12, dtype=np.uint8).reshape(2, 2, 3)
    values = {"shoulder.pos": 0.5, "gripper.pos": 1.0, "cam": picture, "task": "pick"}
    made = dump(TimedObservation(1700000000.25, 7, values, must_go=True), HELPERS)
    assert made == vector("lerobot_timed_observation")


def test_instructions_have_the_bytes_of_the_real_client() -> None:
    names = ["shoulder.pos", "gripper.pos"]
    features = {"observation.state": {"dtype": "float32", "shape": (2,), "names": names}}
    made = dump(RemotePolicyConfig("act", "user/ckpt", features, 10), HELPERS)
    assert made == vector("lerobot_remote_policy_config")


def test_the_earlier_version_has_its_classes_elsewhere() -> None:
    made = dump(RemotePolicyConfig("act", "a", {}, 1), MODULES["0.3"])
    assert b"lerobot.scripts.server.helpers" in made


@pytest.mark.parametrize("name", REPLIES[:2])
def test_recorded_actions_are_read_each_from_its_own_place(name: str) -> None:
    actions = load_actions(vector(name), LIMIT)
    assert [one.timestep for one in actions] == [7, 8, 9][: len(actions)]
    rows = np.arange(6, dtype=np.float32).reshape(3, 2) / 4
    np.testing.assert_array_equal([one.action for one in actions], rows[: len(actions)])
    assert actions[0].timestamp == 1700000000.25


def test_the_answer_of_the_real_server_is_read() -> None:
    actions = load_actions(vector("lerobot_real_server_reply"), LIMIT)
    assert [one.timestep for one in actions] == list(range(7, 17))
    times = np.array([one.timestamp for one in actions])
    np.testing.assert_allclose(np.diff(times), 0.1, atol=1e-6)
    rows = np.stack([one.action for one in actions])
    assert rows.shape == (10, 6)
    assert rows.dtype == np.float32
    np.testing.assert_allclose(rows[0, :3], [-1.3516188859939575, -0.3103742301464081, 0.29578861594200134])
    np.testing.assert_allclose(rows[1, :2], [-1.3316706418991089, -0.4399394392967224])
    assert not rows[:, 3:].any()


def hostile() -> list[tuple[bytes, str]]:
    begin = b"\x80\x04"
    action = named(HELPERS, "TimedAction") + b")\x81"
    nothing = named("torch._utils", "_rebuild_tensor_v2")
    return [
        (
            begin + named("os", "system") + b"(" + text("true") + b"tR.",
            "names os.system is refused; allowed: coll",
        ),
        (begin + named("builtins", "eval") + b"(" + text("1") + b"tR.", "names builtins.eval"),
        (begin + text("builtins") + text("exec") + b"\x93.", "names builtins.exec"),
        (begin + named("torch", "FloatStorage") + b".", "names torch.FloatStorage"),
        (begin + named("torch.storage", "_load_from_bytes.__globals__") + b".", "refused"),
        (begin + nothing + b"}" + text("make") + b"Ns}b.", "changes dict is refused"),
        (begin + nothing + b"(" + text("__defaults__") + b"Ndb.", "unknown|KeyError|refused"),
        (begin + nothing + b"}b.", "changes _Name is refused"),
        (begin + text("x") + b")R.", "calls str is refused"),
        (begin + action + b")R.", "calls _Record is refused"),
        (begin + named(HELPERS, "TimedAction") + b")R.", "calls _Name is refused"),
        (begin + nothing + b")\x81.", "makes _Name is refused"),
        (begin + named(HELPERS, "TimedAction") + b"(Nt\x81.", "makes _Name is refused"),
        (begin + action + b"Nb.", "changes _Record is refused"),
        (begin + b"]" + action + b"a.", "expected timestamp float"),
        (begin + b"]Na.", "expected timestamp float"),
        (begin + b"}.", "expected a list of TimedAction"),
        (begin + nothing + b"(NNNNt" + b"R.", "not made of a storage"),
        (begin + named("torch.storage", "_load_from_bytes") + b"(" + text("x") + b"tR.", "expected bytes"),
        (pickle.dumps(os.system), "posix.system"),
        (pickle.dumps([1]).replace(b"K\x01", b"P7\n"), "KeyError|no pickle"),
        (begin + b"\x96" + struct.pack("<Q", 1 << 40) + b".", "no pickle"),
        (begin + b"r\xff\xff\xff\xff.", "no pickle"),
        (b"", "no pickle"),
        (b"\x80\x09.", "no pickle"),
    ]


@pytest.mark.parametrize(("data", "says"), hostile(), ids=range(len(hostile())))
def test_whatever_could_act_is_refused_by_name(data: bytes, says: str) -> None:
    with pytest.raises(CodecError, match=says):
        load_actions(data, LIMIT)


def test_pickled_instances_of_any_class_run_nothing() -> None:
    class Bomb:
        def __reduce__(self) -> Any:
            return (pytest.fail, ("it was unpickled",))

    for protocol in (2, 3, 4, 5):
        with pytest.raises(CodecError, match=r"names .*_Fail is refused"):
            load_actions(pickle.dumps([Bomb()], protocol), LIMIT)


def test_what_is_too_long_is_refused_unread() -> None:
    with pytest.raises(CodecError, match="exceed the limit of 3"):
        load_actions(b"1234", 3)


def test_a_message_leaves_nothing_behind_for_the_next() -> None:
    harm = b"\x80\x04" + named("torch._utils", "_rebuild_tensor_v2") + b"N}" + text("make") + b"Ns\x86b."
    with pytest.raises(CodecError):
        load_actions(harm, LIMIT)
    assert len(load_actions(vector("lerobot_timed_actions_views"), LIMIT)) == 3


@given(st.binary(max_size=200))
def test_random_bytes_are_an_error(data: bytes) -> None:
    with contextlib.suppress(CodecError):
        assert load_actions(b"\x80\x04" + data, LIMIT) == []


@given(st.data(), st.sampled_from(REPLIES))
def test_cut_and_bent_answers_are_actions_or_an_error(data: Any, name: str) -> None:
    payload = bytearray(vector(name))
    del payload[data.draw(st.integers(0, len(payload))) :]
    for place in data.draw(st.lists(st.integers(0, max(0, len(payload) - 1)), max_size=3)):
        if payload:
            payload[place] = data.draw(st.integers(0, 255))
    with contextlib.suppress(CodecError):
        assert len(load_actions(bytes(payload), LIMIT)) <= 10


def test_the_recorded_names_are_all_that_is_allowed() -> None:
    with pytest.raises(CodecError) as refused:
        load_actions(b"\x80\x04" + named("os", "system") + b".", LIMIT)
    allowed = str(refused.value).partition("allowed: ")[2].split(", ")
    assert json.dumps(sorted(allowed)) == json.dumps(
        [
            "collections.OrderedDict",
            "lerobot.async_inference.helpers.TimedAction",
            "lerobot.scripts.server.helpers.TimedAction",
            "torch._utils._rebuild_tensor_v2",
            "torch.storage._load_from_bytes",
        ]
    )
