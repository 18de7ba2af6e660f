"""Drives of a simulated robot, on or off, with faults; `python -m runtime.simulation.drives` switches them.

Control words on the node's command socket: "drives_disable", "drives_enable" (which clears all faults), and
"drives_fault" with a `fault`, a sentence. Operators at the robot send them, so the sender need not be the gate's
master.
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
_PATIENCE_S = 5.0  # wait for a node, and for the message to be sent


@dataclass(frozen=True, slots=True)
class DriveSwitch:
    """Request to switch the drives on or off.

    Switching on clears all faults. `fault` is the fault with which the drives are switched off, "" for none.
    """

    on: bool
    fault: str = ""


def parse_switch(word: str, message: Mapping[Any, Any]) -> DriveSwitch | None:
    """Return the switch that `word`, one of WORDS, requests; None if its fault is missing, empty or too long."""
    if word != "drives_fault":
        return DriveSwitch(word == "drives_enable")
    fault = message.get("fault")
    fits = isinstance(fault, str) and 0 < len(fault) <= DRIVE_FAULT_LENGTH
    return DriveSwitch(False, str(fault)) if fits else None


class Drives:
    """State of the drives; they are off while there is a fault, and then do not move the robot."""

    def __init__(self, enabled: bool = True, faults: Sequence[str] = ()) -> None:
        self._faults = list(faults)
        self.enabled = enabled and not faults

    def apply(self, switch: DriveSwitch) -> None:
        """Switch the drives on, off, or off with one more fault; the newest DRIVE_FAULTS_LIMIT faults are retained."""
        self.enabled = switch.on
        faults = [] if switch.on else [*self._faults, *([switch.fault] if switch.fault else [])]
        self._faults = faults[-DRIVE_FAULTS_LIMIT:]

    def status(self) -> dict[str, object]:
        """Return the state of the drives for the node's observation message."""
        return {"enabled": self.enabled, "faults": list(self._faults)}


def send_word(endpoint: str, word: str, fault: str = "") -> bool:
    """Send one of WORDS to the node that receives commands at `endpoint`; return False if no node connects in time."""
    socket: zmq.Socket[bytes] = zmq.Context.instance().socket(zmq.XPUB)
    try:
        socket.setsockopt(zmq.LINGER, int(_PATIENCE_S * 1000))
        socket.connect(endpoint)
        if not socket.poll(
            int(_PATIENCE_S * 1000)
        ):  # the node's subscription; messages sent before it would be lost
            return False
        socket.send(msgpack_arrays.pack({"t": 0.0, "target": word, "fault": fault}))
        return True
    finally:
        socket.close()


@exit_on_broken_pipe
def main(arguments: Sequence[str] | None = None) -> int:
    """Switch the drives of a node; return 0 if the word was sent, 1 if no node listens."""
    line = argparse.ArgumentParser(
        prog="python -m runtime.simulation.drives", description="Switches the drives of a simulated robot."
    )
    line.add_argument("what", choices=[word.removeprefix("drives_") for word in WORDS])
    line.add_argument(
        "--action-endpoint", default="tcp://127.0.0.1:5556", help="where the node takes commands"
    )
    line.add_argument("--fault", default="drive 1: over-current", metavar="TEXT", help="fault: what it says")
    options = line.parse_args(arguments)
    if send_word(options.action_endpoint, f"drives_{options.what}", options.fault):
        return 0
    print(f"no node listens at {options.action_endpoint}", file=sys.stderr)
    return 1


if __name__ == "__main__":
    sys.exit(main())
