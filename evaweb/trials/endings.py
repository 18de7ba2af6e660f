"""What ended a run that did not end by itself; no Django, so that exports of before say the same."""

from __future__ import annotations

import re

ESTOP, INTERRUPTION, TIMEOUT = "estop", "interruption", "timeout"
ENDINGS = {ESTOP: "the e-stop", INTERRUPTION: "an interruption", TIMEOUT: "its time limit"}
_ESTOP = re.compile(r"\be-stop\b")
_TIMEOUT = re.compile(r"the run's [\d.e+]+ s are over")


def ending_of(interrupted: bool, reason: str) -> str:
    """One of `ENDINGS` by the station's reason; "" where it ended by itself, or the operator stopped it."""
    if interrupted:
        return ESTOP if _ESTOP.search(reason) else INTERRUPTION
    return TIMEOUT if _TIMEOUT.search(reason) else ""
