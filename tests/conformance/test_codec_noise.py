"""Random, cut and bent bytes for whatever reads messages of others: a value, or the reader's own error."""

from __future__ import annotations

import pickle
import struct
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import robots
from runtime.core import msgpack_arrays
from runtime.core.errors import CodecError
from runtime.policies.async_inference import messages, pickles
from runtime.policies.async_inference.tensors import Tensors
from runtime.policies.groot import arrays as groot
from runtime.simulation.command_gate import AcceptedCommand, CommandGate
from runtime.standins import arrays
from runtime.transports.node_messages import MESSAGE_LIMIT, NodeFrame, NodeMessages
from tests.conformance.test_recorded_bytes import MNP, NPY, OPENPI, PICKLED_ACTIONS, XPOLICYLAB, vector
from tests.examples import some

ROBOT = robots.load_robot("ur5e")
NODE = NodeMessages(ROBOT, "bgr", frozenset(), MESSAGE_LIMIT)
JOINTS = np.linspace(-0.5, 0.5, 7).astype(np.float32)
POSE = np.array([0.1, 0, 0.2, 1, 0, 0, 0, 0.05], np.float32)
PICTURES = {camera.key: np.arange(12, dtype=np.uint8).reshape(2, 2, 3) for camera in ROBOT.cameras}
FRAMES = [
    arrays.packed({"t": 1.5, "images": PICTURES, "state": {"arm": JOINTS}}),
    arrays.packed(
        {
            "t": 1.5,
            "images": PICTURES,
            "state": {"arm": JOINTS},
            "eef": {"arm": POSE},
            "action": JOINTS,
            "action_eef": POSE,
            "hil_supported": True,
            "hil_error": "no",
            "encoding": "rgb",
            "seq": 3,
            "holding": True,
            "refused": {"limits": 2},
            "master": "a",
            "ack": 9,
            "drives": {"enabled": False, "faults": ["hot"]},
            "truth": {"reset": "r", "milestones": {"placed": False}, "success": False},
        }
    ),
]
COMMANDS = [
    arrays.packed({"t": 1.5, "action": JOINTS, "target": "real", "master": "a", "seq": 7}),
    arrays.packed({"t": 1.5, "action": JOINTS, "target": "hil_start", "mode": "relative"}),
    arrays.packed(
        {"t": 1.5, "target": "scene_reset", "id": "r", "seed": 3, "positions": {"plate": [0.1, 0.2]}}
    ),
    arrays.packed({"t": 1.5, "target": "drives_fault", "fault": "hot"}),
]


def storage_file() -> bytes:
    """Four floats as torch writes them."""
    said = b"\x80\x02(" + b"".join(
        [
            _text("storage"),
            b"ctorch\nFloatStorage\n",
            _text("7"),
            _text("cpu"),
            b"J",
            struct.pack("<i", 4),
            b"NtQ.",
        ]
    )
    machine = {
        "protocol_version": 1001,
        "little_endian": True,
        "type_sizes": {"short": 2, "int": 4, "long": 4},
    }
    head = [pickle.dumps(part, 2) for part in (119547037146038801333356, 1001, machine)]
    return b"".join(
        [*head, said, pickle.dumps(["7"], 2), struct.pack("<q", 4), np.arange(4, dtype="<f4").tobytes()]
    )


def _text(word: str) -> bytes:
    return b"X" + struct.pack("<I", len(word)) + word.encode()


def judged(payload: bytes) -> AcceptedCommand | None:
    """What a node takes; a target that it takes is one that the robot may have."""
    gate = CommandGate(ROBOT, 0.3, bench=True)
    accepted = gate.accept(payload, 10.0)
    if accepted is not None and accepted.target is not None:
        assert accepted.target.shape == (ROBOT.dim,)
        assert ((ROBOT.lower <= accepted.target) & (accepted.target <= ROBOT.upper)).all()
    return accepted


def framed(payload: bytes) -> NodeFrame:
    """What a node says; whatever is taken of it is whole and finite."""
    frame = NODE.read(payload)
    assert np.isfinite(frame.qpos).all()
    assert frame.qpos.shape == (ROBOT.dim,)
    assert all(picture.dtype == np.uint8 and picture.ndim == 3 for picture in frame.pictures.values())
    assert frame.eef is None or np.isfinite(frame.eef).all()
    return frame


class Reading(NamedTuple):
    read: Callable[[bytes], Any]
    real: list[bytes]


READERS = {
    "openpi": Reading(msgpack_arrays.unpack, [vector(name) for name in OPENPI]),
    "gr00t": Reading(
        lambda data: groot.unpack(data, 2**20), [vector(name) for name in (*NPY, *MNP, *XPOLICYLAB)]
    ),
    "lerobot_message": Reading(messages.decode_actions, [messages.encode_setup(vector(PICKLED_ACTIONS[0]))]),
    "lerobot_pickle": Reading(
        lambda data: pickles.load_actions(data, 2**20), [vector(name) for name in PICKLED_ACTIONS]
    ),
    "lerobot_tensor": Reading(lambda data: Tensors(pickles.Reader).storage(data), [storage_file()]),
    "node": Reading(framed, FRAMES),
    "gate": Reading(judged, COMMANDS),
}
on_every_reader = pytest.mark.parametrize("name", READERS)


def outcome(read: Callable[[bytes], Any], payload: bytes) -> Any:
    """What is read, or the reader's own error; any other is the test's."""
    try:
        return read(payload)
    except CodecError as error:
        return error


@on_every_reader
def test_real_messages_are_read(name: str) -> None:
    for payload in READERS[name].real:
        assert READERS[name].read(payload) is not None


@on_every_reader
@settings(max_examples=some(100))
@given(payload=st.binary(max_size=200))
def test_random_bytes_are_a_value_or_the_readers_own_error(name: str, payload: bytes) -> None:
    found = outcome(READERS[name].read, payload)
    assert not isinstance(found, CodecError) or len(str(found)) > 10


@pytest.mark.some(3)
@on_every_reader
@settings(max_examples=some(150))
@given(data=st.data())
def test_cut_and_bent_messages_are_a_value_or_the_readers_own_error(name: str, data: st.DataObject) -> None:
    reader = READERS[name]
    payload = bytearray(data.draw(st.sampled_from(reader.real)))
    for _ in range(data.draw(st.integers(0, 4))):
        payload[data.draw(st.integers(0, len(payload) - 1))] = data.draw(st.integers(0, 255))
    first = data.draw(st.integers(0, len(payload)))
    last = data.draw(st.integers(first, len(payload)))
    kept = data.draw(st.sampled_from([bytes(payload), bytes(payload[:last]), bytes(payload[first:last])]))
    outcome(reader.read, kept)


@pytest.mark.parametrize("name", ["node", "gate"])
@settings(max_examples=some(150))
@given(data=st.data())
def test_fields_of_any_kind_are_a_value_or_the_readers_own_error(name: str, data: st.DataObject) -> None:
    """Whole messages whose fields are something else."""
    reader = READERS[name]
    message = dict(arrays.unpacked(data.draw(st.sampled_from(reader.real))))
    for key in data.draw(st.lists(st.sampled_from(sorted(message)), max_size=3)):
        message[key] = data.draw(ANYTHING)
    outcome(reader.read, arrays.packed(message))


LEAF = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(-(2**63), 2**64 - 1),
    st.floats(),
    st.text(max_size=5),
    st.binary(max_size=5),
    st.sampled_from(
        [JOINTS, JOINTS * np.nan, JOINTS[:3], JOINTS.astype(">f8"), np.array("x"), np.float32(2), POSE]
    ),
)
ANYTHING = st.recursive(
    LEAF, lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3)
)
