"""Every message between our processes: inside the family, and between the runtime and its clients.

A message is a frozen dataclass; on the wire it is a map of its fields with its class name under "type". What
comes in is checked against the fields' annotations, so that nothing behind `decode` meets what it cannot use.
Those that say a sentence have its `id` and `arguments` beside it, which follow from it; behind `decode` it is a
`Sentence` again.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from types import NoneType, UnionType
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

import numpy as np
from numpy.typing import NDArray

from runtime.core import sentences
from runtime.core.errors import CodecError
from runtime.core.msgpack_arrays import pack, unpack
from runtime.core.types import Float32, Float64, UInt8

# Kinds of events that control gives and the coordinator reads: whether anybody listens to commands.
NO_SUBSCRIBER, ALL_SUBSCRIBED = "commands_unheard", "commands_heard"


def _complete(message: Any, name: str) -> None:
    """Say the sentence in that field by its id, or make one of it that another process has told with its id."""
    text = getattr(message, name)
    if not isinstance(text, sentences.Sentence):
        text = sentences.heard(text, message.id, message.arguments)
        object.__setattr__(message, name, text)
    for part, value in sentences.identity(text).items():
        object.__setattr__(message, part, value)


# --- the coordinator -> control ---------------------------------------------------------------------------------------

OrderKind = Literal[
    "silent", "hold", "meet", "follow", "motion", "yield"
]  # "meet": hold, and lead what is held to where joints are read; "yield": the node drives, by its own leader
PolicyMode = Literal[
    "continuous", "step", "preview", "sim", "manual"
]  # of a station that was set up with a policy
Mode = Literal[PolicyMode, "collect"]


@dataclass(frozen=True, slots=True)
class Order:
    """Order to control, from its next tick on."""

    number: int
    kind: OrderKind
    run: int = 0  # the run that is open, 0 where none is; chunks of another run are ignored
    goal: Float64 | None = None  # [D] end of a "motion"; NaN: where it comes to a stand
    reason: str = ""
    mode: Mode = "continuous"  # of a "follow"
    speed: float = 1.0  # part of the speed of motions of ours that a "motion" may use


@dataclass(frozen=True, slots=True)
class PostedChunk:
    """A chunk in command space at control rate, not yet merged: float64 [H, D].

    Row 0 is for `observation_step`; where it `waited`, the robot stood while the policy was asked (or while a
    person looked), and row 0 is for the first tick that is still free. `meant` [D] is where the policy means to
    begin, however far that is; None where row 0 says so.
    """

    chunk_id: int
    run: int
    observation_step: int
    rows: Float64
    requested_while_stopped: bool = False
    intended_start: Float64 | None = None


@dataclass(frozen=True, slots=True)
class Tune:
    """The strategy to go on with from the next tick on: its whole section, as in a deployment."""

    strategy: Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class PolicyAway:
    """The policy of `run` is lost and asked again until `until` [s, monotonic clock]; an empty plan holds nothing till
    then."""

    run: int
    until: float


@dataclass(frozen=True, slots=True)
class LockGrippers:
    """Positions at which grippers stay whatever is asked of them: float64 [D], NaN for what is not locked."""

    values: Float64


@dataclass(frozen=True, slots=True)
class NodeRequest:
    """A control word for the execution node, passed on at once beside the commands; `data` are its fields."""

    word: str
    data: Mapping[str, Any] = field(default_factory=dict)


# --- control -> the coordinator and media -----------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class TickDone:
    """One tick as control did it; times on our monotonic clock."""

    step: int
    run: int
    planned: float
    sent: float
    sequence: int
    source: str
    qpos: Float32
    smoothed: Float32 | None
    executed: Float32 | None
    chunk_ids: list[int]
    weights: list[float]
    notes: list[str]
    refused: bool
    woke: float | None = None  # when the loop woke for it: woke - planned is how late; None in lockstep


@dataclass(frozen=True, slots=True)
class ChunkMerged:
    """Place that control gave a chunk; fields as in strategies.base.Merged."""

    chunk_id: int
    run: int
    arrival_step: int
    delay: int
    targets: NDArray[np.int64]
    mistimed: int
    dropped: str
    strategy: str = ""  # the kind that merged it
    overlap: int = 0  # steps from the arrival on that were blended with what was planned before
    contributions: Float64 | None = None


@dataclass(frozen=True, slots=True)
class Event:
    """Something that happened, in one sentence; `kind` is what programs look at."""

    kind: str
    text: str
    time: float
    step: int = -1
    data: Mapping[str, Any] = field(default_factory=dict)
    id: str = ""
    arguments: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        _complete(self, "text")


# --- the coordinator -> media -----------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class BeginEpisode:
    """Open an episode and let the source play from its start; `run` 0 records whatever control does."""

    run: int
    manifest: Mapping[str, Any] | None  # None: a run that is not recorded
    generation: int = 0  # of the coordinator that asks: what one asked for ends with it


@dataclass(frozen=True, slots=True)
class PolicyAnswer:
    """A chunk as the policy gave it; `source_rows` [H'] says which row each posted row was made from.

    Where its rows are poses, the errors float64 [H', arms] in m and rad and the flags uint8 [H', arms] (bits of
    kinematics.base.IkFlag) say how the posted rows meet them. `eef` is where the poses come from that the policy was
    shown, or that its rows are relative to: "measured" or "fk".
    """

    chunk_id: int
    run: int
    observation_step: int
    actions: Float32
    space: str
    source_rows: NDArray[np.int64]
    inference_ms: float
    position_error: Float64 | None = None
    rotation_error: Float64 | None = None
    ik_flags: UInt8 | None = None
    eef: str = ""


@dataclass(frozen=True, slots=True)
class EndEpisode:
    """Close the open episode."""

    status: str
    reason: str
    details: Mapping[str, Any] = field(default_factory=dict)
    id: str = ""
    arguments: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        _complete(self, "reason")


# --- media -> the coordinator -----------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class EpisodeOpened:
    """The recorder is ready (or could not be: `error`)."""

    run: int
    uuid: str
    path: str
    error: str = ""
    id: str = ""
    arguments: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        _complete(self, "error")


@dataclass(frozen=True, slots=True)
class EpisodeClosed:
    """An episode is on disk, or what there is of it."""

    uuid: str
    path: str
    status: str
    reason: str
    rows: int
    error: str = ""
    waits: bool = False  # for room on the disk: told again when it is closed
    id: str = ""
    arguments: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        _complete(self, "reason")


@dataclass(frozen=True, slots=True)
class MediaReport:
    """Report of what media writes, a few times a second."""

    time: float
    rows: int
    recording: str  # uuid of the open episode, "" where none is
    repeated: int
    unclosed: Mapping[str, str] = field(default_factory=dict)  # episodes that wait for room, and why


# --- reception -> media, and back --------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Observed:
    """An observation as in runtime.core.types.Observation, its pictures by the numbers of their slots."""

    sequence: int
    arrived: float
    captured: Mapping[str, float]
    qpos: Float32
    pictures: Mapping[str, int]
    qvel: Float32 | None = None
    effort: Float32 | None = None
    eef: Float32 | None = None
    reported_action: Float32 | None = None
    reported_action_eef: Float32 | None = None
    last: bool = False
    truth: Mapping[str, Any] | None = None


@dataclass(frozen=True, slots=True)
class BeginRun:
    """The source begins the run with that number: a recording plays from its start."""

    run: int
    generation: int = 0  # of the coordinator whose run it is: the next one counts anew


@dataclass(frozen=True, slots=True)
class RunBegun:
    """It has begun, and its first frame was handed on before this."""

    run: int
    generation: int = 0


@dataclass(frozen=True, slots=True)
class EndRun:
    """The source's run is over."""


# --- reception -> the coordinator -------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class ReceptionReport:
    """Report of what reception sees, a few times a second."""

    time: float
    rates: Mapping[str, float] = field(default_factory=dict)  # measured [Hz] per stream
    faults: Mapping[str, int] = field(default_factory=dict)
    truth: Mapping[str, Any] = field(default_factory=dict)  # of a simulated bench, as its node last said it
    drives: Mapping[str, Any] = field(
        default_factory=dict
    )  # {"enabled": bool, "faults": [str]}, {} where unsaid
    cameras: Mapping[str, Any] = field(
        default_factory=dict
    )  # of the deployment's own, as by Source.camera_health
    age_ms: Mapping[str, float] = field(
        default_factory=dict
    )  # of joints when they came into shared state: p50, p99, max of the newest
    scheduling: str = ""  # the class of the process, as by runtime.core.realtime


# --- clients <-> runtime -----------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Command:
    """A discrete request of a person or a program.

    `boot` and `sequence` are those of the snapshot it was decided by; `valid_until` is in the runtime's own
    clock, as counted on from that snapshot. `holder` and `epoch` say under which lease it is given. `user` and `role`
    are what the sender says, and are believed where runtime.ipc.identity has verified them; `vouched` names arguments
    that an administrator wrote.
    """

    uuid: str
    kind: str
    args: Mapping[str, Any] = field(default_factory=dict)
    user: str = ""
    holder: str = ""
    epoch: int = 0
    boot: str = ""
    sequence: int = 0
    valid_until: float = float("inf")
    role: str = ""
    vouched: list[str] = field(default_factory=list)


AckStatus = Literal["accepted", "refused", "done", "failed"]


@dataclass(frozen=True, slots=True)
class Ack:
    """The answer to a command; `allowed` names the commands that would be accepted now."""

    uuid: str
    status: AckStatus
    reason: str = ""
    allowed: list[str] = field(default_factory=list)
    boot: str = ""
    sequence: int = 0
    data: Mapping[str, Any] = field(default_factory=dict)
    kind: str = ""  # of the command that this answers
    id: str = ""
    arguments: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        _complete(self, "reason")


Message = (
    Order
    | PostedChunk
    | Tune
    | PolicyAway
    | LockGrippers
    | NodeRequest
    | TickDone
    | ChunkMerged
    | Event
    | BeginEpisode
    | PolicyAnswer
    | EndEpisode
    | EpisodeOpened
    | EpisodeClosed
    | MediaReport
    | Observed
    | BeginRun
    | RunBegun
    | EndRun
    | ReceptionReport
    | Command
    | Ack
)
_TYPES: dict[str, type[Any]] = {kind.__name__: kind for kind in Message.__args__}
_FIELDS = {kind: tuple(f.name for f in fields(kind)) for kind in _TYPES.values()}

# What stands on the wire for an annotation: numpy's scalars are numbers, a whole number will do for a float.
_INTEGERS: tuple[type, ...] = (int, np.integer)
_ON_THE_WIRE: dict[Any, tuple[type, ...]] = {
    str: (str,),
    bool: (bool, np.bool_),
    int: _INTEGERS,
    float: (float, np.floating, *_INTEGERS),
    list: (list,),
    Mapping: (dict,),
    np.ndarray: (np.ndarray,),
    NoneType: (NoneType,),
}


@dataclass(frozen=True, slots=True)
class _Expected:
    """Values that a field may have: one of `classes`, and where `words` are given, one of these."""

    classes: tuple[type, ...]
    words: tuple[str, ...] = ()

    def admits(self, value: object) -> bool:
        return isinstance(value, self.classes) and (not self.words or value in self.words)

    def __str__(self) -> str:
        return " or ".join(self.words or (kind.__name__ for kind in self.classes))


def _expected(annotation: Any) -> _Expected:
    origin = get_origin(annotation)
    if origin is Literal:
        return _Expected((str,), get_args(annotation))
    if origin in (Union, UnionType):
        parts = [_expected(part).classes for part in get_args(annotation)]
        return _Expected(tuple(kind for part in parts for kind in part))
    return _Expected(_ON_THE_WIRE[origin or annotation])


_EXPECTED = {
    kind: {name: _expected(annotation) for name, annotation in get_type_hints(kind).items()}
    for kind in _TYPES.values()
}


def encode(message: Message) -> bytes:
    """The message as bytes."""
    kind = type(message)
    return pack({"type": kind.__name__} | {name: getattr(message, name) for name in _FIELDS[kind]})


def decode(payload: bytes) -> Message:
    """The message in `payload`; raises CodecError naming what does not fit. Unknown fields are ignored."""
    content = unpack(payload)
    name = content.get("type") if isinstance(content, dict) else type(content).__name__
    if not isinstance(content, dict) or not isinstance(name, str) or name not in _TYPES:
        raise CodecError(f"message type {name!r} is unknown; known: {', '.join(_TYPES)}")
    kind = _TYPES[name]
    known = {field_: content[field_] for field_ in _FIELDS[kind] if field_ in content}
    for field_, value in known.items():
        if not _EXPECTED[kind][field_].admits(value):
            expected = _EXPECTED[kind][field_]
            raise CodecError(f"message {name}: {field_} = {value!r:.80}; expected {expected}")
    try:
        message: Message = kind(**known)
    except (TypeError, ValueError) as error:
        raise CodecError(f"message {name}: {error}") from None
    return message


def event_row(event: Event) -> dict[str, Any]:
    """An event as a line of the episode's log."""
    return {
        "kind": event.kind,
        "text": event.text,
        "time": event.time,
        "step": event.step,
        "data": dict(event.data),
        **told_by(event),
    }


def told_by(message: Event | Ack) -> dict[str, Any]:
    """Id and arguments of what it says, for a row that keeps its text; {} where it has none."""
    return {"id": message.id, "arguments": message.arguments} if message.id else {}
