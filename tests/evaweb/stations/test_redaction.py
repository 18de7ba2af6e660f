"""What a station says to users from whom the checkpoint is hidden."""

import pytest

from evaweb.blinding import EVERYTHING, HIDDEN
from evaweb.stations import redaction
from runtime.core.sentences import Pattern, identity, plain, within
from runtime.processes.coordinator import operations

LOST = Pattern("test.redaction.lost", "{url} did not answer")(url="ws://alder:8000")
STATE = Pattern("test.redaction.state", "running -> holding: {reason}")
COMMAND = Pattern("test.redaction.command", "run by ann: refused, {reason}")
STOPPED = Pattern("test.redaction.stopped", "stopped by the operator")()
CAMERA = Pattern("test.redaction.camera", "camera {camera} is back")

TRUTH = {"reset": "a", "objects": {"block": [0.1, 0.2]}, "milestones": {"lifted": True}, "success": True}


def test_of_the_benchs_truth_what_was_reached_is_left_out():
    shown = redaction.state({"state": "ready", "truth": TRUTH}, EVERYTHING)
    assert shown["truth"] == {"reset": "a", "objects": {"block": [0.1, 0.2]}}


@pytest.mark.parametrize(
    ("kind", "text", "kept"),
    [
        ("state", STATE(reason=LOST), False),
        ("state", STATE(reason=STOPPED), True),
        ("command", COMMAND(reason=LOST), False),
        ("command", COMMAND(reason=STOPPED), True),
        ("camera_back", CAMERA(camera="cam_high"), True),
        ("episode_closed", CAMERA(camera="cam_high"), False),
    ],
)
def test_id_and_arguments_go_with_the_text_that_they_are_of(kind, text, kept):
    row = {"number": 1, "kind": kind, "text": plain(text), "data": {}, **identity(text)}
    (shown,) = redaction.events([row], EVERYTHING)
    assert {key: shown[key] for key in ("id", "arguments") if key in shown} == (
        identity(text) if kept else {}
    )
    assert "alder" not in str(shown)
    # what says more than its text is no argument of that text
    more = {**row, "arguments": {**row["arguments"], "url": "ws://alder:8000"}}
    assert "alder" not in str(redaction.events([more], EVERYTHING))


def test_a_refusal_while_a_process_is_starting_keeps_the_id_by_which_pages_ask_again():
    starting = operations._FAMILY_STARTING(process="media")
    assert identity(EVERYTHING.told(starting)) == identity(starting)


def test_of_a_snapshot_those_sentences_are_left_that_are_shown_whole():
    said = {"state": "holding", "reason": LOST, "guarded": {"run": STOPPED}, "last_run": {"reason": LOST}}
    shown = redaction.state({**said, "sentences": within(said)}, EVERYTHING)
    assert shown["reason"] == HIDDEN
    assert list(shown["sentences"]) == ["guarded.run"]
    assert "alder" not in str(shown)


@pytest.mark.parametrize(("kind", "told"), [("truth", False), ("camera_back", True), ("estopped", True)])
def test_an_event_that_says_how_it_went_is_none(kind, told):
    row = {"number": 1, "kind": kind, "text": "the simulated bench says: success", "data": {"success": True}}
    assert bool(redaction.events([row], EVERYTHING)) is told
