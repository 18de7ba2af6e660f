from __future__ import annotations

import contextlib
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from runtime.core.errors import PolicyError
from runtime.policies.groot import arrays
from runtime.policies.groot.modality import ActionFormat, Modality, parse_modalities

N16 = bytes.fromhex(
    "82a5766964656f82b85f5f4d6f64616c697479436f6e6669675f636c6173735f5fc3a761735f6a736f6e85ad64656c74615f696e6469636573"
    "9100ad6d6f64616c6974795f6b65797391a865676f5f76696577b673696e5f636f735f656d62656464696e675f6b657973c0b76d65616e5f73"
    "74645f656d62656464696e675f6b657973c0ae616374696f6e5f636f6e66696773c0a5737461746582b85f5f4d6f64616c697479436f6e6669"
    "675f636c6173735f5fc3a761735f6a736f6e85ad64656c74615f696e64696365739100ad6d6f64616c6974795f6b65797391aa73696e676c65"
    "5f61726db673696e5f636f735f656d62656464696e675f6b657973c0b76d65616e5f7374645f656d62656464696e675f6b657973c0ae616374"
    "696f6e5f636f6e66696773c0"
)
N17 = bytes.fromhex(
    "81a5766964656f82b25f5f4d6f64616c697479436f6e6669675f5fc3a761735f6a736f6e85ad64656c74615f696e64696365739100ad6d6f64"
    "616c6974795f6b65797391a865676f5f76696577b673696e5f636f735f656d62656464696e675f6b657973c0b76d65616e5f7374645f656d62"
    "656464696e675f6b657973c0ae616374696f6e5f636f6e66696773c0"
)
MARK = "__ModalityConfig_class__"


def given_as(keys: Any, steps: Any) -> dict[str, object]:
    return {MARK: True, "as_json": {"modality_keys": keys, "delta_indices": steps}}


def test_the_answers_of_n16_and_n17_are_read() -> None:
    found = parse_modalities(arrays.unpack(N16, 1000))
    assert found.video == Modality(("ego_view",), (0,))
    assert found.state == Modality(("single_arm",), (0,))
    assert found.action == Modality()
    assert not found.is_n15
    assert not found.reads_mnp
    newest = parse_modalities(arrays.unpack(N17, 1000))
    assert newest.video == Modality(("ego_view",), (0,))
    assert newest.reads_mnp


def test_text_under_the_mark_of_n17_is_not_n15() -> None:
    fields = '{"delta_indices": [0], "modality_keys": ["ego_view"]}'
    assert not parse_modalities({"video": {"__ModalityConfig__": True, "as_json": fields}}).is_n15


def test_a_configuration_without_a_mark_says_nothing_of_arrays() -> None:
    fields = {"modality_keys": ["ego_view"], "delta_indices": [0]}
    for configuration in ({"as_json": fields}, fields):
        found = parse_modalities({"video": configuration})
        assert (found.video, found.reads_mnp) == (Modality(("ego_view",), (0,)), None)


def test_starvla_says_keys_and_numbers_in_flat_lists() -> None:
    reply = {
        "state_keys": ["state.arm"],
        "state_key_dims": {"state.arm": 7},
        "action_keys": ["action.arm"],
        "action_key_dims": {"action.arm": 7},
        "unnorm_key": "bench",
    }
    found = parse_modalities(reply)
    assert (found.state.keys, found.state.widths) == (("arm",), {"arm": 7})
    assert (found.action.keys, found.action.widths) == (("arm",), {"arm": 7})
    assert found.video.keys is found.language.keys is None
    assert found.to_dict() == reply
    assert not found.is_n15
    assert not found.reads_mnp


def test_starvlas_server_of_egovla_says_no_numbers_and_a_horizon() -> None:
    found = parse_modalities(
        {"video_keys": ["ego_view"], "state_keys": [], "action_keys": ["arm"], "action_horizon": 30}
    )
    assert found.video.keys == ("ego_view",)
    assert found.state.keys is None  # it is shown none, and takes none amiss
    assert (len(found.action.steps), found.action.widths) == (30, {})


def test_n15_writes_json_as_text_and_keys_with_their_prefix() -> None:
    text = '{"delta_indices": [-1, 0], "modality_keys": ["video.ego_view"]}'
    found = parse_modalities({"video": {MARK: True, "as_json": text}})
    assert found.is_n15
    assert found.video == Modality(("ego_view",), (-1, 0))
    assert found.to_dict()["video"] == {"keys": ["ego_view"], "steps": [-1, 0]}


@pytest.mark.parametrize(
    ("reply", "says"),
    [
        (None, "NoneType"),
        ({"actions": 1}, "expected a map of video, state, action, language"),
        ({"video": 3}, "modality 'video' is int"),
        ({"state_keys": "arm", "action_keys": []}, "state_keys str 'arm'; expected a list of names"),
        ({"action_keys": [], "action_key_dims": {"arm": "7"}}, "action_key_dims dict"),
        ({"video": {"as_json": {}}}, "modality 'video'"),
        ({"video": {MARK: True, "as_json": 3}}, "expected a map"),
        ({"video": {MARK: True, "as_json": "{"}}, "no JSON"),
        ({"video": {MARK: True, "as_json": "[" * 100_000}}, "no JSON"),
        ({"video": {MARK: True, "as_json": "3"}}, "expected a map"),
        ({"state": given_as("names", [0])}, "modality_keys"),
        ({"state": given_as([3], [0])}, "modality_keys"),
        ({"state": given_as(["a"], [])}, "delta_indices"),
        ({"state": given_as(["a"], ["0"])}, "delta_indices"),
        ({"state": given_as(["a"], [True])}, "delta_indices"),
    ],
)
def test_what_is_no_modality_configuration_is_named(reply: object, says: str) -> None:
    with pytest.raises(PolicyError, match=says):
        parse_modalities(reply)


def test_how_actions_are_written_is_read_where_there_is_one_word_for_each() -> None:
    configs = [
        {"rep": "RELATIVE", "type": "EEF", "format": "xyz+rot6d"},
        {"rep": "absolute", "format": "DEFAULT"},
    ]
    fields = {"modality_keys": ["eef", "gripper"], "delta_indices": [0], "action_configs": configs}
    found = parse_modalities({"action": {MARK: True, "as_json": fields}}).action.written
    assert found == {
        "eef": ActionFormat("RELATIVE", "XYZ_ROT6D"),
        "gripper": ActionFormat("ABSOLUTE", "DEFAULT"),
    }
    for strange in (configs[:1], None, 3, [1, 2]):
        given = {MARK: True, "as_json": {**fields, "action_configs": strange}}
        assert parse_modalities({"action": given}).action.written == {}


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.text(max_size=5),
    lambda inner: (
        st.lists(inner, max_size=3)
        | st.dictionaries(
            st.sampled_from(["video", "state", MARK, "as_json", "modality_keys", "delta_indices"]), inner
        )
    ),
    max_leaves=20,
)


@given(JSON)
def test_anything_else_is_an_error_and_no_crash(reply: object) -> None:
    with contextlib.suppress(PolicyError):
        parse_modalities(reply)
