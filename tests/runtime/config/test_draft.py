"""What there is to choose for a first deployment, and the text that comes of it."""

import tomllib

import pytest
from hypothesis import given
from hypothesis import strategies as st

from runtime.config import draft
from runtime.core.errors import ConfigurationError

NAMES = st.text(st.characters(codec="utf-8", exclude_characters="\x7f"), min_size=1, max_size=8)
VALUES = st.one_of(
    st.booleans(),
    st.integers(-(2**53), 2**53),
    st.text(st.characters(codec="utf-8", exclude_characters="\x7f")),
)
TREES = st.recursive(
    st.dictionaries(NAMES, st.one_of(VALUES, st.lists(st.text('ab"\\', max_size=3), max_size=3)), max_size=3),
    lambda inner: st.dictionaries(NAMES, st.one_of(VALUES, inner), max_size=3),
    max_leaves=10,
)


@pytest.mark.parametrize("part", draft.PACKAGES)
def test_every_kind_says_what_it_is_and_what_may_be_said_of_it(part):
    for kind, what in draft.kinds(part).items():
        assert what.endswith(".")
        for entry in draft.entries(part, kind):
            assert entry.meaning, (kind, entry.key)
            assert entry.type in ("text", "whole", "number", "yes", "choice")
            assert entry.key != "kind"


def test_an_entry_is_as_the_model_says():
    found = {entry.key: entry for entry in draft.entries("cameras", "v4l2")}
    assert found["device"].required
    assert (found["device"].type, found["device"].default, found["device"].address) == ("text", "", True)
    assert (found["frame_rate"].type, found["frame_rate"].default) == ("number", "")
    assert found["rotate"].choices == ("0", "90", "180", "270")
    assert "crop" not in found  # a list: for an editor
    frozen = {entry.key: entry for entry in draft.entries("transport", "zmq")}["detect_frozen"]
    assert (frozen.type, frozen.default) == ("yes", "yes")


def test_a_table_has_what_was_typed_with_its_type_and_nothing_that_is_so_anyway():
    typed = {
        "device": " /dev/video2 ",
        "rotate": "90",
        "frame_rate": "29.97",
        "open_s": "5.0",
        "read_s": "",
        "x": "y",
    }
    assert draft.table("cameras", "v4l2", typed) == {
        "kind": "v4l2",
        "device": "/dev/video2",
        "rotate": 90,
        "frame_rate": 29.97,
    }


@pytest.mark.parametrize(
    ("typed", "said"),
    [
        ({"frame_rate": "fast"}, "frame_rate = 'fast'; allowed: a number"),
        ({"rotate": "45"}, "rotate = '45'; allowed: 0, 90, 180, 270"),
    ],
)
def test_what_is_of_no_such_type_is_named_with_what_is_allowed(typed, said):
    with pytest.raises(ConfigurationError, match=said):
        draft.table("cameras", "v4l2", typed)


def test_a_kind_that_there_is_not_is_named_with_those_there_are():
    with pytest.raises(
        ConfigurationError, match=r"transport.kind = 'pigeon'; allowed: dataset, lerobot, ros1, ros2, zmq"
    ):
        draft.entries("transport", "pigeon")


@given(TREES)
def test_the_text_says_what_the_tables_do(tree):
    assert tomllib.loads(draft.text_of(tree, ["a comment"])) == tree
