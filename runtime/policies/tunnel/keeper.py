"""Keeper of a tunnel: starts ssh, checks that its local port accepts connections, and restarts ssh when it ends."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

from runtime.core.backoff import BackOff
from runtime.policies.tunnel.ssh_messages import explain_exit, explain_session_refused, port_was_taken
from runtime.policies.tunnel.ssh_process import Ssh

log = logging.getLogger(__name__)
_POLL_S = 0.05
_FIRST_S, _LONGEST_S = 0.2, 5.0  # shortest and longest pause between starts [s]
_STEADY_S = 10.0  # a tunnel that was up this long resets the pause [s]
_PORTS = 5  # ports tried without a pause if other processes take them first


@dataclass(frozen=True, slots=True)
class Status:
    """State of a tunnel at one moment.

    `port` is the local port while the tunnel is up; `why` is why it was last down. `since` is the time of the last
    change on the keeper's clock. `failures` counts failed starts and broken tunnels, `refusals` the connections that
    the far end refused; `refusal` is the reason of the newest refusal.
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
    """Tunnel that is kept up from `start` to `close`.

    The argument `start` is a function that launches ssh with a new local port, or raises OSError.
    """

    def __init__(
        self, name: str, start: Callable[[], Ssh], deadline: float, now: Callable[[], float] = time.monotonic
    ) -> None:
        self._name = name  # name of the far end
        self._start = start
        self._deadline = deadline  # time for each ssh until it is up [s]
        self._now = now
        self._ssh: Ssh | None = None
        self._begun = 0.0  # start time of the newest ssh
        self._refused = 0  # refusals of the newest ssh that are already counted
        self._taken = 0  # consecutive ports that were taken
        self._back_off = BackOff(_FIRST_S, _LONGEST_S)
        self._changed = threading.Condition()
        self._stop = threading.Event()
        self.status = Status(False, now())

    def start(self) -> None:
        """Start the thread that keeps the tunnel; each ssh is its child and ends with it."""
        threading.Thread(target=self._run, name="tunnel", daemon=True).start()

    def close(self) -> None:
        """Stop the tunnel and return at once; the thread ends its ssh."""
        self._set_status(closed=True, why="it was closed from our side")
        self._stop.set()

    def duration(self, status: Status) -> float:
        """Return how long `status` has lasted so far [s]."""
        return self._now() - status.since

    def owns_port(self, port: int) -> bool:
        """Return True if the present ssh listens at `port`; a former port may belong to another process."""
        ssh = self._ssh
        return ssh is not None and ssh.port == port and ssh.is_listening()

    def wait_for(self, reached: Callable[[Status], bool], seconds: float) -> Status:
        """Return the status as soon as `reached(status)` is true, but after `seconds` [s] at the latest."""
        with self._changed:
            self._changed.wait_for(lambda: reached(self.status), seconds)
            return self.status

    def poll(self) -> None:
        """Advance the tunnel by one step.

        Start ssh if it is due; set the status to up as soon as its port listens; discard ssh if it has ended or does
        not listen in time.
        """
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
            self._set_status(up=True, since=now, port=ssh.port)
            log.info("the tunnel to %s is up, at port %d", self._name, ssh.port)
        elif now - self._begun > self._deadline:
            last = f" ({ssh.said[-1]})" if ssh.said else ""
            self._discard(ssh, f"it was not up within {self._deadline:g} s{last}")

    def stop(self) -> None:
        """End the present ssh, if there is one."""
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
            self._set_status(refusals=self.status.refusals + new, refusal=ssh.refusal)

    def _discard(self, ssh: Ssh, reason: str) -> None:
        """End this ssh and record the failure.

        If another process has taken its local port, that does not count as a failure, and ssh is started again at once,
        a limited number of times.
        """
        port_taken = not self.status.up and port_was_taken(ssh.said)
        self.stop()
        if port_taken and self._taken < _PORTS:
            self._taken += 1  # another port is certainly free
            return
        self._failed(reason)

    def _failed(self, reason: str) -> None:
        now, before = self._now(), self.status
        if before.up and now - before.since >= _STEADY_S:
            self._back_off.reset()
        self._back_off.record_failure(now)
        self._taken = 0
        since = now if before.up else before.since
        self._set_status(up=False, since=since, port=0, why=reason, failures=before.failures + 1)
        delay_s = self._back_off.remaining_delay(now)
        log.warning("the tunnel to %s is down: %s; trying again in %.1f s", self._name, reason, delay_s)

    def _set_status(self, **changes: Any) -> None:
        with self._changed:
            self.status = replace(self.status, **changes)
            self._changed.notify_all()

    def _run(self) -> None:
        try:
            while not self._stop.is_set():
                self.poll()
                self._stop.wait(_POLL_S)
        except Exception as error:  # an error of our own code must be reported to waiting threads
            log.exception("the tunnel to %s is not kept any more", self._name)
            self._set_status(why=f"it is not kept any more ({type(error).__name__}: {error})")
        finally:
            self.stop()
            self._set_status(up=False, since=self._now(), port=0, closed=True)
