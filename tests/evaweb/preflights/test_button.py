"""When the console's button can be pressed."""

import pytest

from tests.evaweb.console.test_modules import NODE, run
from tests.standing import standing

pytestmark = pytest.mark.skipif(NODE is None, reason="Node is not installed: the page's modules are not run")


@pytest.mark.parametrize(
    ("store", "checkpoint", "says"),
    [
        ({"role": "operator", "fresh": True, "snapshot": {**standing("idle")}}, "pi0", ""),
        ({"role": "operator", "fresh": True, "snapshot": {**standing("ready")}}, "pi0", ""),
        ({"role": "operator", "fresh": False, "snapshot": {**standing("running")}}, "pi0", ""),
        ({"role": "operator", "fresh": False}, "pi0", ""),
        ({"role": "operator", "fresh": True, "snapshot": {**standing("idle")}}, "", "choose a checkpoint"),
        ({"role": "viewer", "fresh": True, "snapshot": {**standing("idle")}}, "pi0", "a viewer watches"),
        (
            {"role": "operator", "fresh": True, "snapshot": {**standing("setting_up")}},
            "pi0",
            "not while setting up",
        ),
        ({"role": "admin", "fresh": True, "snapshot": {**standing("running")}}, "pi0", "not while running"),
        ({"role": "admin", "fresh": True, "snapshot": {**standing("holding")}}, "pi0", "not while holding"),
    ],
)
def test_it_says_why_it_cannot_be_pressed(store, checkpoint, says):
    said = run(
        "commands/reasons.js",
        "return m.whyNoPreflight(given.store, given.checkpoint)",
        {"store": store, "checkpoint": checkpoint},
    )
    assert said.startswith(says)
    assert bool(said) == bool(says)
