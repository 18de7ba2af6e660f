"""Main's sockets: answers commands at once, publishes snapshots at 10 Hz, joints and poses at 30."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import zmq

from runtime import heap
from runtime.bus import STREAM_HIGH_WATER, CommandServer, Endpoints, Publisher
from runtime.clock import MonotonicClock
from runtime.command_journal import CommandJournal
from runtime.director import Director
from runtime.family import join
from runtime.inference import ShownChunk
from runtime.messages import Ack, Command, Event
from runtime.runner import ThreadRunner
from runtime.transitions import STOPPING

_NOT_JOURNALLED = ("status", "events_since", "aim", "lease_renew", "preflight_report", "policy_server")
_MOST_WAITING = 100  # commands


class Service:
    """What clients of the station talk to."""

    def __init__(self, main: Director, context: zmq.Context[Any]) -> None:
        self._main = main
        settings = main.plan.deployment
        self._server = CommandServer(context, settings.bus.host, settings.bus.command_port)
        self._streams = Publisher(context, settings.bus.host, settings.bus.state_port, STREAM_HIGH_WATER)
        self._journal = CommandJournal(settings.station_dir)
        main.session.remember(self._journal.answers)
        endpoints = {"commands": self._server.endpoint, "state": self._streams.endpoint, "boot": main.boot}
        Endpoints(settings.station_dir).write("main", endpoints)
        self._due: dict[str, float] = {}
        self._told = 0
        self._shown: ShownChunk | None = None
        self._unjournalled = ""
        self._waiting: list[tuple[list[bytes], Command]] = []  # for what is still being loaded

    def serve(self, timeout: float) -> None:
        """Wait up to `timeout` seconds for a command; answer all there are; publish what is due."""
        self._server.socket.poll(int(timeout * 1000))
        waiting, self._waiting = self._waiting, []
        while (received := self._server.receive()) is not None:
            waiting.append(received)
        for address, command in waiting:
            if self._main.waits(command):
                self._keep(address, command)
                continue
            ack = self._main.handle(command)
            # Who stops a robot waits for no disk; to stop it twice does no harm.
            stops = command.kind in STOPPING
            if stops:
                self._server.answer(address, ack)
            if command.kind not in _NOT_JOURNALLED:
                self._tell_once(self._journal.append(command, ack))
            if not stops:
                self._server.answer(address, ack)
        self._publish()

    def _keep(self, address: list[bytes], command: Command) -> None:
        """Answer it when what it needs is loaded; nobody waits for that here."""
        if len(self._waiting) < _MOST_WAITING:
            self._waiting.append((address, command))
        else:
            reason = f"{command.kind}: {_MOST_WAITING} wait already for what is still being loaded: ask again"
            self._server.answer(address, Ack(command.uuid, "refused", reason))

    def _tell_once(self, failure: str) -> None:
        """A disk that is full stays so for a while: one event when it begins."""
        if failure and not self._unjournalled:
            text = f"answers to commands are not on disk: {failure}"
            self._main.say(Event("not_journalled", text, self._main.clock.now()))
        self._unjournalled = failure

    def _publish(self) -> None:
        main, now = self._main, self._main.people.now()
        self._every("state", 0.1, now, main.snapshot)
        self._every("joints", 1 / 30, now, self._joints)
        self._every("poses", 1 / 30, now, self._poses)
        self._publish_chunk(now)
        for event in main.events.since(self._told):
            self._streams.publish("event", event)
        self._told = main.events.newest

    def _every(self, stream: str, period: float, now: float, content: Callable[[], object]) -> None:
        if now >= self._due.get(stream, 0.0):
            self._due[stream] = now + period
            self._streams.publish(stream, content())

    def _publish_chunk(self, now: float) -> None:
        """The newest chunk when there is another one, and once a second for who comes late."""
        shown = self._main.inference.shown
        if shown is not self._shown or (shown is not None and now >= self._due.get("chunk", 0.0)):
            self._shown = shown
            self._due["chunk"] = now + 1.0
            self._streams.publish("chunk", {"chunk": 0} if shown is None else self._chunk(shown))

    def _chunk(self, shown: ShownChunk) -> dict[str, Any]:
        """Rows float32 [H, D], poses float32 [H, 8 * arms], the step each row is for (-1: none)."""
        return {
            "chunk": shown.number,
            "run": shown.run,
            "state": shown.state,
            "observation_step": shown.observation_step,
            "step": int(self._main.page.control.read()["step"]),
            "targets": shown.targets,
            "rows": shown.rows.astype(np.float32),
            "poses": self._main.spaces.eef_of(shown.rows),
            "overlap": shown.overlap,
            "ik": dict(shown.ik),
        }

    def _joints(self) -> dict[str, Any]:
        """One control step joint by joint, float32 [D] each: NaN in `planned` and `raw` where there is none.

        `raw` is what the newest chunk wants for the step, `planned` what was made of all chunks before safety,
        `simulated` where the robot of a run in simulation was told to be. `chunk` has the largest part in the step
        (-1: none), `chunks` made it, safety has `limited` it.
        """
        status, seen = self._main.page.control.read(), self._main.page.observation.read()
        step = int(status["step"])
        raw, ticked = self._main.inference.raw(step), bool(status["behaviour"])
        nothing = np.full(len(seen["qpos"]), np.nan, np.float32)
        return {
            "step": step,
            "measured": seen["qpos"].copy(),
            "raw": nothing if raw is None else raw.astype(np.float32),
            "planned": status["smoothed"].copy() if ticked else nothing,
            "commanded": status["commanded"].copy(),
            "engaged": bool(status["engaged"]),
            "simulated": status["simulated"].copy() if ticked else nothing,
            "chunk": int(status["chunk"]) if ticked else -1,
            "chunks": int(status["chunks"]),
            "limited": bool(status["limited"]),
        }

    def _poses(self) -> np.ndarray:
        """End effectors as one float32 frame [2, 8 * arms]: measured, commanded (NaN while nothing is sent)."""
        status, seen = self._main.page.control.read(), self._main.page.observation.read()
        poses = self._main.spaces.eef_of(np.stack([seen["qpos"], status["commanded"]]))
        if not status["engaged"]:
            poses[1] = np.nan
        return poses

    def close(self) -> None:
        self._server.close()
        self._streams.close()


def main() -> None:
    """The process main: decide and serve until the supervisor is gone."""
    heap.keep()
    member = join("main")
    deciding = Director(member.plan, member.page, MonotonicClock(), ThreadRunner())
    service = Service(deciding, zmq.Context.instance())
    while not member.lifeline.cut:
        deciding.pump()
        service.serve(0.004)
    deciding.close()
    service.close()


if __name__ == "__main__":
    main()
