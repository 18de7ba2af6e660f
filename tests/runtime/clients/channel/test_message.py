import json

import pytest
from hypothesis import given
from hypothesis import strategies as st

from runtime.clients.channel.message import LARGEST, Malformed, read

UUID = "6a1f3c1e-57a1-4f0e-9b43-0a8a0d2f8a11"


def said(**fields):
    return read([json.dumps(fields).encode()])


def test_a_verb_is_told_from_its_argument_at_the_first_colon():
    assert (said(cmd="web:stop").name, said(cmd="web:stop").argument) == ("stop", None)
    message = said(cmd='web:init_move:{"qpos":[1]}')
    assert (message.name, message.argument) == ("init_move", '{"qpos":[1]}')
    assert said(cmd="web:switch_task:").argument == ""


def test_where_both_are_given_the_query_wins():
    message = said(cmd="web:start", query="status")
    assert (message.form, message.name) == ("query", "status")
    assert message.echo == {}


def test_a_command_of_ours_has_arguments_a_client_and_an_id():
    message = said(command="run", arguments={"mode": "step"}, client="bench.py", id=UUID.upper())
    assert (message.form, message.name, message.arguments) == ("command", "run", {"mode": "step"})
    assert (message.client, message.id) == ("bench.py", UUID)
    assert message.echo == {"command": "run"}


def test_further_keys_beside_an_older_verb_are_left_alone():
    assert said(cmd="web:tab_switch:collect", armed=True, whatever=1).fields["armed"] is True


@pytest.mark.parametrize(
    ("frames", "error"),
    [
        ([b"[1, 2]"], "message must be a JSON object"),
        ([b'"web:stop"'], "message must be a JSON object"),
        ([b"{}"], "message must carry 'cmd' or 'query' (or 'command')"),
        ([b'{"cmd": "stop"}'], "command must start with 'web:', got 'stop'"),
        ([b'{"cmd": 3}'], "command must start with 'web:', got 3"),
        ([b'{"query": ["status"]}'], "unknown query: ['status']; it is a word"),
        ([b"{", b"}"], "recv failed: a message is one frame of JSON, and 2 came"),
        ([], "recv failed: a message is one frame of JSON, and 0 came"),
        ([b'{"cmd": "web:stop"'], "recv failed: not JSON in UTF-8: "),
        ([b'{"cmd": "\xff"}'], "recv failed: not JSON in UTF-8: "),
        ([b'{"command": "run", "arguments": {"duration_s": NaN}}'], "NaN is no number of JSON"),
        ([b"[" * 50_000], "recv failed: not JSON in UTF-8: "),
        ([b'"' + b"a" * LARGEST + b'"'], f"recv failed: {LARGEST + 2} bytes; allowed: at most {LARGEST}"),
        ([b'{"command": "run", "argument": {}}'], "'argument' is no key of a command; allowed: command,"),
        ([b'{"command": "run", "arguments": [1]}'], "arguments = [1]: must be a JSON object"),
        ([b'{"cmd": "web:run", "client": "a b"}'], "client = 'a b': must be a name"),
        ([b'{"cmd": "web:run", "client": 1}'], "client = 1: must be a name"),
        ([b'{"cmd": "web:run", "id": "1"}'], "id = '1': must be a UUID, or absent"),
        ([b'{"cmd": "web:run", "id": 7}'], "id = 7: must be a UUID, or absent"),
    ],
)
def test_what_cannot_be_read_is_a_sentence(frames, error):
    with pytest.raises(Malformed) as raised:
        read(frames)
    assert error in str(raised.value)
    assert len(str(raised.value)) < 300


def told(frames):
    """What reading them comes to: a message, or the sentence why it is none."""
    try:
        return read(frames)
    except Malformed as fault:
        return str(fault)


@given(st.lists(st.binary(max_size=60), max_size=3))
def test_noise_is_never_more_than_a_sentence(frames):
    found = told(frames)
    assert isinstance(found, str)
    assert found


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8),
    lambda parts: st.lists(parts, max_size=3) | st.dictionaries(st.text(max_size=4), parts, max_size=3),
    max_leaves=6,
)
KEYS = st.sampled_from(["cmd", "query", "command", "arguments", "client", "id", "armed"])


@given(st.dictionaries(KEYS, JSON | st.just("web:stop") | st.just("run"), max_size=5))
def test_whatever_json_is_said_is_a_message_or_a_sentence(fields):
    found = told([json.dumps(fields).encode()])
    assert isinstance(found, str) or isinstance(found.name, str)


@given(st.integers(0, 70))
def test_a_message_that_was_cut_off_is_a_sentence(length):
    whole = b'{"cmd": "web:init_move:{}", "client": "one", "armed": [true, 1.5e3]}'
    assert isinstance(told([whole[:length]]), str) == (length < len(whole))
