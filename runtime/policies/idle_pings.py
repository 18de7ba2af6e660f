"""Pings over an idle connection, for servers that end without requests, or whose end should be noticed early."""

from __future__ import annotations

import logging
import threading
import time
from abc import abstractmethod

from runtime.core.errors import PolicyError
from runtime.policies.base import PolicyInfo
from runtime.policies.websocket import ServerSettings, WebsocketPolicy

log = logging.getLogger(__name__)


class IdlePingPolicy(WebsocketPolicy):
    """Policy that sends a ping when there was no other traffic for `every` [s]; 0: it sends none."""

    def __init__(self, server: ServerSettings, every: float) -> None:
        super().__init__(server)
        self._every = every
        self._spoken = time.monotonic()  # time of the newest answer
        self._silent = threading.Event()
        self._silent.set()

    @abstractmethod
    def _ping(self, seconds: float) -> None:
        """Send a ping and wait at most `seconds` [s] for its answer. Raises PolicyError if there is none."""

    def connect(self) -> PolicyInfo:
        """Connect, read the metadata, and start regular pings."""
        info = super().connect()
        if self._every and self._silent.is_set():
            self._silent = threading.Event()
            threading.Thread(
                target=self._ping_while_idle,
                args=(self._silent, self._every),
                name=f"{self.PROTOCOL.lower()}-ping",
                daemon=True,
            ).start()
        return info

    def close(self) -> None:
        """Close the connection as every policy does, and stop the pings."""
        self._silent.set()
        super().close()

    def _ping_while_idle(self, silent: threading.Event, every: float) -> None:
        """Send pings over an idle connection until `silent` is set.

        A ping is sent when there was no request for at least half of `every` [s]. No ping is sent while a request is
        pending.
        """
        while not silent.wait(every / 2):
            if not self._lock.acquire(blocking=False):
                continue
            try:
                if self._link.is_open and time.monotonic() - self._spoken >= every / 2:
                    self._ping(self._server.inference_deadline)
            except PolicyError as error:
                log.warning("the policy server did not answer a ping, the connection is dropped: %s", error)
                self._link.close_gracefully()
            finally:
                self._lock.release()
