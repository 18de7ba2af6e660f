"""Messages between the station's processes, and between the runtime and its clients.

A message is a frozen dataclass; on the wire it is a map of its fields with its class name under "type". Received
messages are checked against the fields' annotations, so code behind `decode` gets valid types only. Messages with a
sentence also carry the sentence's `id` and `arguments`, which are derived from it. After `decode` the sentence is a
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
from runtime.core.types import ControlSource, Float32, Float64, UInt8

# Kinds of control's events about subscribers of commands.
NO_SUBSCRIBER, ALL_SUBSCRIBED = "commands_unheard", "commands_heard"


def _complete(message: Any, name: str) -> None:
    """Complete the sentence in the field `name` of a message.

    For a sentence of our own, its id and arguments are stored in the fields `id` and `arguments`. For a received text,
    the sentence is rebuilt from the received `id` and `arguments`.
    """
    text = getattr(message, name)
    if not isinstance(text, sentences.Sentence):
        text = sentences.from_wire(text, message.id, message.arguments)
        object.__setattr__(message, name, text)
    for part, value in sentences.identity(text).items():
        object.__setattr__(message, part, value)


# --- the coordinator -> control ---------------------------------------------------------------------------------------

OrderKind = Literal[
    "silent", "hold", "meet", "follow", "motion", "yield"
]  # "meet": hold, and converge to measured; "yield": node-driven, by its own leader
PolicyMode = Literal["continuous", "step", "preview", "sim", "manual"]  # of a station set up with a policy
Mode = Literal[PolicyMode, "collect"]


@dataclass(frozen=True, slots=True)
class Order:
    """Order of the coordinator to control, valid from control's next tick."""

    number: int
    kind: OrderKind
    run: int = 0  # the open run, 0: none; chunks of another run are ignored
    goal: Float64 | None = None  # [D] end of a "motion"; NaN: where the joint stops when it brakes
    reason: str = ""
    mode: Mode = "continuous"  # of a "follow"
    source: ControlSource = "policy"  # of the rows of a "follow"
    speed: float = 1.0  # share of the speed of generated motions that a "motion" may use


@dataclass(frozen=True, slots=True)
class PostedChunk:
    """Chunk in command space at control rate, not yet merged: float64 [H, D].

    Row 0 is for `observation_step`. If `requested_while_stopped`, the robot was at rest during the request (or while a
    person reviewed the chunk), and row 0 is for the first free tick. `intended_start` [D] is the position at which the
    policy intends to begin, at any distance from the robot. If it is None, the policy intends to begin at row 0.
    """

    chunk_id: int
    run: int
    observation_step: int
    rows: Float64
    requested_while_stopped: bool = False
    intended_start: Float64 | None = None


@dataclass(frozen=True, slots=True)
class Tune:
    """Order to use another strategy from the next tick on; `strategy` is a whole section as in a deployment."""

    strategy: Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class PolicyAway:
    """Message that the policy of `run` is lost, and is retried until `until` [s, monotonic clock].

    Until then an empty plan does not lead to holding.
    """

    run: int
    until: float


@dataclass(frozen=True, slots=True)
class LockGrippers:
    """Positions at which grippers are locked, whatever is commanded: float64 [D], NaN for unlocked dimensions."""

    values: Float64


@dataclass(frozen=True, slots=True)
class NodeRequest:
    """Control word for the execution node, sent at once in addition to commands; `data` are its fields."""

    word: str
    data: Mapping[str, Any] = field(default_factory=dict)


# --- control -> the coordinator and media -----------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class ExecutedTick:
    """Record of one control tick: smoothed action, action after safety, and its send time (our monotonic clock)."""

    step: int
    run: int
    planned: float
    sent: float
    sequence: int
    source: ControlSource
    qpos: Float32  # measured joints at the tick
    smoothed: Float32 | None  # before safety; None without a target
    executed: Float32 | None  # sent action; None if none was sent
    chunk_ids: list[int] = field(default_factory=list)
    weights: list[float] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)  # changes by safety, or reasons of its refusal
    refused: bool = False
    woke: float | None = None  # wake-up time; woke - planned is the lateness; None in lockstep


@dataclass(frozen=True, slots=True)
class MergeResult:
    """Result of a merge: which rows of a chunk are planned for which steps.

    `arrival_step` is the first step not yet sent, `delay` = arrival_step - observation_step. `targets` int64 [H] is the
    step that each row was planned for, -1 if it was dropped. `mistimed` is the number of steps by which rows are
    executed later than intended, because at most `k_max` rows may be dropped as too late; it is negative if the chunk
    arrived before the step that it is for. `dropped` is the reason if no row is used, else "". `contributions` [N, 3]
    are step, chunk id and weight for all steps to which this chunk does not contribute alone; None if the merge does
    not support RTC (`Merge.uses_rtc`), or if there are too many.
    """

    chunk_id: int
    arrival_step: int
    delay: int
    targets: NDArray[np.int64]
    mistimed: int = 0
    dropped: str = ""
    run: int = 0  # set by control, like the next
    strategy: str = ""  # the kind that merged it; "" for a chunk that was dropped before
    overlap: int = 0  # steps from arrival_step on made by several chunks, or by a chunk and a held target
    contributions: Float64 | None = None


@dataclass(frozen=True, slots=True)
class Event:
    """Event, described in one sentence for people; programs use `kind`."""

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
    """Request to open an episode, and for a run also to play the source from its start.

    If `run` is 0, the episode is a recording without a run, which contains everything that control does meanwhile.
    """

    run: int
    manifest: Mapping[str, Any] | None  # None: the run is not recorded
    generation: int = 0  # of the requesting coordinator, with which its episode ends


@dataclass(frozen=True, slots=True)
class PolicyAnswer:
    """Chunk as received from the policy: `actions` [H, W] in `space`.

    Control receives other rows [H'], which were made from these, for example resampled or converted to joints.
    `source_rows` [H'] has for each of them the index of its row in `actions`. If `actions` are poses, the errors
    float64 [H', arms] in m and rad, and the flags uint8 [H', arms] (bits of kinematics.base.IkFlag), describe how well
    the rows that control receives reach the poses. `eef` is the origin of the poses in the observation: "measured" or
    "fk".
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
    """Request to close the open episode."""

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
    """Report that the recorder is ready, or failed with `error`."""

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
    """Report that an episode is on disk, as far as it was recorded."""

    uuid: str
    path: str
    status: str
    reason: str
    rows: int
    error: str = ""
    waits: bool = False  # waits for room on the disk; sent again when closed
    id: str = ""
    arguments: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        _complete(self, "reason")


@dataclass(frozen=True, slots=True)
class MediaReport:
    """Report of the recording, a few times a second."""

    time: float
    rows: int
    recording: str  # uuid of the open episode, "" if there is none
    repeated: int
    unclosed: Mapping[str, str] = field(default_factory=dict)  # episodes that wait for room, with the reason


# --- reception -> media, and back --------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Observed:
    """Observation with the fields of runtime.core.types.Observation, and slot numbers in place of its pictures."""

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
    """Request to begin a run of the source: a recording plays from its start."""

    run: int
    generation: int = 0  # of the coordinator whose run it is; its successor numbers runs anew


@dataclass(frozen=True, slots=True)
class RunBegun:
    """Report that the source's run has begun; its first frame was passed on before this message."""

    run: int
    generation: int = 0


@dataclass(frozen=True, slots=True)
class EndRun:
    """Request to end the source's run."""


# --- reception -> the coordinator -------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class ReceptionReport:
    """Report of reception, a few times a second."""

    time: float
    rates: Mapping[str, float] = field(default_factory=dict)  # measured [Hz] per stream
    faults: Mapping[str, int] = field(default_factory=dict)
    truth: Mapping[str, Any] = field(default_factory=dict)  # of a simulated bench, from its node
    # {"enabled": bool, "faults": [str]}, {} if not reported
    drives: Mapping[str, Any] = field(default_factory=dict)
    # of the deployment's own, as from Source.camera_health
    cameras: Mapping[str, Any] = field(default_factory=dict)
    # age of joints on arrival in shared state: p50, p99, max of the newest
    age_ms: Mapping[str, float] = field(default_factory=dict)
    scheduling: str = ""  # scheduling class of the process, see runtime.core.realtime


# --- clients <-> runtime -----------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Command:
    """Request of a person or a program.

    `boot` and `sequence` are those of the snapshot on which the sender's decision was based. The command is invalid
    after `valid_until`, a time on the runtime's own clock, which the sender extrapolates from that snapshot. `holder`
    and `epoch` identify the lease. `user` and `role` are the sender's claims, trusted only after runtime.ipc.identity
    has verified them. `vouched` names the arguments whose content an administrator wrote, whoever sends the command.
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
    """Answer to a command; `allowed` names the commands that would be accepted now."""

    uuid: str
    status: AckStatus
    reason: str = ""
    allowed: list[str] = field(default_factory=list)
    boot: str = ""
    sequence: int = 0
    data: Mapping[str, Any] = field(default_factory=dict)
    kind: str = ""  # of the answered command
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
    | ExecutedTick
    | MergeResult
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

# Wire types of an annotation: numpy scalars count as numbers, integers are valid floats.
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
    """Valid values of a field: instances of one of `classes`; if `words` is not empty, only the values in `words`."""

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
    """Return the message as bytes."""
    kind = type(message)
    return pack({"type": kind.__name__} | {name: getattr(message, name) for name in _FIELDS[kind]})


def decode(payload: bytes) -> Message:
    """Return the message in `payload`; unknown fields are ignored.

    Raises:
        CodecError: the message is invalid; the error names the invalid part.
    """
    content = unpack(payload)
    name = content.get("type") if isinstance(content, dict) else type(content).__name__
    if not isinstance(content, dict) or not isinstance(name, str) or name not in _TYPES:
        raise CodecError(f"message type {name!r} is unknown; known: {', '.join(_TYPES)}")
    kind = _TYPES[name]
    fields = {field_: content[field_] for field_ in _FIELDS[kind] if field_ in content}
    for field_, value in fields.items():
        if not _EXPECTED[kind][field_].admits(value):
            expected = _EXPECTED[kind][field_]
            raise CodecError(f"message {name}: {field_} = {value!r:.80}; expected {expected}")
    try:
        message: Message = kind(**fields)
    except (TypeError, ValueError) as error:
        raise CodecError(f"message {name}: {error}") from None
    return message


def event_row(event: Event) -> dict[str, Any]:
    """Return an event as a line of the episode's log."""
    return {
        "kind": event.kind,
        "text": event.text,
        "time": event.time,
        "step": event.step,
        "data": dict(event.data),
        **sentence_fields(event),
    }


def sentence_fields(message: Event | Ack) -> dict[str, Any]:
    """Return id and arguments of a message's sentence, for a row that contains its text; {} without an id."""
    return {"id": message.id, "arguments": message.arguments} if message.id else {}
