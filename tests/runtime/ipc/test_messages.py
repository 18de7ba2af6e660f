from dataclasses import MISSING, fields

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from runtime.core.errors import CodecError
from runtime.core.msgpack_arrays import pack, unpack
from runtime.core.sentences import Pattern, Sentence, fixed
from runtime.ipc.messages import (
    Ack,
    BeginEpisode,
    BeginRun,
    Command,
    EndEpisode,
    EndRun,
    EpisodeClosed,
    EpisodeOpened,
    Event,
    ExecutedTick,
    LockGrippers,
    MediaReport,
    MergeResult,
    Message,
    NodeRequest,
    Observed,
    Order,
    PolicyAnswer,
    PolicyAway,
    PostedChunk,
    ReceptionReport,
    RunBegun,
    Tune,
    decode,
    encode,
    event_row,
)

HELD = Pattern("test.messages.held", "{holder} holds it: {why}")
WHY = fixed("test.messages.why", "so it is")
SAID = HELD(holder="ann", why=WHY)
TOLD = {"id": "test.messages.why", "arguments": {}, "text": "so it is"}

Q = np.arange(3, dtype=np.float32)
ROWS = np.arange(6, dtype=np.float64).reshape(2, 3)
TARGETS = np.array([4, -1], np.int64)
MESSAGES = [
    Order(1, "silent"),
    Order(2, "motion", 7, ROWS[0], "going home"),
    PostedChunk(1, 7, 40, ROWS),
    NodeRequest("scene_reset", {"id": "r", "seed": 3}),
    Order(3, "follow", 7, mode="preview"),
    Order(4, "motion", 7, ROWS[0], speed=0.5),
    Tune({"kind": "sync", "execution_horizon": None, "blend_window": "all"}),
    LockGrippers(np.array([np.nan, 0.05])),
    PolicyAway(3, 12.5),
    ExecutedTick(5, 7, 1.25, 1.5, 9, "policy", Q, Q + 1, Q + 2, [1, 2], [0.25, 0.75], ["speed"], False),
    ExecutedTick(5, 0, 1.25, 1.5, 9, "none", Q, None, None, [], [], [], True),
    ExecutedTick(5, 0, 1.25, 1.5, 9, "unknown", Q, None, Q, woke=1.3),
    MergeResult(1, 42, 2, TARGETS),
    MergeResult(1, 42, 2, TARGETS, 3, "late", 7, "rtc", 4, np.array([[42.0, 1.0, 0.25], [42.0, -1.0, 0.75]])),
    Event("refused", "too old", 2.5, 17, {"joint": "left", "ages": [0.5]}),
    BeginEpisode(7, {"uuid": "u", "robot": {"dim": 3}}),
    BeginEpisode(8, None),
    PolicyAnswer(1, 7, 40, ROWS.astype(np.float32), "eef", TARGETS, 81.5),
    EndEpisode("finished", "stopped", {"control": {"ticks": 3}}),
    EpisodeOpened(7, "u", "/data/u", "disk full"),
    EpisodeClosed("u", "/data/u", "finished", "stopped", 240, ""),
    MediaReport(3.5, 12, "u", 1),
    Observed(9, 1.5, {"joints": 1.25}, Q, {"left": 7}, eef=Q + 1, last=True, truth={"success": False}),
    BeginRun(3),
    RunBegun(3),
    EndRun(),
    ReceptionReport(3.5, {"joints": 30.0}, {"malformed": 2}, {"reset": "r"}, {"enabled": True, "faults": []}),
    Command("u", "run", {"a": [1, None]}, "anna", "page", 3, "boot", 12, 99.5),
    Ack("u", "done", "because", ["stop"], "boot", 12, {"qpos": Q}),
]


def same(a, b):
    if isinstance(a, np.ndarray):
        return (
            isinstance(b, np.ndarray)
            and a.dtype == b.dtype
            and np.array_equal(a, b, equal_nan=a.dtype.kind == "f")
        )
    if isinstance(a, dict):
        return a.keys() == b.keys() and all(same(a[key], b[key]) for key in a)
    return type(a) is type(b) and a == b


def test_every_type_of_message_is_tried_here():
    assert {type(message) for message in MESSAGES} == set(Message.__args__)


@pytest.mark.parametrize("message", MESSAGES, ids=lambda message: type(message).__name__)
def test_a_message_comes_back_as_it_was(message):
    back = decode(encode(message))
    assert type(back) is type(message)
    for field in fields(message):
        assert same(getattr(message, field.name), getattr(back, field.name)), field.name


@pytest.mark.parametrize("message", MESSAGES, ids=lambda message: type(message).__name__)
def test_a_missing_field_is_named_and_one_with_a_default_is_filled_in(message):
    content = unpack(encode(message))
    for field in fields(message):
        rest = pack({key: value for key, value in content.items() if key != field.name})
        if field.default is MISSING and field.default_factory is MISSING:
            with pytest.raises(CodecError, match=f"message {type(message).__name__}: .*'{field.name}'"):
                decode(rest)
        elif field.default is not MISSING:
            assert getattr(decode(rest), field.name) == field.default
        else:
            assert getattr(decode(rest), field.name) == field.default_factory()


@pytest.mark.parametrize("message", MESSAGES, ids=lambda message: type(message).__name__)
def test_a_field_of_a_wrong_type_is_named(message):
    content = unpack(encode(message))
    for field in fields(message):
        with pytest.raises(CodecError, match=f"message {type(message).__name__}: {field.name} = "):
            decode(pack(content | {field.name: b"bytes"}))


def test_the_sentence_says_what_was_given_and_what_was_expected():
    with pytest.raises(CodecError, match="message Command: epoch = 'x'; expected int or integer"):
        decode(pack({"type": "Command", "uuid": "u", "kind": "run", "epoch": "x"}))


@pytest.mark.parametrize(
    ("content", "field"),
    [
        ({"type": "Order", "number": 1, "kind": "jump"}, "kind = 'jump'; expected silent or hold or"),
        (
            {"type": "ExecutedTick", "step": 1, "source": "magic"},
            "source = 'magic'; expected none or hold or",
        ),
        ({"type": "Ack", "uuid": "u", "status": "maybe"}, "status = 'maybe'; expected accepted or refused"),
    ],
)
def test_a_word_that_is_not_among_those_expected_is_refused(content, field):
    with pytest.raises(CodecError, match=field):
        decode(pack(content))


def test_numbers_of_numpy_are_numbers():
    report = MediaReport(np.float32(0.5), np.int64(3), "", np.int32(0))  # type: ignore[arg-type]
    back = decode(encode(report))
    assert (back.time, back.rows, back.repeated) == (0.5, 3, 0)


def test_a_whole_number_does_for_a_float():
    assert decode(pack({"type": "Event", "kind": "k", "text": "t", "time": 3})).time == 3


def test_fields_of_a_newer_peer_are_ignored():
    content = {"type": "Command", "uuid": "u", "kind": "run", "colour": "red"}
    assert decode(pack(content)) == Command("u", "run")


@pytest.mark.parametrize(
    ("content", "given"),
    [
        ({"type": "Hello"}, "'Hello'"),
        ({"kind": "run"}, "None"),
        ({"type": ["Command"]}, r"\['Command'\]"),
        ({"type": {"a": 1}}, r"\{'a': 1\}"),
        ({"type": 7}, "7"),
        ([1, 2], "'list'"),
        ("Command", "'str'"),
        (None, "'NoneType'"),
    ],
)
def test_an_unknown_message_is_refused_with_the_known_ones(content, given):
    with pytest.raises(CodecError, match=f"message type {given} is unknown; known: Order, PostedChunk"):
        decode(pack(content))


@given(st.binary(max_size=60))
def test_any_bytes_are_a_message_or_a_codec_error(payload):
    try:
        message = decode(payload)
    except CodecError:
        return
    assert isinstance(message, Message)


JSON = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**63), 2**64 - 1) | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=6,
)


@given(st.fixed_dictionaries({}, optional={field.name: JSON for field in fields(Command)}))
def test_a_command_that_is_let_in_has_fields_one_can_work_with(content):
    try:
        command = decode(pack(content | {"type": "Command"}))
    except CodecError:
        return
    assert isinstance(command.uuid, str)
    assert isinstance(command.kind, str)
    assert isinstance(command.args, dict)
    assert isinstance(command.epoch, int)
    assert (command.valid_until < 0) in (True, False)
    assert hash((command.uuid, command.kind, command.user, command.holder, command.boot))


def test_an_event_as_a_line_of_the_log_has_all_of_its_fields():
    event = Event("refused", "too old", 2.5, 17, {"joint": "left"})
    assert event_row(event) == {
        "kind": "refused",
        "text": "too old",
        "time": 2.5,
        "step": 17,
        "data": {"joint": "left"},
    }


@pytest.mark.parametrize(
    ("message", "field"),
    [
        (Event("held", SAID, 1.0), "text"),
        (Ack("u", "refused", SAID), "reason"),
        (EndEpisode("failed", SAID), "reason"),
        (EpisodeOpened(1, "u", "/data/u", SAID), "error"),
        (EpisodeClosed("u", "/data/u", "failed", SAID, 3), "reason"),
    ],
)
def test_a_sentence_keeps_its_id_and_arguments_over_the_wire(message: Message, field: str) -> None:
    assert (message.id, message.arguments) == (SAID.id, {"holder": "ann", "why": TOLD})
    there = unpack(encode(message))
    assert (there[field], there["id"], there["arguments"]["why"]) == ("ann holds it: so it is", SAID.id, TOLD)
    again = decode(encode(message))
    said = getattr(again, field)
    assert isinstance(said, Sentence)
    assert (again, said.id, said.arguments["why"].id) == (message, SAID.id, WHY.id)
    assert decode(encode(again)) == message


def test_messages_of_before_have_no_id_and_a_wrong_one_is_refused() -> None:
    said = {"type": "Event", "kind": "held", "text": "so", "time": 1.0}
    event = decode(pack(said))
    assert isinstance(event, Event)
    assert (event.id, event.arguments, type(event.text)) == ("", {}, str)
    assert "id" not in event_row(event)
    assert event_row(Event("held", SAID, 1.0))["arguments"]["why"] == TOLD
    for wrong in (
        {"id": "No Id"},
        {"id": "a.b", "arguments": {"x": [1]}},
        {"id": 3},
        {"id": "a.b", "arguments": 3},
    ):
        with pytest.raises(CodecError, match="Event"):
            decode(pack(said | wrong))
