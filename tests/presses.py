"""Messages that say that they press the e-stop, with all kinds of things wrong in them: every door presses for each."""

from __future__ import annotations

import json
from typing import Any

import msgpack  # type: ignore[import-untyped]
from hypothesis import strategies as st

from runtime.ipc.messages import Command, encode

LONG = "y" * 70_000
WHOLE = encode(Command("u", "estop", {"why": "smoke"}, "ann", "ann"))
_FIELDS = {"type": "Command", "uuid": "u", "kind": "estop", "args": {"why": "smoke"}, "user": "ann"}


def _packed(**changes: Any) -> bytes:
    made: bytes = msgpack.packb(_FIELDS | changes)
    return made


PACKED = {
    "args is a list": _packed(args=[]),
    "args is nothing": _packed(args=None),
    "a why that is a number": _packed(args={"why": 7}),
    "a why of 70 KB": _packed(args={"why": LONG}),
    "a why of broken UTF-8": WHOLE.replace(b"smoke", b"\xff\xfe\xfd\xfc\xfb"),
    "a key of args that is a list": WHOLE.replace(b"\xa3why\xa5smoke", b"\x91\xa2no\xa5smoke"),
    "an epoch that is a text": _packed(epoch="one"),
    "an epoch of no range": _packed(epoch=-1, sequence=[], valid_until="never"),
    "a boot that is a table": _packed(boot={}),
    "a user that is a number": _packed(user=5, holder=[], role=None),
    "a user of 70 KB": _packed(user=LONG),
    "an unknown key": _packed(colour="red", nested={"a": [1, {"b": None}]}),
    "no uuid": msgpack.packb({"type": "Command", "kind": "estop"}),
    "a uuid that is a number": _packed(uuid=5),
    "a uuid that is empty": _packed(uuid=""),
    "a uuid of 70 KB": _packed(uuid=LONG),
    "no type": msgpack.packb({"kind": "estop"}),
    "another type": _packed(type="Ack"),
    "a type that is a number": _packed(type=3),
    "binary keys": msgpack.packb({key.encode(): value for key, value in _FIELDS.items()}),
    "a binary name": _packed(kind=b"estop"),
    "a name in a list": _packed(kind=["estop"]),
    "its name last, behind 200 KB": msgpack.packb({"pad": "x" * 200_000, "kind": "estop"}),
    "another kind too": bytes([WHOLE[0] + 1]) + WHOLE[1:] + b"\xa4kind\xa4stop",
    "half of it": WHOLE[: WHOLE.index(b"estop") + 5],
    "bytes behind it": WHOLE + b"\xc1\xff",
    "a list around it": msgpack.packb([_FIELDS]),
    "a map around it": msgpack.packb({"command": _FIELDS}),
    "JSON": json.dumps(_FIELDS).encode(),
    "an array of another dialect": _packed(x={b"nd": True}),
    "nested 5,000 deep": _packed()[:-1] + b"\x91" * 5000,
}
# A message of another kind, though the word is in it: no press.
OTHERS = {
    "a question about it": encode(Command("u", "status", {"kind": "estop"})),
    "a note about it": encode(Command("u", "label", {"note": "then kind estop was pressed"})),
    "a question whose name comes last": msgpack.packb({"args": {"kind": "estop"}, "kind": "status"}),
}


@st.composite
def packed(draw: st.DrawFn) -> bytes:
    """A press with anything at all instead of, beside, before and behind what belongs into it, cut off anywhere."""
    values = st.recursive(
        st.none() | st.booleans() | st.integers(-(2**63), 2**64 - 1) | st.floats() | st.text() | st.binary(),
        lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
        max_leaves=8,
    )
    keys = st.sampled_from([*_FIELDS, "epoch", "boot", "valid_until", "vouched"]) | st.text(max_size=6)
    said = draw(st.dictionaries(keys.filter(lambda key: key != "kind"), values, max_size=6))
    items = list(said.items())
    items.insert(draw(st.integers(0, len(items))), ("kind", "estop"))
    whole: bytes = msgpack.packb(dict(items))
    mark = b"\xa4kind\xa5estop"
    cut = draw(st.integers(whole.index(mark) + len(mark), len(whole)))
    return whole[:cut] + draw(st.binary(max_size=20))


def in_json(key: str, name: str = "estop") -> dict[str, str]:
    """Messages of a door whose messages say what they are under `key`."""
    quoted, word = json.dumps(key), json.dumps(name)
    escaped = "".join(f"\\u{ord(letter):04x}" for letter in name)
    return {
        "plain": f"{{{quoted}: {word}}}",
        "escaped": f'{{{quoted}: "{escaped}"}}',
        "an escaped key": f'{{"\\u{ord(key[0]):04x}{key[1:]}": {word}}}',
        "a why of 70 KB": json.dumps({key: name, "why": LONG}),
        "a why that is a list": json.dumps({key: name, "why": [], "args": {"why": {}}}),
        "odd everything": json.dumps(
            {key: name, "uuid": 7, "args": [], "epoch": "x", "page": None, "arguments": 3}
        ),
        "a uuid that is none": json.dumps({key: name, "uuid": "mine", "id": "mine", "client": "!"}),
        "an unknown key": json.dumps({key: name, "colour": "red"}),
        "said twice": f'{{{quoted}: {word}, {quoted}: "status"}}',
        "garbage behind it": f"{{{quoted}: {word}}} and more",
        "half of it": f'{{{quoted}: {word}, "why": "smo',
        "no comma": f'{{{quoted}: {word} "why": 1}}',
        "nested too deeply": f'{{{quoted}: {word}, "x": ' + "[" * 20_000,
        "a number that is none": f'{{{quoted}: {word}, "x": NaN}}',
        "a number without end": f'{{{quoted}: {word}, "x": {"9" * 5000}}}',
        "a list around it": f"[{{{quoted}: {word}}}]",
        "a text around it": json.dumps(f"{{{quoted}: {word}}}"),
        "a lone surrogate": f'{{{quoted}: {word}, "why": "\\ud800"}}',
        "a byte order mark": f"\ufeff{{{quoted}: {word}}}",
        "single quotes": f"{{'{key}': '{name}'}}",
        "a form": f"{key}={name}&why=smoke",
        "white space": f" \n{{ {quoted} :\t{word} }}\r\n",
    }


def json_texts(key: str, name: str = "estop") -> st.SearchStrategy[str]:
    """A press with anything at all beside it, cut off anywhere behind its name."""
    values = st.recursive(
        st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=20),
        lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
        max_leaves=8,
    )
    names = st.sampled_from(["uuid", "why", "args", "epoch", "page", "id", "client"]) | st.text(max_size=6)
    others = st.dictionaries(names.filter(lambda other: other != key), values, max_size=5)

    @st.composite
    def made(draw: st.DrawFn) -> str:
        items = list(draw(others).items())
        items.insert(draw(st.integers(0, len(items))), (key, name))
        mark = json.dumps({key: name})[1:-1]
        whole = json.dumps(dict(items), ensure_ascii=draw(st.booleans()))
        return whole[: draw(st.integers(whole.index(mark) + len(mark), len(whole)))] + draw(
            st.text(max_size=9)
        )

    return made()
