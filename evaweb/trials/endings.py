"""Causes that ended a run prematurely; independent of Django, so that exported analyses share it."""

from __future__ import annotations

import re

ESTOP, INTERRUPTION, TIMEOUT = "estop", "interruption", "timeout"
ENDINGS = {ESTOP: "the e-stop", INTERRUPTION: "an interruption", TIMEOUT: "its time limit"}
_ESTOP = re.compile(r"\be-stop\b")
_TIMEOUT = re.compile(r"the run's [\d.e+]+ s are over")


def ending_of(interrupted: bool, reason: str) -> str:
    """Return the cause that ended the run, one of `ENDINGS`, from the reason that the station gave.

    "" if the run ended by itself or the operator stopped it.
    """
    if interrupted:
        return ESTOP if _ESTOP.search(reason) else INTERRUPTION
    return TIMEOUT if _TIMEOUT.search(reason) else ""
