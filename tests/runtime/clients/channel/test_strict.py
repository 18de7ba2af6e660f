import json
import math
from pathlib import Path

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from runtime.clients.channel.json_answers import dumps, to_builtin


def test_what_is_no_number_in_json_is_null():
    content = {"a": math.nan, "b": [math.inf, 1.5], "c": np.array([1.0, -np.inf]), "d": np.float32("nan")}
    assert json.loads(dumps(content)) == {"a": None, "b": [None, 1.5], "c": [1.0, None], "d": None}


def test_what_json_has_stays_as_it_is_and_what_is_foreign_is_its_text():
    assert to_builtin({"a": True, "b": None, "c": (1, "x"), 3: np.int64(4), "p": Path("/x")}) == {
        "a": True,
        "b": None,
        "c": [1, "x"],
        "3": 4,
        "p": "/x",
    }


@given(st.dictionaries(st.text(max_size=5), st.floats() | st.text() | st.lists(st.floats()), max_size=4))
def test_every_map_comes_out_as_json_in_ascii(content):
    assert json.loads(dumps(content).decode("ascii")).keys() == content.keys()
