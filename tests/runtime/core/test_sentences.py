"""Sentences with ids: English as it ever was, arguments that travel, and nothing else of what comes off a wire."""

import ast
import copy
import json
import pickle
from enum import StrEnum

import numpy as np
import pytest

from runtime.core import sentences
from runtime.core.errors import RuntimeFault
from runtime.core.msgpack_arrays import pack, unpack
from runtime.core.sentences import Pattern, Sentence, fixed
from tests.sources import ROOT

HELD = Pattern("test.held", "{holder} holds it for {seconds:.1f} s")
REFUSED = Pattern("test.refused", "{command!r} was refused: {why}")
READY = fixed("test.ready", "ready")


class Word(StrEnum):
    READY = "ready"
    PLAIN = "plain"

    @property
    def sentence(self):
        return READY if self is Word.READY else self.value


def test_a_sentence_is_its_english_and_knows_what_it_is_made_of():
    said = HELD(holder="ann", seconds=np.float32(2.25))
    assert (said, said.id, said.arguments) == (
        "ann holds it for 2.2 s",
        "test.held",
        {"holder": "ann", "seconds": 2.25},
    )
    assert isinstance(str(RuntimeFault(said)), Sentence)
    assert type(said + "") is type(sentences.plain(said)) is str
    for again in (copy.deepcopy(said), pickle.loads(pickle.dumps(said))):
        assert (again, again.id, again.arguments) == (said, said.id, said.arguments)
    assert json.loads(json.dumps(said)) == unpack(pack(said)) == said


def test_a_sentence_within_a_sentence_travels_whole():
    said = REFUSED(command="run", why=HELD(holder="ann", seconds=2))
    there = unpack(pack(sentences.to_wire(said)))
    assert there["arguments"]["why"] == {
        "id": "test.held",
        "arguments": {"holder": "ann", "seconds": 2},
        "text": "ann holds it for 2.0 s",
    }
    heard = sentences.from_wire(there["text"], there["id"], there["arguments"])
    assert (heard, sentences.identity(heard)) == (said, sentences.identity(said))


@pytest.mark.parametrize(
    ("given", "told"),
    [
        (Word.READY, READY),
        (Word.PLAIN, "plain"),
        (np.int64(3), 3),
        (2**60, str(2**60)),
        (float("nan"), "nan"),
        (True, "True"),
        (RuntimeFault(READY), READY),
        (None, "None"),
    ],
)
def test_an_argument_is_what_can_travel(given, told):
    argument = REFUSED(command="run", why=given).arguments["why"]
    assert (argument, type(argument)) == (told, type(told))


def test_what_is_nested_too_deep_keeps_its_english():
    said = sentences.series([f"part {number}" for number in range(30)])
    assert said == "; ".join(f"part {number}" for number in range(30))
    assert sentences.from_wire(str(said), **sentences.identity(said)) == said
    assert sentences.series([]) == ""
    assert sentences.series([READY]) is READY


def test_an_id_is_one_sentence_and_a_call_says_all_of_it():
    assert Pattern("test.held", HELD.english)(holder="a", seconds=1) == HELD(holder="a", seconds=1)
    with pytest.raises(ValueError, match="declared twice"):
        Pattern("test.held", "something else")
    with pytest.raises(TypeError, match="expected"):
        HELD(holder="ann")
    for wrong in ("{0}", "{a.b}", "{a[0]}", "{a!s}", "{a:>10}", "{a:{b}}", "{"):
        with pytest.raises(ValueError, match=r"is no argument|expected '\}'|Single"):
            Pattern("test.wrong", wrong)
    with pytest.raises(ValueError, match="sentence id"):
        Pattern("Wrong", "so")


@pytest.mark.parametrize(
    ("id", "arguments"),
    [
        (3, {}),
        ("no dots", {}),
        ("a." + "b" * 200, {}),
        ("a.b", []),
        ("a.b", {"x": [1]}),
        ("a.b", {"x": None}),
        ("a.b", {"x": float("nan")}),
        ("a.b", {"X!": 1}),
        ("a.b", {"x": {"id": "a.b", "arguments": {}}}),
        ("a.b", {f"x{number}": 1 for number in range(40)}),
    ],
)
def test_what_another_process_says_is_looked_at(id, arguments):
    with pytest.raises(ValueError, match=r"id = |argument"):
        sentences.from_wire("so", id, arguments)
    assert sentences.checked({"reason": {"id": id, "arguments": arguments}, "more": 3}) == {}
    assert sentences.checked_row({"number": 1, "id": id, "arguments": arguments}) == {"number": 1}


def test_deep_arguments_of_another_process_are_none():
    deep: dict = {"id": "a.b", "arguments": {}, "text": "so"}
    for _ in range(12):
        deep = {"id": "a.b", "arguments": {"x": deep}, "text": "so"}
    with pytest.raises(ValueError, match="deep"):
        sentences.from_wire("so", deep["id"], deep["arguments"])


def test_the_texts_of_a_map_are_found_by_where_they_stand():
    tree = {
        "reason": READY,
        "guarded": {"run.now": HELD(holder="a", seconds=1)},
        "stages": [{"name": READY}],
        "n": 1,
    }
    assert {path: one["id"] for path, one in sentences.within(tree).items()} == {
        "reason": "test.ready",
        "guarded.run.now": "test.held",
        "stages.0.name": "test.ready",
    }


@pytest.mark.parametrize(
    ("text", "arguments", "shown"),
    [
        ("ann holds it for 2 s", {"holder": "ann", "seconds": 2}, True),
        ("somebody holds it", {"holder": "ann"}, False),
        ("hidden", {"why": {"id": "a.b", "text": "hidden", "arguments": {"x": "secret"}}}, False),
        ("about 2 s", {"seconds": 2.35}, False),
    ],
)
def test_arguments_go_with_a_text_that_says_as_much(text, arguments, shown):
    assert sentences.shows(text, arguments) is shown


def composed(node):
    """True if it is a text that was written where it is used."""
    return isinstance(node, ast.JoinedStr | ast.BinOp) or (
        isinstance(node, ast.Constant) and bool(node.value)
    )


def events_said(function):
    """The texts that events are given: to `Event(...)`, and to methods that make one of a kind and a text.

    A name stands for what it was given within the function.
    """
    simple = [
        n for n in ast.walk(function) if isinstance(n, ast.Assign) and isinstance(n.targets[0], ast.Name)
    ]
    local = {n.targets[0].id: n.value for n in simple if composed(n.value)}
    for node in ast.walk(function):
        if isinstance(node, ast.Call) and len(node.args) >= 2:
            name = getattr(node.func, "id", getattr(node.func, "attr", ""))
            told = (
                name in ("emit", "_emit", "_event", "_note", "_emit_rate_limited", "say", "_say")
                and len(node.args) == 2
            )
            if name == "Event" or told:
                text = node.args[1]
                yield local.get(text.id, text) if isinstance(text, ast.Name) else text


def functions(path):
    tree = ast.parse(path.read_text("utf-8"))
    return [node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)]


def test_no_event_of_the_runtime_says_a_sentence_without_an_id():
    files = sorted(path for path in (ROOT / "runtime").rglob("*.py") if "sim" not in path.parts)
    said = [(path.name, text) for path in files for made in functions(path) for text in events_said(made)]
    assert len(said) > 60
    assert [f"{name}:{text.lineno}" for name, text in said if composed(text)] == []
    assert all(composed(ast.parse(text, mode="eval").body) for text in ('f"{a} b"', "'a' + b", "'a'"))
