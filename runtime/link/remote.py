"""A station on another computer as its lab's gate knows it: its connections, what was asked of it, what waits."""

from __future__ import annotations

from dataclasses import dataclass, field

from runtime.ipc.bus import CommandServer, IncomingMessage
from runtime.ipc.messages import Command
from runtime.link.mirror import Mirror
from runtime.link.wire import LOST_S


@dataclass(slots=True)
class Line:
    """A connection of a station: its newest challenge, and when it was last heard."""

    route: bytes
    heard_at: float
    challenge: bytes = b""


@dataclass(slots=True)
class Pending:
    """A command under way: who asked, and over which socket the answer goes."""

    server: CommandServer
    call: IncomingMessage
    command: Command
    until: float
    press: PendingPress | None = None


@dataclass(slots=True)
class PendingPress:
    """A press of the e-stop; `told` once its sender has an answer."""

    call: IncomingMessage
    command: Command
    payload: bytes
    verified: bool
    at: float
    told: bool = False
    sent: bool = False  # over a connection that was lost before the answer


@dataclass(slots=True)
class Remote:
    """A station that is enrolled here."""

    name: str
    mirror: Mirror | None = None
    refusal: str = ""
    tried_at: float = -float("inf")
    session: bytes = b""
    lines: dict[str, Line] = field(default_factory=dict)
    listening: list[str] = field(default_factory=list)
    pending: dict[int, Pending] = field(default_factory=dict)
    held: list[PendingPress] = field(default_factory=list)
    lives: bool = False  # its connections; `up`: and what they lead to
    up: bool = False
    told: str = ""
    lost_at: float = -float("inf")

    def line(self, role: str, now: float) -> Line | None:
        """A connection that lives and can have commands signed for it."""
        found = self.lines.get(role)
        return found if found is not None and found.challenge and now - found.heard_at <= LOST_S else None
