"""Pickles of LeRobot's policy server, without LeRobot and without executing code of the peer.

To write an instance of one of the server's classes, a pickle needs only the name of the class, so that LeRobot need not
be installed. The only objects read are lists of the server's TimedAction: the interpreter has only the pickle
instructions that these need, and refuses every name that is not in a table of this module. Source:
lerobot.async_inference.helpers; in 0.3 the module was lerobot.scripts.server.helpers.
"""

from __future__ import annotations

import io
import pickle
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np

from runtime.core.errors import CodecError
from runtime.policies.async_inference.tensors import Tensors

MODULES = {"0.4": "lerobot.async_inference.helpers", "0.3": "lerobot.scripts.server.helpers"}
_PROTOCOL = 4


@dataclass(frozen=True)
class RemotePolicyConfig:
    """Model that a server is to load. The order of the fields is that of LeRobot's class."""

    policy_type: str
    pretrained_name_or_path: str
    lerobot_features: Mapping[str, Any]
    actions_per_chunk: int
    device: str = "cpu"
    rename_map: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class TimedObservation:
    """Observation: motors as floats, pictures uint8 [H, W, 3], the task; `timestamp` is wall clock [s]."""

    timestamp: float
    timestep: int
    observation: Mapping[str, Any]
    must_go: bool


@dataclass(frozen=True, slots=True)
class TimedAction:
    """One row of a response, with its time and step."""

    timestamp: float
    timestep: int
    action: np.ndarray[Any, Any]


def dump(value: RemotePolicyConfig | TimedObservation, module: str) -> bytes:
    """Return the pickle of `value` as an instance of the server's class with the same name in `module`."""
    file = io.BytesIO()
    _Writer(file, module).dump(value)
    return file.getvalue()


def load_actions(data: bytes, limit: int) -> list[TimedAction]:
    """Return the actions in the order of the message. Raises CodecError for invalid or refused content."""
    if len(data) > limit:
        raise CodecError(f"actions of {len(data)} bytes exceed the limit of {limit}")
    try:
        actions = _Reader(io.BytesIO(data)).load()
    except CodecError:
        raise
    except Exception as error:  # a broken pickle may raise any exception, but has executed nothing
        raise CodecError(
            f"{len(data)} bytes are no pickle of actions: {type(error).__name__}: {error}"
        ) from error
    if not isinstance(actions, list):
        raise CodecError(f"the actions are {type(actions).__name__}; expected a list of TimedAction")
    return [_timed_action(action) for action in actions]


class _Writer(pickle._Pickler):
    """Python's pickler, except that it writes the classes of this module as classes of the server's module `module`."""

    save: Callable[[Any], None]  # of Python's pickler, like the next two
    write: Callable[[bytes], None]
    memoize: Callable[[Any], None]

    def __init__(self, file: io.BytesIO, module: str) -> None:
        super().__init__(file, _PROTOCOL)
        self._module = module

    def save_global(self, obj: Any, name: str | None = None) -> None:
        if obj is not RemotePolicyConfig and obj is not TimedObservation:
            super().save_global(obj, name)  # type: ignore[misc]
            return
        self.save(self._module)
        self.save(obj.__name__)
        self.write(pickle.STACK_GLOBAL)
        self.memoize(obj)


class _Record:
    """Instance of a class of the peer, which here has only fields."""

    __slots__ = ("fields",)

    def __init__(self) -> None:
        self.fields: dict[str, Any] = {}


class _Name:
    """Class or function that a pickle names; its attributes are read-only.

    `make` is the function of this program that is called in place of the named one. It is None if the pickle may not
    call this name.
    """

    __slots__ = ("make", "what")
    what: str
    make: Callable[..., Any] | None

    def __init__(self, name: str, make: Callable[..., Any] | None) -> None:
        object.__setattr__(self, "what", name)
        object.__setattr__(self, "make", make)

    def __setattr__(self, name: str, value: object) -> None:
        raise CodecError(f"an instruction to change {self.what} is refused")


_NEEDED = (
    "PROTO", "FRAME", "STOP", "MARK", "MEMOIZE", "PUT", "BINPUT", "LONG_BINPUT", "GET", "BINGET", "LONG_BINGET",
    "EMPTY_LIST", "APPEND", "APPENDS", "EMPTY_DICT", "SETITEM", "SETITEMS", "EMPTY_TUPLE", "TUPLE", "TUPLE1", "TUPLE2",
    "TUPLE3", "NONE", "NEWTRUE", "NEWFALSE", "BININT", "BININT1", "BININT2", "LONG1", "BINFLOAT", "BINUNICODE",
    "SHORT_BINUNICODE", "BINBYTES", "SHORT_BINBYTES", "GLOBAL", "STACK_GLOBAL", "BINPERSID",
)  # fmt: skip


class Reader(pickle._Unpickler):
    """Pickle interpreter with instructions for plain data only; a pickle that names a class or function is refused."""

    dispatch: ClassVar[dict[int, Callable[..., None]]] = {
        code: pickle._Unpickler.dispatch[code] for code in (getattr(pickle, name)[0] for name in _NEEDED)
    }

    def find_class(self, module: str, name: str) -> Any:
        raise CodecError(f"a pickle that names {module}.{name} is refused")


class _Reader(Reader):
    """Pickle interpreter for one list of TimedAction.

    It accepts only the classes and functions that such a list names.
    """

    dispatch: ClassVar[dict[int, Callable[..., None]]] = dict(Reader.dispatch)
    stack: list[Any]  # of Python's unpickler, like the next one
    append: Callable[[Any], None]

    def __init__(self, file: io.BytesIO) -> None:
        super().__init__(file)
        tensors = Tensors(Reader)
        constructors: dict[tuple[str, str], Callable[..., Any] | None] = {
            ("torch._utils", "_rebuild_tensor_v2"): tensors.tensor,
            ("torch.storage", "_load_from_bytes"): tensors.storage,
            ("collections", "OrderedDict"): dict,
            **{(module, "TimedAction"): None for module in MODULES.values()},
        }
        self._names = {key: _Name(".".join(key), make) for key, make in constructors.items()}

    def find_class(self, module: str, name: str) -> Any:
        result = self._names.get((module, name))
        if result is None:
            allowed = ", ".join(sorted(entry.what for entry in self._names.values()))
            raise CodecError(f"a pickle that names {module}.{name} is refused; allowed: {allowed}")
        return result

    def _reduce(self) -> None:
        arguments = self.stack.pop()
        name = self.stack[-1]
        if not isinstance(name, _Name) or name.make is None or type(arguments) is not tuple:
            raise CodecError(f"a pickle that calls {type(name).__name__} is refused")
        self.stack[-1] = name.make(*arguments)

    def _new(self) -> None:
        arguments = self.stack.pop()
        name = self.stack.pop()
        if not isinstance(name, _Name) or name.make is not None or arguments != ():
            raise CodecError(f"a pickle that makes {type(name).__name__} is refused")
        self.append(_Record())

    def _build(self) -> None:
        state = self.stack.pop()
        record = self.stack[-1]
        if not isinstance(record, _Record) or type(state) is not dict:
            raise CodecError(f"a pickle that changes {type(record).__name__} is refused")
        record.fields = state

    # These replace the instructions that call, create or change objects.
    dispatch[pickle.REDUCE[0]] = _reduce
    dispatch[pickle.NEWOBJ[0]] = _new
    dispatch[pickle.BUILD[0]] = _build


def _timed_action(element: object) -> TimedAction:
    fields = element.fields if isinstance(element, _Record) else {}
    timestamp, timestep, action = (fields.get(name) for name in ("timestamp", "timestep", "action"))
    if type(timestamp) is not float or type(timestep) is not int or not isinstance(action, np.ndarray):
        types = {str(name): type(value).__name__ for name, value in fields.items()} or type(element).__name__
        raise CodecError(f"an action is {types}; expected timestamp float, timestep int, action tensor")
    return TimedAction(timestamp, timestep, action)
