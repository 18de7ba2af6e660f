"""Sender at the other end of a transport, which records the start times of its messages.

`python -m benchmarks.wires_sender TIMES PAGE MODULE ARGUMENT...` runs the simulated robot `runtime.simulation.MODULE`,
or with MODULE "cameras" MJPEG cameras: COUNT RATE WIDTH HEIGHT. At its end it writes the times [s] to the file TIMES as
JSON: by message from 0 on, or by camera. If PAGE is the descriptor of the shared state that receives a simulated
robot's images, the sender is never more than a few images ahead of the receiver, so that none is lost.
"""

from __future__ import annotations

import importlib
import json
import socket
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from threading import Event

import robots
from benchmarks.wires_receiver import layout
from robots.broken_pipe import exit_on_broken_pipe
from runtime.core.clock import Clock
from runtime.ipc.shared_state import SharedState
from runtime.simulation import node, program
from runtime.standins.mjpeg_server import MjpegServer

_AHEAD = 4  # images; the queues of every transport are at least as long
_LOOK_S = 0.0005


class Pace:
    """Limit that keeps a sender at most a few images ahead of the receiver.

    `arrived` returns the number of images that have arrived. An image that has not arrived after `patience` [s] counts
    as lost.
    """

    def __init__(self, arrived: Callable[[], int], clock: Clock, patience: float = 0.05) -> None:
        self._arrived, self._clock, self._patience = arrived, clock, patience
        self._seen, self._ahead = arrived(), 0

    def wait(self) -> None:
        """Wait until the sender may send one more image."""
        end = self._clock.now() + self._patience
        while True:
            arrived = self._arrived()
            self._ahead = max(0, self._ahead - (arrived - self._seen))
            self._seen = arrived
            if self._ahead < _AHEAD:
                break
            now = self._clock.now()
            if now >= end:
                self._ahead = 0
                break
            self._clock.sleep_until(now + _LOOK_S)
        self._ahead += 1


class TimestampingNode:
    """Node that records when each of its ticks begins."""

    def __init__(self, ticking: node.Ticking, clock: Clock, pace: Pace | None) -> None:
        self._ticking, self._clock, self._pace = ticking, clock, pace
        self.times: list[float] = []

    def tick(self, seconds: float) -> None:
        if self._pace is not None:
            self._pace.wait()
        self.times.append(self._clock.now())
        self._ticking.tick(seconds)


class TimestampingCameraServer(MjpegServer):
    """Camera that records when each of its images is sent."""

    def __init__(self, width: int, height: int, rate: float) -> None:
        super().__init__(width, height, rate)
        self.times: list[float] = []

    def _send_picture(self, client: socket.socket, data: bytes) -> None:
        self.times.append(time.monotonic())
        super()._send_picture(client, data)


@exit_on_broken_pipe
def main(file: str, shared: str, module: str, *arguments: str) -> int:
    """Run the sender until its end; return the exit code of the simulated robot.

    Args:
        file: File to which the start times of messages are written.
        shared: Descriptor of the shared state of the receiver; "" if the sender need not keep pace with it.
        module: Module of the simulated robot in `runtime.simulation`, or "cameras".
        arguments: Arguments of the simulated robot, or of the cameras.
    """
    if module == "cameras":
        return _cameras(Path(file), arguments)
    simulated = importlib.import_module(f"runtime.simulation.{module}")
    plain = simulated.run

    def run(ticking: node.Ticking, clock: Clock, rate: float, stop: Event) -> None:
        noting = TimestampingNode(ticking, clock, _pace(shared, arguments, clock) if shared else None)
        plain(noting, clock, rate, stop)
        Path(file).write_text(json.dumps(noting.times), "utf-8")

    simulated.run = run  # type: ignore[attr-defined]
    code: int = simulated.main([*arguments, "--lifeline"])
    return code


def _pace(shared: str, arguments: Sequence[str], clock: Clock) -> Pace:
    robot = robots.load_robot(arguments[arguments.index("--robot") + 1])
    attached = SharedState.attach(layout(robot), int(shared))
    return Pace(lambda: int(attached.observation.read()["picture_number"].min()), clock)


def _cameras(file: Path, arguments: Sequence[str]) -> int:
    count, rate, width, height = int(arguments[0]), float(arguments[1]), int(arguments[2]), int(arguments[3])
    servers = [TimestampingCameraServer(width, height, rate) for _ in range(count)]
    stop = program.stop_event(lifeline=True)
    program.announce_ready({"urls": [server.start() for server in servers]}, None)
    stop.wait()
    for server in servers:
        server.close()
    file.write_text(json.dumps([server.times for server in servers]), "utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
