"""Mirror of a station on another computer: a folder with sockets, like that of a station on this computer.

The lab's programs find and command the station by this folder. The e-stop socket exists as long as the station is
enrolled; the sockets for commands and streams exist only while the link is up. While the link is down, clients find the
reason and the time of the loss in the folder.
"""

from __future__ import annotations

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

LINK = "link"  # file in `endpoints/`: reason and time of a lost link, for people
STOPPING = ("stop", "halt", "estop")
_LAST_WORDS_MS = 200  # for answers that are still being sent when the socket closes
_SHARE = 8  # commands other than stops per turn
_GATE = ", the gate, for a station on another computer"


class MirrorLockedError(Exception):
    """Error that another process of this computer uses the station's name."""


class Mirror:
    """Folder of one linked station, locked until `close`. Raises: MirrorLockedError, TransportError."""

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
        """Open a new command socket and publish its address: the station is linked.

        The socket is new at every link, so that no client waits for answers from before the loss.

        Args:
            streams: Endpoints at which the station's state and its pictures are published.
        """
        self._lower()
        self.commands = CommandServer(self._context, self.station_dir, "commands")
        self.command_turns = FairQueue(self.commands, STOPPING, _SHARE)
        self._streams = streams
        self._tell_where()
        self._endpoints.withdraw(LINK)

    def pictures(self, there: bool) -> None:
        """Publish the endpoint of the pictures if the station has any (`there`), otherwise withdraw it."""
        if there != self._cameras:
            self._cameras = there
            self._tell_where()

    def lower(self, why: str) -> None:
        """Close the command socket and record the time and `why`, a sentence for people."""
        self._endpoints.write(LINK, {"why": why, "since": repr(time.time())})
        self._lower()

    def poll(self) -> None:
        """Rebind sockets that clients cannot reach, and rewrite missing endpoint files. Call regularly."""
        if self.estops.rebind_if_unreachable() or self._endpoints.is_missing(GUARD):
            self._endpoints.write(GUARD, {"estop": self.estops.endpoint})
        if self.commands is not None and (
            self.commands.rebind_if_unreachable() or self._endpoints.is_missing(COORDINATOR)
        ):
            self._tell_where()

    @property
    def waiting(self) -> bool:
        """True if messages are queued in the mirror although their socket does not become readable again.

        The messages were taken from the socket before, so polling the socket does not show them.
        """
        return self.estop_turns.has_waiting or (
            self.command_turns is not None and self.command_turns.has_waiting
        )

    def moved_streams(self, streams: tuple[str, str]) -> None:
        """Publish new endpoints of the streams if they have changed."""
        if streams != self._streams and self.commands is not None:
            self._streams = streams
            self._tell_where()

    def close(self, why: str) -> None:
        """Withdraw all endpoints, record the reason `why`, and release the folder.

        The station does not belong to this lab any more.
        """
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
