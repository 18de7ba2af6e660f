"""Holders of the channel's messages, and the messages that show that the script which commands is alive."""

from __future__ import annotations

import itertools
from typing import Literal

from runtime.clients.channel.message import Message

_CONNECTIONS = 1000  # that are remembered


class HolderNames:
    """Whose a message is: a script that names itself, a connection, or all scripts together.

    `user` is who the channel's process commands for, as the deployment says. What scripts add to it is what they say
    of themselves: nothing here proves it.
    """

    def __init__(self, operator: str, scripts: Literal["apart", "together"]) -> None:
        self.user, self._apart = f"channel:{operator}", scripts == "apart"
        self._numbers: dict[bytes, int] = {}
        self._next = itertools.count(1)
        self._commanded: dict[bytes, bool] = {}  # by connection, of scripts that are one holder

    def holder(self, connection: bytes, client: str) -> str:
        """The name under which it holds a lease; no script can give itself one outside the channel's."""
        if client:
            return f"{self.user}/{client}"
        if not self._apart:
            return self.user
        number = self._numbers.pop(connection, None) or next(self._next)
        self._numbers[connection] = number
        _forget(self._numbers)
        return f"{self.user}#{number}"

    def is_alive(self, connection: bytes, message: Message, stops: bool) -> bool:
        """True if its holder is alive, as far as this message shows; `stops` where it ends something.

        Of scripts that are one holder some only look, and must not keep alive what another one began. So a question
        counts on a connection that has commanded, where it asks what became of a command, or as the first on a
        connection, for the state: that is how clients wait that connect anew for every call.
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


def _forget(known: dict[bytes, int] | dict[bytes, bool]) -> None:
    if len(known) > _CONNECTIONS:
        del known[next(iter(known))]
