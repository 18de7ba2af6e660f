"""Fair queue of the messages at a socket: each turn of a loop takes all stops, and a bounded share of the rest.

Flooding gives a client no advantage: the number of waiting messages per connection is limited, connections alternate,
and messages beyond the limit are refused without decoding. Every message is checked for a stop, unreadable messages
also for an e-stop press.
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
LONGEST_STOP = 4096  # [bytes] longer messages are no stops of our clients, and wait
TURN_BYTES = 16 << 20  # [bytes] read from a socket in one turn


def _press_in(call: IncomingMessage) -> Command | None:
    """Return the e-stop press in a message, None if there is none.

    If the message's content has no kind, the press is also sought in the frames that follow, which are given as the
    signature, and in content and signature joined together.
    """
    press, signature = parse_packed_press(call.payload), call.signature
    if press is not None or not signature or kind_of(call.payload):
        return press
    return parse_packed_press(signature if kind_of(signature) else call.payload + signature)


class FairQueue:
    """Fair queue in front of a command server; messages of the kinds `urgent` never wait.

    An e-stop press is always urgent. Other messages with more than `longest` bytes are refused without decoding.
    """

    def __init__(
        self, server: CommandServer, urgent: Collection[str], share: int, longest: int = LARGEST
    ) -> None:
        self._server, self._urgent, self._share, self._longest = server, urgent, share, longest
        self._waiting: dict[bytes, deque[IncomingMessage]] = {}  # by connection, longest waiting first
        self.refused: IncomingMessage | None = None  # in the last turn, for too many of its connection

    @property
    def has_waiting(self) -> bool:
        """True if messages wait in this queue, so that a turn is due even if the socket receives no further one."""
        return bool(self._waiting)

    def take_turn(self) -> tuple[list[QueuedCommand], list[QueuedCommand]]:
        """Return all urgent commands that have arrived, and this turn's share of the other commands."""
        self.refused = None
        urgent = [command for call in self._received() if (command := self._take_if_urgent(call)) is not None]
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
        """Return the command if it is urgent; other messages are queued or refused."""
        press = _press_in(call)
        if press is not None:
            return call, press
        if len(call.payload) > self._longest:
            self._server.reject(call, _TOO_LONG(given=len(call.payload), allowed=self._longest))
            return None
        if len(call.payload) <= LONGEST_STOP and kind_of(call.payload) in self._urgent:
            command = self._server.decode(call)  # refuses it if it cannot be decoded
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
        commands: list[QueuedCommand] = []
        for _ in range(self._share):  # unreadable messages count too
            if not self._waiting:
                break
            connection = next(iter(self._waiting))
            calls = self._waiting.pop(connection)
            call = calls.popleft()
            if calls:
                self._waiting[connection] = calls  # behind all others
            if (command := self._server.decode(call)) is not None:
                commands.append((call, command))
        return commands
