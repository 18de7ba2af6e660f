"""Messages between a station's computer and its lab, and which releases of the two understand each other.

A message is a header, a msgpack map of its fields with its name under "kind", and parts that the header speaks of.
Unknown fields are ignored and missing ones have defaults, so that neighbouring releases talk. Nothing here raises
anything but CodecError, whatever comes in.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import MISSING, dataclass, field, fields
from typing import Any, get_args, get_origin, get_type_hints

import msgpack  # type: ignore[import-untyped]

from runtime.core.errors import CodecError

# The number of this release as far as the link is concerned: counted up by each release that changes it. Neighbours
# work with each other: the recorded messages of both are in tests/runtime/link/recorded.
RELEASE = 1
STOPS, COMMANDS, STATE, PICTURES, EPISODES = "stops", "commands", "state", "pictures", "episodes"
ROLES = (
    STOPS,
    COMMANDS,
    STATE,
    PICTURES,
    EPISODES,
)  # a station's connections: the first two to the first port
GUARD, COORDINATOR, MEDIA = (
    "guard",
    "coordinator",
    "media",
)  # processes of a station that the lab sees through it
# Seconds. A link of which nothing is heard for LOST is lost; pages need another 0.4 to say so, of 1.5 that they have.
BEAT_S, LOST_S = 0.15, 0.9
# Of the connection for episodes: what it carries may be before a beat, on a line of 1 Mbit/s for seconds.
LOST_EPISODES_S = 10.0
LARGEST_HEADER = 4096  # bytes
LARGEST_ANSWER = 4 << 20  # bytes of one message at the first port: what a station answers, all its events
LARGEST_PICTURE = 4 << 20  # bytes of one part at the second port
PIECE = 64 << 10  # bytes of an episode's file in one message
MOST_PARTS = 64
_MOST_WORDS = 64  # of a list in a header


@dataclass(frozen=True, slots=True)
class Hello:
    """First message of each connection of a station; `session` is the same in all of one link's."""

    release: int
    version: str
    station: str
    role: str
    session: bytes


@dataclass(frozen=True, slots=True)
class Welcome:
    """The lab's answer: who it is."""

    release: int
    version: str


@dataclass(frozen=True, slots=True)
class Bye:
    """Why the other end hears nothing more over this connection, and after how long it may try again."""

    why: str
    again_s: float = 30.0


@dataclass(frozen=True, slots=True)
class Beat:
    """A sign of life, of either end: the station's has its newest challenge, over the commands' connection also which
    of its processes listen."""

    challenge: bytes = b""
    listening: list[str] = field(default_factory=list)


@dataclass(frozen=True, slots=True)
class Ask:
    """A command for a socket of the station, which is the part that follows.

    `challenge`, `serial` and `signature` are its token, all empty where the lab knows no user. `stops`: it is passed on
    whatever its token is worth, for the station itself to judge.
    """

    number: int
    process: str
    socket: str
    stops: bool = False
    challenge: bytes = b""
    serial: int = 0
    signature: bytes = b""


@dataclass(frozen=True, slots=True)
class Answer:
    """The station's answer to the `Ask` of that number, which is the part that follows; or why there is none."""

    number: int
    failure: str = ""


@dataclass(frozen=True, slots=True)
class Credit:
    """So many more bundles may be sent over this connection, of streams whose names begin with a word of `wanted`."""

    count: int
    wanted: list[str] = field(default_factory=list)


@dataclass(frozen=True, slots=True)
class Bundle:
    """The newest of streams, a part each."""

    streams: list[str]


@dataclass(frozen=True, slots=True)
class Offer:
    """A closed episode that the station has: the part that follows lists its files (`contents.py`)."""

    episode: str


@dataclass(frozen=True, slots=True)
class Want:
    """The lab lacks so many bytes of that file of the episode, from `offset` on."""

    episode: str
    file: str
    offset: int
    count: int


@dataclass(frozen=True, slots=True)
class Piece:
    """They are the part that follows; empty where the station's file has no such bytes any more."""

    episode: str
    file: str
    offset: int


@dataclass(frozen=True, slots=True)
class Labels:
    """What people have said of the episode at the station so far is the part that follows: the lines of its file."""

    episode: str


@dataclass(frozen=True, slots=True)
class Arrived:
    """The lab has it, and has compared it with its digest: of the list of an `Offer`, or of the lines of `Labels`."""

    episode: str
    digest: str


@dataclass(frozen=True, slots=True)
class Declined:
    """The lab does not take what was offered of that episode, and why; the station may offer it again after so long."""

    episode: str
    why: str
    again_s: float = 60.0


@dataclass(frozen=True, slots=True)
class Enrol:
    """A computer asks to be a station, with the one-time code that the lab's administration has shown."""

    release: int
    version: str
    code: bytes
    computer: str = ""


@dataclass(frozen=True, slots=True)
class Enrolled:
    """It is: under this name, at this lab, whose tokens this key verifies; pictures go to the second port."""

    station: str
    lab: str
    tokens: bytes
    second_port: int


Message = (
    Hello
    | Welcome
    | Bye
    | Beat
    | Ask
    | Answer
    | Credit
    | Bundle
    | Offer
    | Want
    | Piece
    | Labels
    | Arrived
    | Declined
    | Enrol
    | Enrolled
)
_KINDS: dict[str, type[Any]] = {kind.__name__: kind for kind in Message.__args__}
_TYPES = {kind: get_type_hints(kind) for kind in _KINDS.values()}


def write(message: Message, *parts: bytes) -> list[bytes]:
    """The message as the frames that are sent."""
    content = {one.name: getattr(message, one.name) for one in fields(message)}
    packed: bytes = msgpack.packb({"kind": type(message).__name__, **content})
    return [packed, *parts]


def read(frames: Sequence[bytes]) -> tuple[Message, list[bytes]]:
    """The message that came, and its parts; raises CodecError."""
    if not frames or len(frames) > MOST_PARTS + 1 or len(frames[0]) > LARGEST_HEADER:
        raise CodecError(f"{len(frames)} frames, the first of {len(frames[0]) if frames else 0} bytes")
    content = _unpacked(frames[0])
    name = content.get("kind")
    kind = _KINDS.get(name) if isinstance(name, str) else None
    if kind is None:
        named = f"{name!r:.40}" if isinstance(name, str) else type(name).__name__
        raise CodecError(f"a message of the kind {named}; known: {', '.join(_KINDS)}")
    message: Message = kind(**_fields(kind, content))
    return message, list(frames[1:])


def _unpacked(header: bytes) -> dict[Any, Any]:
    try:
        content = msgpack.unpackb(header, strict_map_key=False)
    except (
        ValueError,
        TypeError,
        OverflowError,
        RecursionError,
        msgpack.exceptions.UnpackException,
    ) as error:
        raise CodecError(f"a header of {len(header)} bytes cannot be read: {type(error).__name__}") from None
    if not isinstance(content, dict):
        raise CodecError(f"a header that is a {type(content).__name__}; expected a map")
    return content


def _fields(kind: type[Any], content: dict[Any, Any]) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for one in fields(kind):
        if one.name in content:
            value = content[one.name]
            if not _fits(value, _TYPES[kind][one.name]):
                raise CodecError(f"{kind.__name__}: {one.name} is no such {type(value).__name__}")
            found[one.name] = value
        elif one.default is MISSING and one.default_factory is MISSING:
            raise CodecError(f"{kind.__name__} without {one.name}")
    return found


def _fits(value: object, wanted: Any) -> bool:
    if get_origin(wanted) is list:
        (inner,) = get_args(wanted)
        return (
            isinstance(value, list) and len(value) <= _MOST_WORDS and all(type(one) is inner for one in value)
        )
    return type(value) is wanted or (wanted is float and type(value) is int)


def apart(theirs: int, version: str, station: str, lab_side: bool) -> str:
    """Why the other end's release does not go with this one, naming both; "" where it does."""
    if abs(theirs - RELEASE) <= 1:
        return ""
    from runtime.link.release import version as our_version

    lab, robot = (our_version(), version) if lab_side else (version, our_version())
    numbers = (RELEASE, theirs) if lab_side else (theirs, RELEASE)
    return (
        f"the lab has release {numbers[0]} of the link (version {lab:.40}), the computer of {station} release "
        f"{numbers[1]} (version {robot:.40}): they work one apart; update the older one"
    )
