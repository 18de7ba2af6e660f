"""Keeps a tunnel up: starts ssh, sees that its near end takes connections, starts another when it has ended."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

from runtime.core.backoff import BackOff
from runtime.policies.tunnel.process import Ssh
from runtime.policies.tunnel.sentences import explain_exit, explain_session_refused, port_was_taken

log = logging.getLogger(__name__)
_POLL_S = 0.05
_FIRST_S, _LONGEST_S = 0.2, 5.0  # between two starts
_STEADY_S = 10.0  # a tunnel that was up for so long has earned the shortest wait again
_PORTS = 5  # near ends that are tried at once where others are quicker to take them


@dataclass(frozen=True, slots=True)
class Status:
    """A tunnel at one moment: its near end while it is up; since when it is as it is, on the keeper's clock; and why it
    was last down.

    `failures` counts the starts that came to nothing and the tunnels that broke, `refusals` the connections that the
    far end did not make, `refusal` says why it did not make the newest of these.
    """

    up: bool
    since: float
    port: int = 0
    why: str = "it was not started yet"
    failures: int = 0
    refusals: int = 0
    refusal: str = ""
    closed: bool = False


class TunnelKeeper:
    """One tunnel from `begin` to `close`; `start` starts one ssh with a near end of its own, or raises OSError."""

    def __init__(
        self, name: str, start: Callable[[], Ssh], deadline: float, now: Callable[[], float] = time.monotonic
    ) -> None:
        self._name = name  # of the far end
        self._start = start
        self._deadline = deadline  # for each ssh to be up [s]
        self._now = now
        self._ssh: Ssh | None = None
        self._begun = 0.0  # the newest ssh
        self._refused = 0  # of the newest ssh's refusals, those that are counted
        self._taken = 0  # ports in a row
        self._back_off = BackOff(_FIRST_S, _LONGEST_S)
        self._changed = threading.Condition()
        self._stop = threading.Event()
        self.status = Status(False, now())

    def start(self) -> None:
        """Keep it in a thread of its own: ssh ends with the thread that started it."""
        threading.Thread(target=self._keep, name="tunnel", daemon=True).start()

    def close(self) -> None:
        """Return at once; the thread ends its ssh."""
        self._tell(closed=True, why="it was closed from our side")
        self._stop.set()

    def duration(self, status: Status) -> float:
        """Duration of the status so far [s]."""
        return self._now() - status.since

    def owns_port(self, port: int) -> bool:
        """True if the near end at `port` is its own at this moment; one that was its own may be another's."""
        ssh = self._ssh
        return ssh is not None and ssh.port == port and ssh.is_listening()

    def wait_for(self, reached: Callable[[Status], bool], seconds: float) -> Status:
        """The status as soon as it is one, or after `seconds`."""
        with self._changed:
            self._changed.wait_for(lambda: reached(self.status), seconds)
            return self.status

    def poll(self) -> None:
        """Whatever is due."""
        now, ssh = self._now(), self._ssh
        if ssh is None:
            if not self._back_off.remaining_delay(now):
                self._launch(now)
            return
        code = ssh.poll()
        self._count(ssh)
        if code is not None:
            silent = not self.status.up and not ssh.said and ssh.refusal
            self._discard(
                ssh, explain_session_refused(ssh.refusal) if silent else explain_exit(ssh.said, code)
            )
        elif self.status.up:
            return
        elif ssh.is_listening():
            self._taken = 0
            self._tell(up=True, since=now, port=ssh.port)
            log.info("the tunnel to %s is up, at port %d", self._name, ssh.port)
        elif now - self._begun > self._deadline:
            last = f" ({ssh.said[-1]})" if ssh.said else ""
            self._discard(ssh, f"it was not up within {self._deadline:g} s{last}")

    def stop(self) -> None:
        """End its ssh, if there is one."""
        ssh, self._ssh = self._ssh, None
        if ssh is not None:
            ssh.terminate()

    def _launch(self, now: float) -> None:
        try:
            self._ssh = self._start()
        except OSError as error:
            self._failed(f"ssh cannot be started: {error}")
        else:
            self._begun, self._refused = now, 0

    def _count(self, ssh: Ssh) -> None:
        if ssh.refusals > self._refused:
            new, self._refused = ssh.refusals - self._refused, ssh.refusals
            self._tell(refusals=self.status.refusals + new, refusal=ssh.refusal)

    def _discard(self, ssh: Ssh, reason: str) -> None:
        """This ssh is of no use any more."""
        taken = not self.status.up and port_was_taken(ssh.said)
        self.stop()
        if taken and self._taken < _PORTS:
            self._taken += 1  # another port is free for certain
            return
        self._failed(reason)

    def _failed(self, reason: str) -> None:
        now, before = self._now(), self.status
        if before.up and now - before.since >= _STEADY_S:
            self._back_off.reset()
        self._back_off.record_failure(now)
        self._taken = 0
        since = now if before.up else before.since
        self._tell(up=False, since=since, port=0, why=reason, failures=before.failures + 1)
        again = self._back_off.remaining_delay(now)
        log.warning("the tunnel to %s is down: %s; trying again in %.1f s", self._name, reason, again)

    def _tell(self, **changes: Any) -> None:
        with self._changed:
            self.status = replace(self.status, **changes)
            self._changed.notify_all()

    def _keep(self) -> None:
        try:
            while not self._stop.is_set():
                self.poll()
                self._stop.wait(_POLL_S)
        except Exception as error:  # of our own code: whoever waits has to be told
            log.exception("the tunnel to %s is not kept any more", self._name)
            self._tell(why=f"it is not kept any more ({type(error).__name__}: {error})")
        finally:
            self.stop()
            self._tell(up=False, since=self._now(), port=0, closed=True)
