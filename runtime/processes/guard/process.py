"""The process that holds the e-stop: its socket, the latch on disk, the flag that every send checks."""

from __future__ import annotations

import logging

import zmq

from runtime.bus import CommandServer, Endpoints
from runtime.clock import Clock, MonotonicClock
from runtime.family import join
from runtime.latch import Latch
from runtime.messages import Ack, Command
from runtime.page import EStop, Page

log = logging.getLogger(__name__)
_POLL_S = 0.005


class Guard:
    """Presses and releases: the flag, the disk, the answer, then the log; none delays what comes before it."""

    def __init__(self, page: Page, latch: Latch, clock: Clock, period: float, station: str = "") -> None:
        self._page = page
        self._latch = latch
        self._clock = clock
        self._said = {"station": station}  # so that nobody takes another station's answer for his own
        self._patience = max(0.05, 2.0 * period)
        self._unsaid: list[tuple[int, str]] = []  # level and line, for after the answer
        self._releases = page.releases  # what was asked for before is void
        latched = latch.read()
        # A restarted guard also trusts the flag of its predecessor, which may not have reached the disk.
        page.set_estop(EStop.LATCHED if latched or page.estop is EStop.LATCHED else EStop.CLEAR)
        if latched:
            log.warning("e-stop is latched since before this start, by %s: %s", latched.by, latched.why)

    def press(self, by: str, why: str) -> str:
        """Raise the flag, then latch on disk; returns "" or why the latch will not outlive a restart."""
        self._page.set_estop(EStop.LATCHED)
        self._releases = self._page.releases  # a release asked for before this press is not for this press
        self._unsaid.append((logging.WARNING, f"E-STOP by {by}: {why}"))
        try:
            self._latch.set(by, why)
        except OSError as error:
            self._unsaid.append((logging.ERROR, f"the e-stop is not on disk: {error}"))
            return f"; not on disk ({error.strerror or error}): a restart of the station may forget it"
        return ""

    def watch(self) -> None:
        """Release where main has asked for it, then log what there is to say."""
        if self._page.releases != self._releases:
            self._release()
        for level, line in self._unsaid:
            log.log(level, "%s", line)
        self._unsaid.clear()

    def _release(self) -> None:
        """Main has checked the lease; where the disk refuses, the e-stop stays."""
        self._releases = self._page.releases
        try:
            self._latch.clear()
        except OSError as error:
            self._unsaid.append((logging.ERROR, f"the e-stop stays: its latch cannot be removed: {error}"))
            return
        self._page.set_estop(EStop.CLEAR)
        self._unsaid.append((logging.WARNING, "e-stop released"))

    def obeyed(self, version: int) -> bool:
        """Whether control has said since `version` of its status that it obeys.

        Waits at most max(50 ms, 2 ticks). An older word is worth nothing: control may have died after it.
        """
        until = self._clock.now() + self._patience
        while not self._says_so(version):
            if self._clock.now() >= until:
                return False
            self._clock.sleep_until(self._clock.now() + 0.002)
        return True

    def _says_so(self, version: int) -> bool:
        status = self._page.control
        return status.version > version and bool(status.read()["estop_obeyed"])

    def answer(self, command: Command) -> Ack:
        """Any user may press; "failed" means that control did not answer in time: use the hardware stop."""
        if command.kind == "estop":
            why = str(command.args.get("why", "pressed"))
            version = self._page.control.version
            doubt = self.press(command.user or command.holder or "unknown", why)
            if self.obeyed(version):
                return Ack(
                    command.uuid,
                    "done",
                    f"every tick now sends the measured position{doubt}",
                    data=self._said,
                )
            return Ack(
                command.uuid,
                "failed",
                f"latched, but control has not obeyed within {self._patience * 1000:.0f} ms: "
                f"USE THE HARDWARE STOP{doubt}",
                data=self._said,
            )
        if command.kind == "status":
            latched = self._latch.read()
            data = {"latched": latched is not None, "by": latched.by if latched else ""}
            return Ack(command.uuid, "done", data=data)
        return Ack(command.uuid, "refused", f"the guard knows estop and status, not {command.kind!r}")


def main() -> None:
    """Guard until the supervisor is gone and control has stopped ticking."""
    member = join("guard")
    settings, clock = member.plan.deployment, MonotonicClock()
    server = CommandServer(zmq.Context.instance(), settings.bus.host, settings.bus.estop_port)
    guard = Guard(member.page, Latch(settings.station_dir), clock, 1.0 / member.plan.rate, settings.station)
    Endpoints(settings.station_dir).write("guard", {"estop": server.endpoint})
    while member.needed(clock.now()):
        member.page.beat("guard", clock.now())
        guard.watch()
        if server.socket.poll(int(_POLL_S * 1000)):
            received = server.receive()
            if received is not None:
                address, command = received
                server.answer(address, guard.answer(command))
    server.close()


if __name__ == "__main__":
    main()
