"""Station on another computer as its lab's gate knows it: connections, pending commands and held presses."""

from __future__ import annotations

from dataclasses import dataclass, field

from runtime.ipc.bus import CommandServer, IncomingMessage
from runtime.ipc.messages import Command
from runtime.link.mirror import Mirror
from runtime.link.wire import LOST_S


@dataclass(slots=True)
class Line:
    """Connection of a station: its newest challenge, and the time of its last message."""

    route: bytes
    heard_at: float
    challenge: bytes = b""


@dataclass(slots=True)
class Pending:
    """Command that waits for the station's answer: its sender, and the socket for the answer."""

    server: CommandServer
    call: IncomingMessage
    command: Command
    until: float
    press: PendingPress | None = None


@dataclass(slots=True)
class PendingPress:
    """Press of the e-stop that waits for the link.

    `told` is True if the sender of the press has received an answer already. The press is still sent to the station.
    """

    call: IncomingMessage
    command: Command
    payload: bytes
    verified: bool
    at: float
    told: bool = False
    sent: bool = False  # sent over a connection that was lost before the answer


@dataclass(slots=True)
class Remote:
    """Enrolled station, with its connections, pending commands and held presses."""

    name: str
    mirror: Mirror | None = None
    refusal: str = ""
    tried_at: float = -float("inf")
    session: bytes = b""
    lines: dict[str, Line] = field(default_factory=dict)
    listening: list[str] = field(default_factory=list)
    pending: dict[int, Pending] = field(default_factory=dict)
    held: list[PendingPress] = field(default_factory=list)
    alive: frozenset[str] = frozenset()  # roles of the connections that are alive
    up: bool = False  # both are alive, and the station can be commanded
    told: str = ""
    lost_at: float = -float("inf")

    def line(self, role: str, now: float) -> Line | None:
        """Return the connection of `role`; None if it is silent, or has sent no challenge yet.

        Without a challenge no command can be signed.
        """
        line = self.lines.get(role)
        return line if line is not None and line.challenge and now - line.heard_at <= LOST_S else None
