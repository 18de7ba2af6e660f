"""Codec of LeRobot's messages for its stand-in, which shares no code with the client's codec, so that it can test that.

Messages use protobuf. Pickles are written instruction by instruction, as torch and LeRobot would write them, and read
by Python's unpickler restricted to a table of names.
"""

from __future__ import annotations

import io
import pickle
import struct
from typing import Any

import numpy as np
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

from runtime.core.types import Float32

HELPERS = "lerobot.async_inference.helpers"
_MAGIC = 0x1950A86A20F9469CFC6C
_KEY = "93988870496288"  # key of a storage, arbitrary


def _messages() -> dict[str, Any]:
    """Return the classes of the service's four messages by name."""
    file = descriptor_pb2.FileDescriptorProto(name="standin.proto", package="transport", syntax="proto3")
    kinds = descriptor_pb2.FieldDescriptorProto
    for name, fields in (
        ("Observation", [("transfer_state", kinds.TYPE_INT32), ("data", kinds.TYPE_BYTES)]),
        ("PolicySetup", [("data", kinds.TYPE_BYTES)]),
        ("Actions", [("data", kinds.TYPE_BYTES)]),
        ("Empty", []),
    ):
        message_type = file.message_type.add(name=name)
        for number, (field, kind) in enumerate(fields, 1):
            message_type.field.add(name=field, number=number, type=kind, label=kinds.LABEL_OPTIONAL)
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    return {
        name: message_factory.GetMessageClass(pool.FindMessageTypeByName(f"transport.{name}"))
        for name in ("Observation", "PolicySetup", "Actions", "Empty")
    }


MESSAGES = _messages()


class UnpickledObject:
    """Instance of a LeRobot class from a pickle, with its fields as attributes."""


class _Reader(pickle.Unpickler):
    _numpy = ("_reconstruct", "_frombuffer", "scalar", "ndarray", "dtype")

    def __init__(self, data: bytes, helpers: str) -> None:
        super().__init__(io.BytesIO(data))
        self._helpers = helpers

    def find_class(self, module: str, name: str) -> Any:
        if module == self._helpers and name in ("TimedObservation", "RemotePolicyConfig"):
            return type(name, (UnpickledObject,), {})
        if module.partition(".")[0] == "numpy" and name in self._numpy:
            return super().find_class(module, name)
        raise ModuleNotFoundError(f"No module named {module!r}")


def unpickle(data: bytes, helpers: str = HELPERS) -> Any:
    """Return the object that a client pickled; `helpers` is the module of LeRobot's classes.

    Raises:
        ModuleNotFoundError: If the pickle contains any other class or function.
    """
    return _Reader(data, helpers).load()


def timed_actions(rows: Float32, timesteps: list[int], timestamps: list[float]) -> bytes:
    """Return a pickled list[TimedAction] whose rows are views of one tensor.

    As with the real server, each action contains the storage of all rows.
    """
    storage = _storage(rows)
    return b"\x80\x04](" + b"".join(
        _name(HELPERS, "TimedAction") + b")\x81}("
        + _text("timestamp") + b"G" + struct.pack(">d", when)
        + _text("timestep") + _number(step)
        + _text("action") + _tensor(storage, index * rows.shape[1], rows.shape[1])
        + b"ub"
        for index, (step, when) in enumerate(zip(timesteps, timestamps, strict=True))
    ) + b"e."  # fmt: skip


def command_pickle(line: str) -> bytes:
    """Return a pickle that runs the shell command `line` if it is read without restrictions."""
    return b"\x80\x04" + _name("os", "system") + b"(" + _text(line) + b"tR."


def _tensor(storage: bytes, offset: int, width: int) -> bytes:
    loaded = (
        _name("torch.storage", "_load_from_bytes") + b"(B" + struct.pack("<I", len(storage)) + storage + b"tR"
    )
    hooks = _name("collections", "OrderedDict") + b")R"
    shape = b"(" + _number(width) + b"t(" + _number(1) + b"t"
    return (
        _name("torch._utils", "_rebuild_tensor_v2")
        + b"("
        + loaded
        + _number(offset)
        + shape
        + b"\x89"
        + hooks
        + b"tR"
    )


def _storage(rows: Float32) -> bytes:
    """Return a torch file of the old format with the rows as its storage."""
    machine = {
        "protocol_version": 1001,
        "little_endian": True,
        "type_sizes": {"short": 2, "int": 4, "long": 4},
    }
    storage = (
        b"\x80\x02(" + _text("storage") + _name("torch", "FloatStorage") + _text(_KEY) + _text("cpu")
        + _number(rows.size) + b"NtQ."
    )  # fmt: skip
    parts = [pickle.dumps(part, 2) for part in (_MAGIC, 1001, machine)]
    elements = np.ascontiguousarray(rows, "<f4").tobytes()
    return b"".join([*parts, storage, pickle.dumps([_KEY], 2), struct.pack("<q", rows.size), elements])


def _name(module: str, name: str) -> bytes:
    return f"c{module}\n{name}\n".encode()


def _text(text: str) -> bytes:
    return b"X" + struct.pack("<I", len(text.encode())) + text.encode()


def _number(number: int) -> bytes:
    return b"J" + struct.pack("<i", number)
