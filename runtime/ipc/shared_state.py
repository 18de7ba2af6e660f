"""Shared state of the station processes: observation, control's status, heartbeats, e-stop flag, rings, pictures.

Every part has one writer, see the table in docs/architecture.md; the e-stop flag may also be raised by the
coordinator.
"""

from __future__ import annotations

import functools
import mmap
import struct
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from runtime.core.sentences import Pattern, fixed
from runtime.core.types import Observation, UInt8
from runtime.ipc import shared_memory as memory
from runtime.ipc.bells import Bell
from runtime.ipc.shared_memory import Record, Ring, align_size

_FOR_SECONDS = Pattern("shared.for_seconds", "for {seconds:.1f} s")
_FOR_SECONDS_WHILE = Pattern("shared.for_seconds_while", "for {seconds:.1f} s, while {stage}")
_SINCE_RESTART = fixed("shared.since_restart", "since it was restarted")
_JOINTS_NOT_SEEN = fixed(
    "shared.joints_not_seen", "control has not received joint positions for long enough yet"
)

_LINE = 64
PICTURE_SLOTS = 12  # 0.4 s of a camera at 30 Hz: the longest that media may be late
RING_BYTES = {
    "orders": 1 << 20,  # the coordinator -> control: orders and chunks
    "minutes": 4 << 20,  # the coordinator -> media: begin, raw chunks, events, end
    "ticks": 4 << 20,  # control -> media: one record per tick
    "observations": 2 << 20,  # reception -> media: observations and events in order
    "source": 1 << 12,  # media -> reception: begin and end of a run of the source
    "control_events": 1 << 19,  # control -> the coordinator
    "reception_events": 1 << 19,  # reception -> the coordinator
    "media_events": 1 << 19,  # media -> the coordinator
    "presses": 1 << 14,  # the coordinator -> guard: e-stop presses that reached the coordinator
}
# Processes that sleep, with the rings that wake each. Control and reception have their own timing; media reads
# the ring of ticks whenever it reads observations.
WOKEN = {
    "coordinator": ("control_events", "reception_events", "media_events"),
    "media": ("minutes", "observations"),
    "guard": ("presses",),
}
JOINT_PROBLEM_BYTES = 200
PROCESSES = ("control", "coordinator", "reception", "media", "guard")


class RecorderStage(IntEnum):
    """Current work of the recorder, which may explain a missing heartbeat."""

    WAITING = 0
    OPENING = 1
    WRITING = 2
    CLOSING = 3


_STAGES = {
    RecorderStage.OPENING: fixed("shared.opening_an_episode", "opening an episode"),
    RecorderStage.WRITING: fixed("shared.writing_an_episode", "writing an episode"),
    RecorderStage.CLOSING: fixed("shared.closing_an_episode", "closing an episode"),
}


class EStop(IntEnum):
    """State of the e-stop, as set by the guard.

    It is UNKNOWN until the guard has read its latch. Commands are sent only if it is CLEAR.
    """

    UNKNOWN = 0
    CLEAR = 1
    LATCHED = 2


_ESTOPS = tuple(EStop)


_OPTIONAL = ("qvel", "effort", "eef", "reported_action", "reported_action_eef", "environment_state")


@functools.cache  # cache: every observation asks
def _observation_dtype(d: int, e: int, c: int, v: int) -> np.dtype[np.void]:
    return np.dtype(
        [
            ("sequence", "i8"),
            ("arrived", "f8"),
            ("joints_captured", "f8"),
            ("eef_captured", "f8"),
            ("has", "u1", 6),  # the members of _OPTIONAL
            ("last", "u1"),
            ("qpos", "f4", d),
            ("qvel", "f4", d),
            ("effort", "f4", d),
            ("eef", "f4", e),
            ("reported_action", "f4", d),
            ("reported_action_eef", "f4", e),
            ("environment_state", "f8", v),
            ("picture_captured", "f8", c),
            ("picture_number", "i8", c),  # per camera; slot = number % PICTURE_SLOTS, 0 = none yet
        ]
    )


@dataclass(frozen=True, slots=True)
class SharedStateLayout:
    """Sizes that determine the form of the shared state; they are the same in all station processes."""

    dim: int
    eef_dim: int
    cameras: tuple[str, ...]
    picture_bytes: int = 1920 * 1080 * 3
    vector: int = 0  # width of a benchmark's own observation vector

    def observation_dtype(self) -> np.dtype[np.void]:
        """Return the type of the newest observation, with the slot numbers of its pictures."""
        return _observation_dtype(
            self.dim, max(self.eef_dim, 1), max(len(self.cameras), 1), max(self.vector, 1)
        )

    def control_dtype(self) -> np.dtype[np.void]:
        """Return the type of control's status: its last tick and its timing."""
        return np.dtype(
            [
                ("step", "i8"),
                ("planned", "f8"),
                ("sequence", "i8"),  # Observation.sequence used by tick `step`
                ("order", "i8"),  # number of the newest order obeyed
                ("run", "i8"),
                ("behaviour", "S12"),
                ("remaining", "i8"),  # steps on the timeline after this one
                ("engaged", "u1"),  # commands are sent each tick
                ("moving", "u1"),
                ("estop_obeyed", "u1"),
                ("commanded", "f4", self.dim),
                ("velocity", "f4", self.dim),
                (
                    "smoothed",
                    "f4",
                    self.dim,
                ),  # action before safety; NaN if there was none
                ("chunk", "i8"),  # chunk with the largest weight in this step, -1 if there is none
                ("chunks", "i8"),  # number of chunks that contribute to this step
                ("limited", "u1"),  # safety changed or refused the action of this step
                ("waiting", "u1"),  # a run is open, nothing is planned, and that is expected
                ("starved", "u1"),  # a run is open, nothing is planned, and that is not expected
                ("simulated", "f4", self.dim),  # the robot of a simulated run; NaN if there is none
                ("believed", "u1"),  # the joints are measured, fresh and plausible
                (
                    "doubt",
                    f"S{JOINT_PROBLEM_BYTES}",
                ),  # why they are implausible, or away from the commanded position
                ("locked", "f4", self.dim),  # positions of locked grippers; NaN elsewhere
                ("ticks", "i8"),
                ("missed", "i8"),
                ("refused_in_row", "i8"),
                ("lateness_p50", "f8"),
                ("lateness_p99", "f8"),
                ("lateness_p999", "f8"),
                ("lateness_max", "f8"),
                ("records_lost", "i8"),
                ("scheduling", "S24"),
            ]
        )


class SharedState:
    """Shared memory of a station's processes, or of a lockstep run in one process."""

    def __init__(self, layout: SharedStateLayout, shared: mmap.mmap) -> None:
        self.layout = layout
        self._shared = shared
        self.bells: dict[str, Bell] = {}  # by process that sleeps; empty if all run in one process
        offset = 0
        self._beats = {
            name: memory.float64_view(shared, _LINE * index) for index, name in enumerate(PROCESSES)
        }
        offset += _LINE * len(PROCESSES)
        self._generations = {
            name: memory.int64_view(shared, _LINE * index + 8) for index, name in enumerate(PROCESSES)
        }
        self._stage = memory.int64_view(shared, _LINE * PROCESSES.index("media") + 16)
        self._estop = offset
        self._release = memory.int64_view(shared, offset + 8)
        self._unrecorded = memory.int64_view(shared, offset + 16)
        offset += _LINE
        self.observation = Record(shared, offset, layout.observation_dtype())
        offset += Record.size(layout.observation_dtype())
        self.control = Record(shared, offset, layout.control_dtype())
        offset += Record.size(layout.control_dtype())
        self.rings: dict[str, Ring] = {}
        for name, capacity in RING_BYTES.items():
            self.rings[name] = Ring(shared, offset, capacity)
            offset += Ring.size(capacity)
        self.pictures = {}
        for camera in layout.cameras if len(shared) >= self.size(layout) else ():
            self.pictures[camera] = PictureSlots(shared, offset, layout.picture_bytes)
            offset += PictureSlots.size(layout.picture_bytes)

    @classmethod
    def size(cls, layout: SharedStateLayout) -> int:
        """Return the size of the shared file [bytes]; picture slots are sparse, so memory is used on first write."""
        pictures = len(layout.cameras) * PictureSlots.size(layout.picture_bytes)
        return cls._size_of_numbers(layout) + pictures

    @staticmethod
    def _size_of_numbers(layout: SharedStateLayout) -> int:
        fixed = _LINE * (len(PROCESSES) + 1)
        fixed += Record.size(layout.observation_dtype()) + Record.size(layout.control_dtype())
        return fixed + sum(Ring.size(capacity) for capacity in RING_BYTES.values())

    @classmethod
    def create(cls, layout: SharedStateLayout) -> tuple[SharedState, int]:
        """Create a shared state; return it and the descriptor that children inherit."""
        descriptor = memory.create(cls.size(layout))
        return cls(layout, memory.attach(descriptor)), descriptor

    @classmethod
    def attach(cls, layout: SharedStateLayout, descriptor: int, pictures: bool = True) -> SharedState:
        """Attach to the shared state behind an inherited descriptor.

        If `pictures` is False, everything but the picture slots is mapped, for a process that locks its memory
        (control).
        """
        return cls(layout, memory.attach(descriptor, 0 if pictures else cls._size_of_numbers(layout)))

    def hang(self, bells: Sequence[Bell]) -> None:
        """Install the bells that wake sleeping processes, in the order of WOKEN."""
        self.bells = dict(zip(WOKEN, bells, strict=True))
        for process, rings in WOKEN.items():
            for ring in rings:
                self.rings[ring].bell = self.bells[process]

    def _wake(self, process: str) -> None:
        if (bell := self.bells.get(process)) is not None:
            bell.ring()

    def beat(self, process: str, now: float) -> None:
        """Record a heartbeat of `process` at `now` (our monotonic clock)."""
        self._beats[process][0] = now

    def last_beat(self, process: str) -> float:
        """Return the time of the last heartbeat of `process`; 0 = never."""
        return float(self._beats[process][0])

    def alive(self, process: str, now: float, within: float) -> bool:
        """Return True if the last heartbeat of `process` is at most `within` seconds old."""
        return now - self.last_beat(process) <= within

    def describe_silence(self, process: str, now: float) -> str:
        """Return how long `process` has had no heartbeat at `now`, as the end of a sentence."""
        beat = self.last_beat(process)
        if not beat:
            return _SINCE_RESTART
        stage = _STAGES.get(RecorderStage(self._stage[0])) if process == "media" else None
        if stage is None:
            return _FOR_SECONDS(seconds=now - beat)
        return _FOR_SECONDS_WHILE(seconds=now - beat, stage=stage)

    @contextmanager
    def recorder_stage(self, stage: RecorderStage) -> Iterator[None]:
        """Publish `stage` as the recorder's current work while the context is open; for media only."""
        before = self._stage[0]
        self._stage[0] = stage
        try:
            yield
        finally:
            self._stage[0] = before

    def generation(self, process: str) -> int:
        """Return the number of starts of `process`; a change means that it died and was restarted."""
        return int(self._generations[process][0])

    def set_generation(self, process: str, count: int) -> None:
        """Set the number of starts of `process`; for the supervisor only."""
        self._generations[process][0] = count
        if process == "media":  # the stage of its predecessor is void
            self._stage[0] = RecorderStage.WAITING

    @property
    def releases(self) -> int:
        """Number of times that the coordinator has requested a release of the latch."""
        return int(self._release[0])

    def request_release(self) -> None:
        """Request a release of the e-stop. The guard then clears the latch on disk and the e-stop flag.

        Only the coordinator may call this.
        """
        self._release[0] = self.releases + 1
        self._wake("guard")

    @property
    def unrecorded(self) -> bool:
        """True while media does not need tick records."""
        return bool(self._unrecorded[0])

    def set_unrecorded(self, unrecorded: bool) -> None:
        """Set whether media needs no tick records; for media only."""
        self._unrecorded[0] = unrecorded

    @property
    def estop(self) -> EStop:
        """State of the e-stop; control reads it before every send."""
        return _ESTOPS[self._shared[self._estop]]

    def set_estop(self, state: EStop) -> None:
        """Set the e-stop flag.

        Only the guard clears it; the coordinator may latch it for a press that reached its own socket.
        """
        self._shared[self._estop] = int(state)
        self._wake("coordinator")

    @property
    def joint_problem(self) -> str:
        """Reason why no motion may begin, from control's status of the joints; "" if it may."""
        status = self.control.read()
        doubt = bytes(status["doubt"]).decode(errors="ignore")
        return doubt or ("" if status["believed"] else _JOINTS_NOT_SEEN)

    def publish_observation(self, observation: Observation, pictures: Mapping[str, int]) -> None:
        """Publish an observation with the number of each camera's newest picture; for reception only."""
        record = np.zeros((), self.layout.observation_dtype())
        record["sequence"], record["arrived"] = observation.sequence, observation.arrived
        record["joints_captured"] = observation.captured.get("joints", observation.arrived)
        record["eef_captured"] = observation.captured.get("eef", np.nan)
        record["last"] = observation.last
        record["qpos"] = observation.qpos
        for index, name in enumerate(_OPTIONAL):
            value = getattr(observation, name)
            if name == "environment_state" and np.shape(value) != (self.layout.vector,):
                continue  # of a node whose bench declares none
            if value is not None:
                record["has"][index] = 1
                record[name] = value
        for index, camera in enumerate(self.layout.cameras):
            record["picture_captured"][index] = observation.captured.get(camera, np.nan)
            record["picture_number"][index] = pictures.get(camera, 0)
        self.observation.write(record)

    def read_observation(self, cameras: Sequence[str]) -> Observation | None:
        """Return the newest observation with copies of the pictures of `cameras`; None before the first.

        If a picture was overwritten during the copy, the newest observation is read again.

        Raises:
            TornReadError: this happened five times.
        """
        for _ in range(5):
            record = self.observation.read()
            if record["sequence"] == 0:
                return None
            pictures = self._pictures_of(record, cameras)
            if pictures is not None:
                return self._observation(record, pictures)
        raise memory.TornReadError("pictures were overwritten five times while being copied")

    def _pictures_of(self, record: np.void, cameras: Sequence[str]) -> dict[str, UInt8] | None:
        pictures = {}
        for camera in cameras:
            number = int(record["picture_number"][self.layout.cameras.index(camera)])
            if number == 0:
                continue
            picture = self.pictures[camera].read(number)
            if picture is None:
                return None
            pictures[camera] = picture
        return pictures

    def _observation(self, record: np.void, pictures: dict[str, UInt8]) -> Observation:
        optional = {
            name: np.array(record[name]) if record["has"][index] else None
            for index, name in enumerate(_OPTIONAL)
        }
        captured = {"joints": float(record["joints_captured"])}
        if record["has"][2]:
            captured["eef"] = float(record["eef_captured"])
        for index, camera in enumerate(self.layout.cameras):
            if record["picture_number"][index]:
                captured[camera] = float(record["picture_captured"][index])
        return Observation(
            sequence=int(record["sequence"]),
            arrived=float(record["arrived"]),
            captured=captured,
            qpos=np.array(record["qpos"]),
            pictures=pictures,
            last=bool(record["last"]),
            **optional,  # type: ignore[arg-type]  # names and types are those of Observation
        )


class PictureSlots:
    """Slots with the newest pictures of one camera; a reader detects if its slot is overwritten during a read."""

    _SHAPE = struct.Struct("@iii")  # height, width, channels

    def __init__(self, shared: mmap.mmap, offset: int, picture_bytes: int) -> None:
        self._shared = shared
        self._bytes = picture_bytes
        stride = _LINE + align_size(picture_bytes)
        self._at = [offset + slot * stride for slot in range(PICTURE_SLOTS)]
        self._begun = [memory.int64_view(shared, at) for at in self._at]
        self._done = [memory.int64_view(shared, at + 8) for at in self._at]

    @staticmethod
    def size(picture_bytes: int) -> int:
        """Return the bytes that the slots of one camera need in the shared file."""
        return PICTURE_SLOTS * (_LINE + align_size(picture_bytes))

    @property
    def newest(self) -> int:
        """Largest picture number whose write has begun, complete or not; 0 before the first."""
        return max(int(begun[0]) for begun in self._begun)

    def write(self, number: int, picture: UInt8) -> None:
        """Store `picture` as number `number` (counted from 1).

        Raises:
            ValueError: the picture is too large for a slot.
        """
        if picture.nbytes > self._bytes:
            raise ValueError(f"picture of {picture.nbytes} bytes {picture.shape}; at most {self._bytes} fit")
        slot = number % PICTURE_SLOTS
        # `_begun` is set before the pixels and `_done` after them; a reader accepts a picture only if `_done`
        # has its number before the copy, and `_begun` still has it after the copy.
        self._begun[slot][0] = number
        self._SHAPE.pack_into(self._shared, self._at[slot] + 16, *picture.shape)
        view = np.frombuffer(self._shared, np.uint8, picture.nbytes, self._at[slot] + _LINE)
        view[:] = picture.reshape(-1)
        self._done[slot][0] = number

    def shape(self, number: int) -> tuple[int, int] | None:
        """Return height and width of picture `number`; None if it has been overwritten."""
        slot = number % PICTURE_SLOTS
        if self._done[slot][0] != number:
            return None
        height, width, _ = self._SHAPE.unpack_from(self._shared, self._at[slot] + 16)
        return (height, width) if self._begun[slot][0] == number else None

    def read(self, number: int) -> UInt8 | None:
        """Return a copy of picture `number`; None if it has been overwritten."""
        slot = number % PICTURE_SLOTS
        if self._done[slot][0] != number:
            return None
        height, width, channels = self._SHAPE.unpack_from(self._shared, self._at[slot] + 16)
        size = height * width * channels
        if self._begun[slot][0] != number:
            return None
        picture = np.frombuffer(self._shared, np.uint8, size, self._at[slot] + _LINE).copy()
        if self._begun[slot][0] != number:
            return None
        return picture.reshape(height, width, channels)
