"""A station on another computer as the lab's programs find any: its folder, and sockets of the same names in it.

The socket for the e-stop is there for as long as the station is enrolled, those for commands and streams while the
link is: who looks for them meanwhile is told since when it is lost.
"""

from __future__ import annotations

import logging
import time
from pathlib import Path
from typing import IO, Any

import zmq

from runtime.core.errors import TransportError
from runtime.ipc.bus import CommandServer, Endpoints, Key
from runtime.ipc.endpoints import socket_folder
from runtime.ipc.fair_queue import LONGEST_STOP, FairQueue
from runtime.ipc.station_lock import StationLockedError, acquire
from runtime.link.wire import COORDINATOR, GUARD, MEDIA

log = logging.getLogger(__name__)
LINK = "link"  # in `endpoints/`: what is known of the link, for people
STOPPING = ("stop", "halt", "estop")
_LAST_WORDS_MS = 200  # for answers that are on their way when the socket ends
_SHARE = 8  # of commands that are no stops, in one turn
_GATE = ", the gate, for a station on another computer"


class MirrorLockedError(Exception):
    """The station's name is used by another process of this computer."""


class Mirror:
    """The folder of one station, held for as long as this is open. Raises MirrorTaken, TransportError."""

    def __init__(self, context: zmq.Context[Any], station_dir: Path) -> None:
        self._context, self.station_dir = context, station_dir
        self._lock = _acquire_lock(station_dir)
        self._endpoints = Endpoints(station_dir)
        self.key = Key(station_dir)
        self.commands: CommandServer | None = None
        self.command_turns: FairQueue | None = None
        self._streams: tuple[str, str] = ("", "")
        self._cameras = False
        try:
            self._endpoints.prepare()
            self.estops = CommandServer(context, station_dir, "estop")
        except (TransportError, OSError, zmq.ZMQError) as error:
            self._lock.close()
            raise TransportError(f"the folder of {station_dir.name} cannot be used: {error}") from None
        self.estop_turns = FairQueue(self.estops, (), _SHARE, LONGEST_STOP)
        self._endpoints.write(GUARD, {"estop": self.estops.endpoint})

    def raise_up(self, streams: tuple[str, str]) -> None:
        """The station is linked: its socket for commands is a new one, so that nobody counts on what was before.

        `streams` are where its state and its pictures are published.
        """
        self._lower()
        self.commands = CommandServer(self._context, self.station_dir, "commands")
        self.command_turns = FairQueue(self.commands, STOPPING, _SHARE)
        self._streams = streams
        self._tell_where()
        self._endpoints.withdraw(LINK)

    def pictures(self, there: bool) -> None:
        """Whether the station shows any."""
        if there != self._cameras:
            self._cameras = there
            self._tell_where()

    def lower(self, why: str) -> None:
        """The station cannot be commanded, since now; `why` is for people, the time beside it."""
        self._endpoints.write(LINK, {"why": why, "since": repr(time.time())})
        self._lower()

    def poll(self) -> None:
        """Listen anew where clients cannot connect any more."""
        if self.estops.rebind_if_unreachable() or self._endpoints.is_missing(GUARD):
            self._endpoints.write(GUARD, {"estop": self.estops.endpoint})
        if self.commands is not None and (
            self.commands.rebind_if_unreachable() or self._endpoints.is_missing(COORDINATOR)
        ):
            self._tell_where()

    @property
    def waiting(self) -> bool:
        """True if there is something to look into, without any further message."""
        return self.estop_turns.has_waiting or (
            self.command_turns is not None and self.command_turns.has_waiting
        )

    def moved_streams(self, streams: tuple[str, str]) -> None:
        """They are published elsewhere now."""
        if streams != self._streams and self.commands is not None:
            self._streams = streams
            self._tell_where()

    def close(self, why: str) -> None:
        """The station is no longer this lab's: nothing of it is found, but why."""
        self.lower(why)
        self._endpoints.withdraw(GUARD)
        self.estops.socket.linger = _LAST_WORDS_MS
        self.estops.close()
        self._lock.close()

    def _tell_where(self) -> None:
        state, cameras = self._streams
        if self.commands is not None:
            self._endpoints.write(COORDINATOR, {"commands": self.commands.endpoint, "state": state})
        if self._cameras:
            self._endpoints.write(MEDIA, {"cameras": cameras})
        else:
            self._endpoints.withdraw(MEDIA)

    def _lower(self) -> None:
        self._endpoints.withdraw(COORDINATOR)
        self._endpoints.withdraw(MEDIA)
        self._cameras = False
        if self.commands is not None:
            self.commands.close()
        self.commands = self.command_turns = None


def _acquire_lock(station_dir: Path) -> IO[str]:
    try:
        lock = acquire(station_dir, _GATE)
        socket_folder(station_dir)
    except StationLockedError as taken:
        raise MirrorLockedError(
            f"a station of this name runs on the lab's own computer (process {taken.by}): end it, or give one of the "
            "two another name"
        ) from None
    except OSError as error:
        raise TransportError(f"{station_dir} cannot be written: {error.strerror}") from None
    return lock
