"""Guard process: e-stop socket, latch on disk, and the flag that control checks before every send."""

from __future__ import annotations

import argparse
import json
import logging
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import zmq

from runtime.core import logs, realtime
from runtime.core import process_limits as descriptors
from runtime.core.clock import Clock, MonotonicClock
from runtime.core.sentences import Pattern
from runtime.ipc.bells import bells
from runtime.ipc.bus import CommandServer, Endpoints, IncomingMessage, Key
from runtime.ipc.estop_latch import Latch
from runtime.ipc.estop_requests import parse_packed_press, reason_of
from runtime.ipc.fair_queue import LONGEST_STOP, FairQueue, QueuedCommand
from runtime.ipc.identity import authenticate, display_name
from runtime.ipc.lifeline import Lifeline
from runtime.ipc.membership import Membership
from runtime.ipc.messages import Ack, Command
from runtime.ipc.shared_state import EStop, SharedState, SharedStateLayout

log = logging.getLogger(__name__)
_NOT_ON_DISK = Pattern(
    "guard.not_on_disk",
    "; not on disk ({error}): a restart of the station may forget it",
)
_OBEYED = Pattern("guard.obeyed", "every tick now sends the measured position{doubt}")
_NOT_OBEYED = Pattern(
    "guard.not_obeyed",
    "latched, but control has not obeyed within {ms:.0f} ms: USE THE HARDWARE STOP{doubt}",
)
_UNKNOWN = Pattern("guard.unknown", "the guard knows estop and status, not {kind!r}")
_SHARE = 8  # requests answered per turn, besides all presses
_REMEMBERED = 10_000  # most remembered presses of one e-stop


class Guard:
    """E-stop presses and releases.

    A press is handled in the order flag, disk, answer, log, so that no step delays an earlier one.
    """

    def __init__(
        self, shared: SharedState, latch: Latch, clock: Clock, period: float, station: str = ""
    ) -> None:
        self._shared_state = shared
        self._latch = latch
        self._clock = clock
        self._said = {
            "station": station
        }  # so that a client cannot mistake another station's answer for this one
        self._patience = max(0.05, 2.0 * period)
        self._unsaid: list[tuple[int, str]] = []  # level and text of log lines for after the answer
        self._releases = shared.releases  # releases requested before this start are void
        self._latched: tuple[str, str] | None = None  # user and reason of the latch that this process wrote
        latched = latch.read()
        # Also trust the flag of a predecessor, whose press may not have reached the disk.
        shared.set_estop(EStop.LATCHED if latched or shared.estop is EStop.LATCHED else EStop.CLEAR)
        if latched:
            log.warning("e-stop is latched since before this start, by %s: %s", latched.by, latched.why)

    def raise_flag(self) -> None:
        """Set the e-stop flag, which stops the robot, even before the sender is authenticated."""
        self._shared_state.set_estop(EStop.LATCHED)
        self._releases = (
            self._shared_state.releases
        )  # a release requested before this press does not release it

    def press(self, by: str, why: str) -> str:
        """Set the flag, then write the latch to disk; return "", or the reason why it will not survive a restart.

        A latch by the same user for the same reason is not written again.
        """
        self.raise_flag()
        if (by, why) == self._latched:
            return ""
        self._unsaid.append((logging.WARNING, f"E-STOP by {by}: {why}"))
        try:
            self._latch.set(by, why)
        except OSError as error:
            self._unsaid.append((logging.ERROR, f"the e-stop is not on disk: {error}"))
            return _NOT_ON_DISK(error=error.strerror or error)
        self._latched = (by, why)
        return ""

    def poll(self) -> None:
        """Release if the coordinator has requested it, latch presses that the coordinator received, then write the log.

        The coordinator has already set the flag for such a press, but a release in between may have cleared it.
        """
        if self._shared_state.releases != self._releases:
            self._release()
        for payload in self._shared_state.rings["presses"].drain():
            if (command := parse_packed_press(payload)) is not None:
                self.press(display_name(command), reason_of(command))
        for level, line in self._unsaid:
            log.log(level, "%s", line)
        self._unsaid.clear()

    def _release(self) -> None:
        """Release the e-stop; the coordinator has checked the lease. It stays latched if the disk refuses."""
        self._releases = self._shared_state.releases
        try:
            self._latch.clear()
        except OSError as error:
            self._unsaid.append((logging.ERROR, f"the e-stop stays: its latch cannot be removed: {error}"))
            return
        self._latched = None
        self._shared_state.set_estop(EStop.CLEAR)
        self._unsaid.append((logging.WARNING, "e-stop released"))

    def wait_until_obeyed(self, version: int) -> bool:
        """Return True if control has confirmed the e-stop in a status newer than `version`.

        Waits at most max(50 ms, 2 ticks). An older status proves nothing, because control may have died after it.
        """
        until = self._clock.now() + self._patience
        while not self._control_confirms(version):
            if self._clock.now() >= until:
                return False
            self._clock.sleep_until(self._clock.now() + 0.002)
        return True

    def _control_confirms(self, version: int) -> bool:
        status = self._shared_state.control
        return status.version > version and bool(status.read()["estop_obeyed"])

    def answer(self, command: Command) -> Ack:
        """Carry out an "estop" or "status" command and return its acknowledgement; others are refused.

        Every user may press the e-stop. The status "failed" means that control did not confirm the press in time: use
        the hardware stop.
        """
        if command.kind == "estop":
            version = self._shared_state.control.version  # before the press: only a newer status confirms it
            doubt = self.press(display_name(command), reason_of(command))
            if self.wait_until_obeyed(version):
                return Ack(command.uuid, "done", _OBEYED(doubt=doubt), data=self._said)
            late = _NOT_OBEYED(ms=self._patience * 1000, doubt=doubt)
            return Ack(command.uuid, "failed", late, data=self._said)
        if command.kind == "status":
            latched = self._latch.read()
            data = {"latched": latched is not None, "by": latched.by if latched else ""}
            return Ack(command.uuid, "done", data=data)
        return Ack(command.uuid, "refused", _UNKNOWN(kind=command.kind))


class EStopServer:
    """Socket of the guard: every press that has arrived is answered in the same turn, however many there are.

    The presses of one turn set the flag once and write one latch, which names the sender of the first press; every new
    press of the turn gets the answer to the first. A repeated uuid gets its first answer again until the e-stop is
    released.

    The data of an answer contain `carried_out_at`, the time of the press (Unix time [s]), and `latched`: "anew",
    "already" if the e-stop was latched before, or "before" if this is the answer to an earlier press.
    """

    def __init__(
        self, guard: Guard, shared: SharedState, context: zmq.Context[Any], station_dir: Path
    ) -> None:
        self._guard, self._shared_state, self._key = guard, shared, Key(station_dir)
        self._server = CommandServer(context, station_dir, "estop")
        self._turns = FairQueue(self._server, (), _SHARE, LONGEST_STOP)
        self._bell = shared.bells.get("guard")
        self._poller = zmq.Poller()
        self._poller.register(self._server.socket, zmq.POLLIN)
        if self._bell is not None:
            self._poller.register(self._bell.descriptor, zmq.POLLIN)
        self._endpoints = Endpoints(station_dir)
        self._answered: dict[str, Ack] = {}
        self._write_endpoints()

    def _write_endpoints(self) -> None:
        self._endpoints.write("guard", {"estop": self._server.endpoint})

    def serve(self, timeout: float) -> None:
        """Wait up to `timeout` [s] for a message, then answer all waiting messages.

        The wait also ends when another process of the station wakes the guard.
        """
        if not self._turns.has_waiting:
            self._poller.poll(int(timeout * 1000))
        if self._bell is not None:
            self._bell.hush()
        presses, commands = self._turns.take_turn()
        anew = self._shared_state.estop is not EStop.LATCHED
        if anew:
            self._answered.clear()
        if presses:  # first the flag for all of them, then authentication, the latch and answers
            self._guard.raise_flag()
            self._answer(presses, "anew" if anew else "already")
        for call, command in commands:
            self._server.answer(call, self._guard.answer(command))
        if self._server.rebind_if_unreachable() or self._endpoints.is_missing("guard"):
            self._write_endpoints()

    def _answer(self, presses: list[QueuedCommand], latched: str) -> None:
        fresh, at = None, time.time()
        for call, command in presses:
            answer = self._answered.get(command.uuid)
            if answer is None:
                fresh = fresh or self._guard.answer(self._identified(call, command))
                data = {**fresh.data, "latched": latched, "carried_out_at": at}
                answer, latched = replace(fresh, uuid=command.uuid, data=data), "already"
            self._server.answer(call, answer)
            if answer.status == "done":
                self._remember(answer)

    def _identified(self, call: IncomingMessage, command: Command) -> Command:
        return authenticate(command, call.payload, call.signature, call.uid, self._key)

    def _remember(self, ack: Ack) -> None:
        self._answered.setdefault(ack.uuid, replace(ack, data={**ack.data, "latched": "before"}))
        if len(self._answered) > _REMEMBERED:
            del self._answered[next(iter(self._answered))]

    def close(self) -> None:
        """Release the socket."""
        self._server.close()


def _arguments() -> argparse.Namespace:
    """Parse the supervisor's arguments.

    They are plain values, so that the guard need not load modules that a deployment names.
    """
    parser = argparse.ArgumentParser(prog="runtime.guard", description="started by the supervisor")
    parser.add_argument("--station", required=True)
    parser.add_argument("--folder", required=True, type=Path, help="of the station: latch, key, endpoints")
    parser.add_argument("--period", required=True, type=float, help="of control's ticks [s]")
    parser.add_argument("--layout", required=True, help="of the shared state, as JSON")
    parser.add_argument("--rest", required=True, type=float, help="between two signs of life [s]")
    parser.add_argument("--priority", type=int, help="of control in the real-time class, to be next after it")
    parser.add_argument("--shared", required=True, type=int)
    parser.add_argument("--bells", required=True, type=bells)
    parser.add_argument("--boot", required=True)
    return parser.parse_args()


def main() -> None:
    """Guard the station until the supervisor has ended and control has stopped ticking."""
    descriptors.raise_file_limit()
    arguments = _arguments()
    logs.configure_logging("guard")
    # before other threads exist, which inherit the class
    scheduling = realtime.enter_realtime_below(arguments.priority) if arguments.priority else "ordinary"
    log.info("guarding, scheduling %s", scheduling)
    sizes = json.loads(arguments.layout)
    layout = SharedStateLayout(**{**sizes, "cameras": tuple(sizes["cameras"])})
    shared = SharedState.attach(layout, arguments.shared)
    shared.hang(arguments.bells)
    member = Membership(shared, arguments.boot, Lifeline())
    clock = MonotonicClock()
    guard = Guard(member.shared, Latch(arguments.folder), clock, arguments.period, arguments.station)
    desk = EStopServer(guard, member.shared, zmq.Context.instance(), arguments.folder)
    while member.is_needed(clock.now()):
        member.shared.beat("guard", clock.now())
        guard.poll()
        desk.serve(arguments.rest)
    desk.close()


if __name__ == "__main__":
    main()
