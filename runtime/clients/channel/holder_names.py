"""Holders of the lease for the channel's messages, and which messages show that the commanding script is alive."""

from __future__ import annotations

import itertools
from typing import Literal

from runtime.clients.channel.message import Message

_CONNECTIONS = 1000  # connections remembered


class HolderNames:
    """Assignment of each message to the lease holder that sent it.

    A script that names itself is a holder of its own. For scripts without a name there are two settings: each
    connection is a holder, or all of these scripts together are one holder.

    `user` is the name of the channel itself, with its operator. The name of a holder begins with `user`. It is followed
    by the name that the script gives itself, which is not verified, or by the number of the connection.
    """

    def __init__(self, operator: str, scripts: Literal["apart", "together"]) -> None:
        self.user, self._apart = f"channel:{operator}", scripts == "apart"
        self._numbers: dict[bytes, int] = {}
        self._next = itertools.count(1)
        self._commanded: dict[bytes, bool] = {}  # by connection: whether it has sent a command

    def holder(self, connection: bytes, client: str) -> str:
        """Return the name of the lease's holder for a message on `connection`; `client` is the script's own name.

        The script's own name is only appended to the channel's, so that it can never be that of a holder outside the
        channel.
        """
        if client:
            return f"{self.user}/{client}"
        if not self._apart:
            return self.user
        number = self._numbers.pop(connection, None) or next(self._next)
        self._numbers[connection] = number
        _forget(self._numbers)
        return f"{self.user}#{number}"

    def is_alive(self, connection: bytes, message: Message, stops: bool) -> bool:
        """Return True if the message shows that its holder is alive; `stops`: the message is a stop.

        Every message of a script with a name or a connection of its own shows that. If all scripts together are one
        holder, a script that only asks for the status must not extend the lease of a script that commands. Then every
        command counts, but a query only in three cases: its connection has sent a command before; it asks for the
        result of a command; or it asks for the status as the first message of its connection. The last case is that of
        clients that reconnect for each call while they wait for the end of a command.
        """
        if self._apart or message.client:
            return True
        first = connection not in self._commanded
        begins = message.form != "query" and not stops
        commanded = self._commanded.pop(connection, False) or begins
        self._commanded[connection] = commanded
        _forget(self._commanded)
        waits = message.name == "result" or (first and message.name == "status")
        return commanded or message.form != "query" or waits


def _forget(cached: dict[bytes, int] | dict[bytes, bool]) -> None:
    if len(cached) > _CONNECTIONS:
        del cached[next(iter(cached))]
