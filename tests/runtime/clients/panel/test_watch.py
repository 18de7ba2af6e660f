"""What the panel says of a station."""

from __future__ import annotations

import pytest

from runtime.clients.panel.watch import displayed_state
from runtime.core.sentences import Pattern, fixed, within
from runtime.ipc.session_state import complete_state_meaning

_BECAUSE = Pattern("inbox.of_this_test", "{why}: {trouble}")
_HELD = Pattern("safety.of_this_test", "refused: {why}")
_SILENT = Pattern("policy.of_this_test", "the policy at {url} is silent")


def said(reason, **more):
    snapshot = {"state": "running", "reason": reason, "allowed": ["stop", "halt", "estop"], **more}
    return displayed_state(complete_state_meaning(snapshot | {"sentences": within(snapshot)}))


def test_it_says_what_goes_on_and_who_commands():
    lease = {"holder": "web:ann:p1", "by": "ann (operator)"}
    run = {"number": 3, "elapsed": 4.25, "duration_s": 60.0}
    told = said(fixed("health.of_this_test", "nobody commands the station"), lease=lease, run=run)
    assert told == {
        "state": "running",
        "tone": "ok",
        "reason": "nobody commands the station",
        "holder": "ann (operator)",
        "stoppable": True,
        "latched": False,
        "elapsed_s": 4.25,
        "limit_s": 60.0,
    }


@pytest.mark.parametrize(
    "reason",
    [
        _SILENT(url="ws://gpu-3:8000"),
        _BECAUSE(why="no usable chunk", trouble=_SILENT(url="ws://gpu-3:8000")),
        _HELD(why=_SILENT(url="ws://gpu-3:8000")),
        "a text of a library that names ws://gpu-3:8000",
    ],
)
def test_it_says_nothing_of_the_policy_which_a_blind_plan_hides(reason):
    assert said(reason)["reason"] == "the console and the station's log say why"
