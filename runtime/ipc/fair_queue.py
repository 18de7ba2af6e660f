"""Which of the messages that have come at a socket are looked into in one turn of a loop: all stops, a few of the rest.

Nobody's flood is worth more than its share: of each connection so many wait, each connection has its turn, and what is
beyond is refused unread. A stop is looked for in everything that comes, a press also in what cannot be read.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Collection

from runtime.core.sentences import Pattern
from runtime.ipc.bus import (
    LARGEST,
    MAX_MESSAGES_PER_TURN,
    MAX_WAITING_PER_CONNECTION,
    TOO_MANY,
    CommandServer,
    IncomingMessage,
)
from runtime.ipc.estop_requests import kind_of, parse_packed_press
from runtime.ipc.messages import Command

_TOO_LONG = Pattern("bus.too_long", "{given} bytes; allowed here: {allowed}")

QueuedCommand = tuple[IncomingMessage, Command]
LONGEST_STOP = 4096  # bytes; what is longer is no stop of our clients, and waits its turn
TURN_BYTES = 16 << 20  # that are taken from a socket in one turn


def _press_in(call: IncomingMessage) -> Command | None:
    """The press that a message is; where its content is nothing of its own, also one in or over what follows."""
    press, rest = parse_packed_press(call.payload), call.signature
    if press is not None or not rest or kind_of(call.payload):
        return press
    return parse_packed_press(rest if kind_of(rest) else call.payload + rest)


class FairQueue:
    """Messages at a server's socket, in turns; `urgent` are the kinds that wait for nothing.

    A press of the e-stop is urgent everywhere. Of all else what has more than `longest` bytes is refused unread.
    """

    def __init__(
        self, server: CommandServer, urgent: Collection[str], share: int, longest: int = LARGEST
    ) -> None:
        self._server, self._urgent, self._share, self._longest = server, urgent, share, longest
        self._waiting: dict[bytes, deque[IncomingMessage]] = {}  # by connection, who waits longest first
        self.refused: IncomingMessage | None = None  # one that asked for too much in the last turn

    @property
    def has_waiting(self) -> bool:
        """True if there is something to look into, without any further message."""
        return bool(self._waiting)

    def take_turn(self) -> tuple[list[QueuedCommand], list[QueuedCommand]]:
        """Everything urgent that has come, and of the rest what this turn has time for."""
        self.refused = None
        urgent = [asked for call in self._received() if (asked := self._take_if_urgent(call)) is not None]
        return urgent, self._take_share()

    def _received(self) -> list[IncomingMessage]:
        calls: list[IncomingMessage] = []
        room = TURN_BYTES
        while (
            len(calls) < MAX_MESSAGES_PER_TURN
            and room > 0
            and (call := self._server.receive_raw()) is not None
        ):
            calls.append(call)
            room -= len(call.payload)
        return calls

    def _take_if_urgent(self, call: IncomingMessage) -> QueuedCommand | None:
        """The command if it is urgent; all else waits its turn, or is refused."""
        press = _press_in(call)
        if press is not None:
            return call, press
        if len(call.payload) > self._longest:
            self._server.reject(call, _TOO_LONG(given=len(call.payload), allowed=self._longest))
            return None
        if len(call.payload) <= LONGEST_STOP and kind_of(call.payload) in self._urgent:
            command = self._server.decode(call)  # what cannot be read is answered here
            if command is None or command.kind in self._urgent:
                return None if command is None else (call, command)
        if self._may_wait(call):
            self._waiting.setdefault(call.address[0], deque()).append(call)
        else:
            self.refused = call
            self._server.reject(call, TOO_MANY)
        return None

    def _may_wait(self, call: IncomingMessage) -> bool:
        return len(self._waiting.get(call.address[0], ())) < MAX_WAITING_PER_CONNECTION

    def _take_share(self) -> list[QueuedCommand]:
        found: list[QueuedCommand] = []
        for _ in range(self._share):  # of what cannot be read, too
            if not self._waiting:
                break
            connection = next(iter(self._waiting))
            calls = self._waiting.pop(connection)
            call = calls.popleft()
            if calls:
                self._waiting[connection] = calls  # behind all others
            if (command := self._server.decode(call)) is not None:
                found.append((call, command))
        return found
