"""Source of observations from a robot's topics: aligned in time and checked; silent topics are reported."""

from __future__ import annotations

import logging
import threading
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING

from runtime.core.clock import Clock
from runtime.core.errors import CodecError, ConfigurationError, TransportError
from runtime.core.sentences import Pattern, fixed, series
from runtime.core.types import Observation
from runtime.ipc.messages import Event
from runtime.transports.base import Source
from runtime.transports.frozen_cameras import FROZEN_S
from runtime.transports.ros.alignment import Aligned, Alignment, RosClock, Sample
from runtime.transports.ros.message_reading import Names, UnusableMessage
from runtime.transports.ros.messages import Message, Wire
from runtime.transports.ros.middleware import Match, Middleware, Quality, Topic
from runtime.transports.ros.observation_assembly import Assembly, MessageReaders, StampedValue
from runtime.transports.ros.topics import StreamSpec

if TYPE_CHECKING:
    from robots import Robot

log = logging.getLogger(__name__)
_PICTURES_DEPTH = 32  # [messages] of a camera; one second at 30 Hz
_HISTORY_S = 1.0
_LOOK_S = 0.5  # period of checks for the peers of silent topics [s]
_GRACE_S = 1.0  # time for publishers and us to find each other [s]
_BACK = Pattern(
    "ros.clock_back",
    "the clock that stamps {stream} went back: it was set, or its node was started anew",
)
_AHEAD = Pattern(
    "ros.clock_ahead",
    "the clock that stamps {stream} leapt ahead: it was set, or its node was started anew",
)
_FROZEN = Pattern("ros.frozen_picture", "{camera} shows the same picture for over {seconds:g} s")
_STAMPS_STAND = fixed("ros.stamps_stand", "its stamps do not advance")
_WAITING = Pattern("ros.waiting", "waiting for {streams}: {why}")
_SILENT = Pattern("ros.silent", "waiting for {stream} ({topic}): nothing for {seconds:.1f} s")
_UNUSABLE = Pattern("ros.unusable", "waiting for {stream} ({topic}): nothing usable for {seconds:.1f} s")
_BECAUSE = Pattern("ros.because", "{what}: {why}")
_NO_PUBLISHER = fixed("ros.no_publisher", "no publisher")
_APART = Pattern(
    "ros.apart",
    "no message of {apart} is within {skew:g} s of the newest of {slowest}, whose stamps are {behind:.2f} s "
    "behind the others': have the robot's computers one clock? (transport.max_skew_s)",
)


@dataclass(frozen=True, slots=True)
class Subscription:
    """Subscribed topic with the streams that its messages contain."""

    topic: Topic
    parts: tuple[StreamSpec, ...]


@dataclass(frozen=True, slots=True)
class AcceptanceLimits:
    """Limits within which messages are accepted."""

    skew: float  # window of the alignment [s]
    stalled: float  # time after which a stream counts as stalled [s]
    names: Names
    stamped: bool  # True: stamps of the senders count; False: arrival here
    detect_frozen: bool


class RosSource(Source):
    """Source of the newest frame of aligned messages; there is no frame while streams are too far apart.

    Messages are checked on the middleware's thread when they arrive, and faults are counted by name. Other readers may
    use the same `alignment`: reading removes nothing from it, and this source remembers its own last frame. Each reason
    why no frame arrives is reported once as an event.
    """

    _cursor: Aligned[StampedValue] | None  # last delivered frame
    _count: int
    _news: list[Event]

    def __init__(
        self,
        robot: Robot,
        heard: tuple[Subscription, ...],
        terms: AcceptanceLimits,
        clock: Clock,
        wire: Wire,
        open_middleware: Callable[[], Middleware],
    ) -> None:
        self._robot, self._heard, self._terms, self._clock = robot, heard, terms, clock
        self._wire, self._open = wire, open_middleware
        self._parts = tuple(part for subscription in heard for part in subscription.parts)
        self._topics = {
            part.name: subscription.topic for subscription in heard for part in subscription.parts
        }
        self._middleware: Middleware | None = None
        self._changed = threading.Condition()
        self._forget()

    def connect(self) -> None:
        """Subscribe to all topics. Publishers that start later are connected, too."""
        self.close()
        self._forget()
        self._began = self._framed_at = self._clock.now()
        self._middleware = self._open()
        for subscription in self._heard:
            self._middleware.subscribe(subscription.topic, self._make_callback(subscription))

    def receive(self, timeout: float) -> Observation | None:
        """Return the newest frame that was not delivered yet, as RGB; None after `timeout` [s] without one."""
        if self._middleware is None:
            raise TransportError("the ROS topics are not subscribed; connect before receiving")
        with self._changed:
            self._changed.wait_for(lambda: self.alignment.frame(self._cursor) is not None, timeout)
            aligned = self.alignment.frame(self._cursor)
            if aligned is not None:
                self._cursor = aligned
        if aligned is None:
            self._report_no_frame()
            return None
        self._count += 1
        self._framed_at = self._clock.now()
        try:
            observation = self._assembly.observation(self._count, aligned)
        except UnusableMessage as error:
            self._count_fault(error.fault, str(error))
            return None
        for camera in self._assembly.newly_frozen(self._clock.now()):
            self._count_fault(f"frozen_{camera}", _FROZEN(camera=camera, seconds=FROZEN_S))
        self._told.clear()
        return observation

    def close(self) -> None:
        """Stop listening."""
        if self._middleware is not None:
            self._middleware.close()
            self._middleware = None

    def faults(self) -> dict[str, int]:
        """Return the number of refused messages by reason, `stalled_<stream>`, `frozen_<camera>`, and clock jumps."""
        with self._changed:
            self._notice_stalls()
            counts = dict(self._faults)
            jumps = {"clock_backwards": self._ros.backwards, "clock_forwards": self._ros.forwards}
        return counts | {name: count for name, count in jumps.items() if count}

    def describe_fault(self, fault: str) -> str:
        """Return a sentence about the latest occurrence of a fault."""
        with self._changed:
            return self._sentences.get(fault, "")

    def pop_events(self) -> list[Event]:
        """Return events on why no frame arrives: streams are silent (with age and peers), or too far apart in time."""
        events, self._news = self._news, []
        return events

    def stalled(self) -> dict[str, float]:
        """Return for each stalled stream the age of its newest usable message [s].

        A stream stalls if it has had no usable message for too long. If it never had one, the age is the time since
        `connect`.
        """
        now, began = self._clock.now(), self._began
        ages = {part.name: now - self._heard_at.get(part.name, began + _GRACE_S) for part in self._parts}
        return {
            name: age if name in self._heard_at else age + _GRACE_S
            for name, age in ages.items()
            if age > self._terms.stalled
        }

    def _forget(self) -> None:
        self._ros = RosClock()
        names = [part.name for part in self._parts]
        self.alignment: Alignment[StampedValue] = Alignment(
            names,
            self._terms.skew,
            max(_HISTORY_S, 2 * self._terms.skew),
            {part.name: _PICTURES_DEPTH for part in self._parts if part.kind == "camera"},
        )
        self._readers = MessageReaders(self._robot, self._parts, self._terms.names)
        self._assembly = Assembly(self._robot, self._parts, self._terms.detect_frozen)
        self._faults: Counter[str] = Counter()
        self._sentences: dict[str, str] = {}  # newest sentence by fault
        self._refusals: dict[
            str, tuple[str, str]
        ] = {}  # by stream: fault and sentence of an unusable newest message
        self._heard_at: dict[str, float] = {}
        self._stalled: set[str] = set()
        self._told: set[str] = set()
        self._news = []
        self._cursor = None
        self._count = 0
        self._began = self._framed_at = self._look_at = 0.0

    def _make_callback(self, subscription: Subscription) -> Callable[[bytes], None]:
        def take(payload: bytes) -> None:
            arrived = self._clock.now()
            try:
                message = self._wire.decode(subscription.topic.message, payload)
            except CodecError as error:
                self._count_fault(
                    "malformed",
                    f"{subscription.topic.name}: {error}",
                    *(part.name for part in subscription.parts),
                )
                return
            for part in subscription.parts:
                self._store_message(part, message, arrived)

        return take

    def _store_message(self, part: StreamSpec, message: Message, arrived: float) -> None:
        """Decode and store one message; any error in it is counted and does not end the thread."""
        try:
            value = self._readers.read(part, message)
            stamp = self._stamp(message, arrived)
        except UnusableMessage as error:
            self._count_fault(error.fault, f"{part.topic}: {error}", part.name)
            return
        except Exception as error:
            log.exception("reading %s failed", part.topic)
            self._count_fault("reader_failed", f"{part.topic}: {type(error).__name__}: {error}", part.name)
            return
        with self._changed:
            before, leaps = self._ros.backwards, self._ros.forwards
            monotonic_stamp = self._ros.to_monotonic(part.name, stamp, arrived)
            if self._ros.backwards > before:
                self.alignment.clear()
                self._cursor = None
                self._sentences["clock_backwards"] = _BACK(stream=part.name)
            if self._ros.forwards > leaps:
                self._sentences["clock_forwards"] = _AHEAD(stream=part.name)
            if self.alignment.add(part.name, Sample(stamp, arrived, StampedValue(value, monotonic_stamp))):
                self._heard_at[part.name] = arrived
                self._refusals.pop(part.name, None)
                self._changed.notify_all()
            else:
                self._faults["not_newer"] += 1
                text = self._sentences["not_newer"] = _STAMPS_STAND
                self._refusals[part.name] = ("not_newer", text)

    def _stamp(self, message: Message, arrived: float) -> float:
        if not self._terms.stamped:
            return arrived
        if message.stamp <= 0:
            raise UnusableMessage(
                "unstamped",
                'its header has no stamp; let the driver set it, or say transport.stamps = "arrival"',
            )
        return message.stamp * 1e-9

    def _notice_stalls(self) -> None:
        """Count each stream that has stalled since the last call."""
        now = self.stalled()
        for name in now.keys() - self._stalled:
            fault = f"stalled_{name.replace(' ', '_')}"
            self._faults[fault] += 1
            self._sentences[fault] = self._silence(name, now[name], Match(1))
        self._stalled = set(now)

    def _report_no_frame(self) -> None:
        """Report why no frame arrives, once per reason; streams that are only briefly delayed are not reported."""
        with self._changed:
            stalled = self.stalled()
            apart = (
                [] if stalled or self._waited() <= self._terms.stalled else self.alignment.unaligned_streams()
            )
        if apart and "apart" not in self._told:
            self._told.add("apart")
            self._emit(self._distance(apart))
        if not stalled or (
            self._clock.now() < self._look_at and self._told.issuperset(self._reasons(stalled))
        ):
            return
        assert self._middleware is not None
        self._look_at = self._clock.now() + _LOOK_S
        try:
            matches = self._middleware.matches()
        except TransportError as error:
            log.warning("%s", error)
            matches = {}
        stalled_matches = {name: matches.get(self._topics[name].name, Match(1)) for name in stalled}
        causes = {
            name: {self._reason(name), f"{name}: {stalled_matches[name].refused}"} for name in stalled_matches
        }
        fresh = {name: stalled_matches[name] for name in stalled_matches if not causes[name] <= self._told}
        for name in fresh:
            self._told |= causes[name]
        shared = {match.refused for match in fresh.values()}
        if len(fresh) > 1 and len(shared) == 1 and any(shared) and not fresh.keys() & self._refusals.keys():
            self._emit(_WAITING(streams=", ".join(fresh), why=shared.pop()))
        elif fresh:
            self._emit(series([self._silence(name, stalled[name], match) for name, match in fresh.items()]))

    def _emit(self, sentence: str) -> None:
        self._news.append(Event("source_waiting", sentence, self._clock.now()))

    def _waited(self) -> float:
        return self._clock.now() - self._framed_at

    def _reasons(self, names: Iterable[str]) -> set[str]:
        return {self._reason(name) for name in names}

    def _reason(self, name: str) -> str:
        """Return a text that identifies the reason for a stream's silence; each reason is reported once.

        The text consists of the stream's name and the fault for which its messages are refused, if they are refused.
        """
        return f"{name}: {self._refusals.get(name, ('', ''))[0]}"

    def _silence(self, name: str, age: float, match: Match) -> str:
        topic = self._topics[name].name
        refusal = self._refusals.get(name)
        reason = match.refused or ("" if match.peers else _NO_PUBLISHER)
        if refusal is not None:
            reason = refusal[1]
        text = (_SILENT if refusal is None else _UNUSABLE)(stream=name, topic=topic, seconds=age)
        return _BECAUSE(what=text, why=reason) if reason else text

    def _distance(self, apart: list[str]) -> str:
        newest = {part.name: self.alignment.newest(part.name) for part in self._parts}
        stamps = {name: sample.stamp for name, sample in newest.items() if sample is not None}
        slowest = min(stamps, key=lambda name: stamps[name])
        behind = max(stamps.values()) - stamps[slowest]
        return _APART(apart=", ".join(apart), skew=self._terms.skew, slowest=slowest, behind=behind)

    def _count_fault(self, fault: str, text: str, *streams: str) -> None:
        with self._changed:
            self._faults[fault] += 1
            self._sentences[fault] = text
            for stream in streams:
                self._refusals[stream] = (fault, text)


def subscriptions(
    parts: tuple[StreamSpec, ...], quality: Callable[[str], Quality]
) -> tuple[Subscription, ...]:
    """Return one subscription per topic, with all streams in its messages: groups may share one, e.g. /joint_states.

    Raises ConfigurationError if the streams of one topic need different message types.
    """
    by_topic: dict[str, list[StreamSpec]] = defaultdict(list)
    for part in parts:
        by_topic[part.topic].append(part)
    for topic, topic_parts in by_topic.items():
        kinds = sorted({part.message for part in topic_parts})
        if len(kinds) > 1:
            names = ", ".join(part.name for part in topic_parts)
            raise ConfigurationError(
                f"transport: {topic} is the topic of {names}, which are {' and '.join(kinds)}; "
                "allowed: one type of message per topic"
            )
    return tuple(
        Subscription(Topic(topic, topic_parts[0].message, quality(topic)), tuple(topic_parts))
        for topic, topic_parts in by_topic.items()
    )
