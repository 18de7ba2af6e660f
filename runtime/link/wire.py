"""Messages between a station's computer and its lab, and the compatibility of their releases.

A message is a header and the parts that it describes. The header is a msgpack map of the fields, with the name of the
message under "kind". Unknown fields are ignored and missing fields have defaults, so that neighbouring releases can
communicate. Whatever is received, only CodecError is raised.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import MISSING, dataclass, field, fields
from typing import Any, get_args, get_origin, get_type_hints

import msgpack  # type: ignore[import-untyped]

from runtime.core.errors import CodecError

# Protocol number, increased by each release that changes the link. Neighbouring numbers are compatible; recorded
# messages of both are in tests/runtime/link/recorded.
RELEASE = 1
STOPS, COMMANDS, STATE, PICTURES, EPISODES = "stops", "commands", "state", "pictures", "episodes"
ROLES = (
    STOPS,
    COMMANDS,
    STATE,
    PICTURES,
    EPISODES,
)  # roles of a station's connections; the first two use the first port
GUARD, COORDINATOR, MEDIA = (
    "guard",
    "coordinator",
    "media",
)  # station processes that the link mirrors at the lab
# [s]. A link that is silent for LOST_S is lost; pages show that 0.4 s later, and have to within 1.5 s.
BEAT_S, LOST_S = 0.15, 0.9
# [s], for the connection of episodes: on a line of 1 Mbit/s its data can delay a beat for seconds.
LOST_EPISODES_S = 10.0
LARGEST_HEADER = 4096  # bytes
LARGEST_ANSWER = 4 << 20  # bytes of a message at the first port: a station's answer with all its events
LARGEST_PICTURE = 4 << 20  # bytes of one part at the second port
PIECE = 64 << 10  # bytes of an episode's file in one message
MOST_PARTS = 64
_MOST_WORDS = 64  # entries of a list in a header


@dataclass(frozen=True, slots=True)
class Hello:
    """First message of each connection of a station; `session` is the same for all connections of one link."""

    release: int
    version: str
    station: str
    role: str
    session: bytes


@dataclass(frozen=True, slots=True)
class Welcome:
    """Answer of the lab to `Hello`, with its release and version."""

    release: int
    version: str


@dataclass(frozen=True, slots=True)
class Bye:
    """Message before a connection is closed: reason, and pause before the next attempt [s]."""

    why: str
    again_s: float = 30.0


@dataclass(frozen=True, slots=True)
class Beat:
    """Sign of life of either end; that of the station carries its newest challenge.

    On the connection for commands it also lists the station processes that listen.
    """

    challenge: bytes = b""
    listening: list[str] = field(default_factory=list)


@dataclass(frozen=True, slots=True)
class Ask:
    """Command for a socket of the station; the payload is the part that follows.

    `challenge`, `serial` and `signature` are its token, empty if the lab has not verified a user. `stops`: the command
    is a stop, which is passed on to the station's socket even with an invalid token.
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
    """Answer of the station to the `Ask` with that number.

    The part that follows is the answer; if there is none, `failure` is the reason.
    """

    number: int
    failure: str = ""


@dataclass(frozen=True, slots=True)
class Credit:
    """Permission to send `count` more bundles, of streams whose names start with an entry of `wanted`."""

    count: int
    wanted: list[str] = field(default_factory=list)


@dataclass(frozen=True, slots=True)
class Bundle:
    """Newest message of each of the streams `streams`.

    The messages follow as parts of the ZMQ message, one for each stream, in the order of `streams`.
    """

    streams: list[str]


@dataclass(frozen=True, slots=True)
class Offer:
    """Closed episode that the station has; the part that follows lists its files (`contents.py`)."""

    episode: str


@dataclass(frozen=True, slots=True)
class Want:
    """Request for `count` bytes of a file of the episode, from `offset` on."""

    episode: str
    file: str
    offset: int
    count: int


@dataclass(frozen=True, slots=True)
class Piece:
    """Answer to a `Want`: the next part of the message has the bytes; it is empty if the station cannot read them."""

    episode: str
    file: str
    offset: int


@dataclass(frozen=True, slots=True)
class Labels:
    """Message with the labels of an episode that is at the station.

    The part that follows the message contains the lines of the episode's label file.
    """

    episode: str


@dataclass(frozen=True, slots=True)
class Arrived:
    """Confirmation that the lab has verified an episode or the labels of an episode.

    `digest` is the digest of the offered list of files, or of the lines of the labels.
    """

    episode: str
    digest: str


@dataclass(frozen=True, slots=True)
class Declined:
    """Answer that the lab does not accept an offered episode or its labels.

    The station may offer it again after `again_s` [s].
    """

    episode: str
    why: str
    again_s: float = 60.0


@dataclass(frozen=True, slots=True)
class Enrol:
    """Request of a computer to become a station, with the one-time code that the lab's administration shows."""

    release: int
    version: str
    code: bytes
    computer: str = ""


@dataclass(frozen=True, slots=True)
class Enrolled:
    """Answer to a successful `Enrol`: name of the station and the lab, key that verifies tokens, port for pictures."""

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
    """Return the frames of a message."""
    content = {message_field.name: getattr(message, message_field.name) for message_field in fields(message)}
    packed: bytes = msgpack.packb({"kind": type(message).__name__, **content})
    return [packed, *parts]


def read(frames: Sequence[bytes]) -> tuple[Message, list[bytes]]:
    """Return the message in the frames, and its parts. Raises: CodecError."""
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
    values: dict[str, Any] = {}
    for message_field in fields(kind):
        if message_field.name in content:
            value = content[message_field.name]
            if not _fits(value, _TYPES[kind][message_field.name]):
                raise CodecError(f"{kind.__name__}: {message_field.name} is no such {type(value).__name__}")
            values[message_field.name] = value
        elif message_field.default is MISSING and message_field.default_factory is MISSING:
            raise CodecError(f"{kind.__name__} without {message_field.name}")
    return values


def _fits(value: object, kind: Any) -> bool:
    if get_origin(kind) is list:
        (inner,) = get_args(kind)
        return (
            isinstance(value, list)
            and len(value) <= _MOST_WORDS
            and all(type(element) is inner for element in value)
        )
    return type(value) is kind or (kind is float and type(value) is int)


def apart(theirs: int, version: str, station: str, lab_side: bool) -> str:
    """Return why the release of the other end is incompatible with this one, naming both; "" if it is compatible.

    Args:
        theirs: Release number of the link at the other end.
        version: Version of the installation at the other end.
        station: Name of the station.
        lab_side: Whether this end is the lab.
    """
    if abs(theirs - RELEASE) <= 1:
        return ""
    from runtime.link.release import version as our_version

    lab, robot = (our_version(), version) if lab_side else (version, our_version())
    numbers = (RELEASE, theirs) if lab_side else (theirs, RELEASE)
    return (
        f"the lab has release {numbers[0]} of the link (version {lab:.40}), the computer of {station} release "
        f"{numbers[1]} (version {robot:.40}): they work one apart; update the older one"
    )
