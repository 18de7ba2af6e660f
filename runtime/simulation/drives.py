"""The drives of a simulated robot: on or off, with faults; `python -m runtime.simulation.drives` switches them.

Words on the node's command socket: "drives_disable", "drives_enable" (which clears all faults), "drives_fault"
with a `fault`, a sentence. They come from whoever stands at the robot, so they ask for no mastery.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import zmq

from robots.broken_pipe import exit_on_broken_pipe
from runtime.core import msgpack_arrays
from runtime.transports.node_messages import DRIVE_FAULT_LENGTH, DRIVE_FAULTS_LIMIT

WORDS = ("drives_disable", "drives_enable", "drives_fault")
_PATIENCE_S = 5.0


@dataclass(frozen=True, slots=True)
class DriveSwitch:
    """Switching of the drives: on, which clears all faults; off; off because of `fault`."""

    on: bool
    fault: str = ""


def parse_switch(word: str, message: Mapping[Any, Any]) -> DriveSwitch | None:
    """Switch that one of WORDS asks for; None if its fault is invalid."""
    if word != "drives_fault":
        return DriveSwitch(word == "drives_enable")
    fault = message.get("fault")
    fits = isinstance(fault, str) and 0 < len(fault) <= DRIVE_FAULT_LENGTH
    return DriveSwitch(False, str(fault)) if fits else None


class Drives:
    """Off while there is a fault; what is off moves nothing."""

    def __init__(self, enabled: bool = True, faults: Sequence[str] = ()) -> None:
        self._faults = list(faults)
        self.enabled = enabled and not faults

    def apply(self, switch: DriveSwitch) -> None:
        """Go on, off, or off with one more fault, of which the newest are kept."""
        self.enabled = switch.on
        faults = [] if switch.on else [*self._faults, *([switch.fault] if switch.fault else [])]
        self._faults = faults[-DRIVE_FAULTS_LIMIT:]

    def status(self) -> dict[str, object]:
        """The node's report of its drives."""
        return {"enabled": self.enabled, "faults": list(self._faults)}


def send_word(endpoint: str, word: str, fault: str = "") -> bool:
    """Say one of WORDS to the node that takes commands at `endpoint`; False where no node came to listen."""
    socket: zmq.Socket[bytes] = zmq.Context.instance().socket(zmq.XPUB)
    try:
        socket.setsockopt(zmq.LINGER, int(_PATIENCE_S * 1000))
        socket.connect(endpoint)
        if not socket.poll(int(_PATIENCE_S * 1000)):  # the node's subscription: from now on it hears us
            return False
        socket.send(msgpack_arrays.pack({"t": 0.0, "target": word, "fault": fault}))
        return True
    finally:
        socket.close()


@exit_on_broken_pipe
def main(arguments: Sequence[str] | None = None) -> int:
    """Exit code 0 where the node was told, 1 where none listens."""
    line = argparse.ArgumentParser(
        prog="python -m runtime.simulation.drives", description="Switches the drives of a simulated robot."
    )
    line.add_argument("what", choices=[word.removeprefix("drives_") for word in WORDS])
    line.add_argument(
        "--action-endpoint", default="tcp://127.0.0.1:5556", help="where the node takes commands"
    )
    line.add_argument("--fault", default="drive 1: over-current", metavar="TEXT", help="fault: what it says")
    given = line.parse_args(arguments)
    if send_word(given.action_endpoint, f"drives_{given.what}", given.fault):
        return 0
    print(f"no node listens at {given.action_endpoint}", file=sys.stderr)
    return 1


if __name__ == "__main__":
    sys.exit(main())
