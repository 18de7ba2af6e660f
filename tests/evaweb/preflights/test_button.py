"""When the console's button can be pressed."""

import pytest

from tests.evaweb.console.test_modules import NODE, run
from tests.standing import state_flags

pytestmark = pytest.mark.skipif(NODE is None, reason="Node is not installed: the page's modules are not run")


@pytest.mark.parametrize(
    ("store", "checkpoint", "says"),
    [
        ({"role": "operator", "fresh": True, "snapshot": {**state_flags("idle")}}, "pi0", ""),
        ({"role": "operator", "fresh": True, "snapshot": {**state_flags("ready")}}, "pi0", ""),
        ({"role": "operator", "fresh": False, "snapshot": {**state_flags("running")}}, "pi0", ""),
        ({"role": "operator", "fresh": False}, "pi0", ""),
        ({"role": "operator", "fresh": True, "snapshot": {**state_flags("idle")}}, "", "choose a checkpoint"),
        ({"role": "viewer", "fresh": True, "snapshot": {**state_flags("idle")}}, "pi0", "a viewer watches"),
        (
            {"role": "operator", "fresh": True, "snapshot": {**state_flags("setting_up")}},
            "pi0",
            "not while setting up",
        ),
        (
            {"role": "admin", "fresh": True, "snapshot": {**state_flags("running")}},
            "pi0",
            "not while running",
        ),
        (
            {"role": "admin", "fresh": True, "snapshot": {**state_flags("holding")}},
            "pi0",
            "not while holding",
        ),
    ],
)
def test_it_says_why_it_cannot_be_pressed(store, checkpoint, says):
    said = run(
        "commands/reasons.js",
        "return m.preflightProblem(given.store, given.checkpoint)",
        {"store": store, "checkpoint": checkpoint},
    )
    assert said.startswith(says)
    assert bool(said) == bool(says)
