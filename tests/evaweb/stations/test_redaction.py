"""What a station says to users from whom the checkpoint is hidden."""

import importlib
import pkgutil

import pytest

import runtime
from evaweb.blinding import station_messages as reasons
from evaweb.blinding.visibility import COVERED, COVERED_AT_REST, FULL_VISIBILITY
from evaweb.stations import redaction
from runtime.core.sentences import Pattern, declared_patterns, identity, plain, within
from runtime.processes.coordinator import operations

LOST = Pattern("test.redaction.lost", "{url} did not answer")(url="ws://alder:8000")
STATE = Pattern("test.redaction.state", "running -> holding: {reason}")
COMMAND = Pattern("test.redaction.command", "run by ann: refused, {reason}")
STOPPED = Pattern("test.redaction.stopped", "stopped by the operator")()
CAMERA = Pattern("test.redaction.camera", "camera {camera} is back")

ESTOPPED = Pattern("health.estopped", "e-stop {pressed}: make safe, then release")
PRESSED = Pattern("health.pressed_by", "by {who}: {why}")
LOST_CAMERA = Pattern("cameras.not_live", "camera {camera} ({source}) is {condition}: {why}")
LINK = Pattern("health.link_lost", "no observation for {seconds:.1f} s: {who}")
ASK = Pattern("health.ask_for_node", "is the execution node running?")()
REFUSED = Pattern("control.refused_in_a_row", "{count} actions refused in a row, the last one: {why}")
JUMPS = Pattern("safety.jumps", "{joint} jumps {distance:.2f} rad, allowed {allowed:g}")
OLD = Pattern("safety.joints_old", "joint readings are {seconds:.2f} s old (limit {allowed:g} s)")
MISSING = Pattern(
    "control.joints_missing",
    "{why}: the run is held, and continues by itself if they are back before they are {seconds:g} s old",
)
STARVED = Pattern("control.starved", "no usable chunk for {seconds:.1f} s")
TUNED = Pattern("operations.tuned_to", "strategy {strategy}, task {task!r}")

TRUTH = {"reset": "a", "objects": {"block": [0.1, 0.2]}, "milestones": {"lifted": True}, "success": True}


def test_of_the_benchs_truth_what_was_reached_is_left_out():
    told = TRUTH | {"over": "success", "steps": 7}
    shown = redaction.redact_state({"state": "ready", "truth": told}, FULL_VISIBILITY)
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
    (shown,) = redaction.redact_events([row], FULL_VISIBILITY)
    assert {key: shown[key] for key in ("id", "arguments") if key in shown} == (
        identity(text) if kept else {}
    )
    assert "alder" not in str(shown)
    # what says more than its text is no argument of that text
    more = {**row, "arguments": {**row["arguments"], "url": "ws://alder:8000"}}
    assert "alder" not in str(redaction.redact_events([more], FULL_VISIBILITY))


def test_a_refusal_while_a_process_is_starting_keeps_the_id_by_which_pages_ask_again():
    starting = operations._FAMILY_STARTING(process="media")
    assert identity(FULL_VISIBILITY.redact_text(starting)) == identity(starting)


def test_of_a_snapshot_those_sentences_are_left_that_are_shown_whole():
    said = {"state": "holding", "reason": LOST, "guarded": {"run": STOPPED}, "last_run": {"reason": LOST}}
    shown = redaction.redact_state({**said, "sentences": within(said)}, FULL_VISIBILITY)
    assert shown["reason"] == COVERED
    assert shown["sentences"] == {"guarded.run": identity(STOPPED), "reason": identity(COVERED)}
    assert "alder" not in str(shown)


def test_what_is_covered_says_what_can_be_done_where_the_set_up_failed():
    said = {"state": "idle", "reason": LOST}
    shown = redaction.redact_state({**said, "sentences": within(said)}, FULL_VISIBILITY)
    assert shown["reason"] == COVERED_AT_REST
    assert shown["sentences"]["reason"] == identity(COVERED_AT_REST)


@pytest.mark.parametrize(("kind", "told"), [("truth", False), ("camera_back", True), ("estopped", True)])
def test_an_event_that_says_how_it_went_is_none(kind, told):
    row = {"number": 1, "kind": kind, "text": "the simulated bench says: success", "data": {"success": True}}
    assert bool(redaction.redact_events([row], FULL_VISIBILITY)) is told


def holding(reason):
    """The reason of a blind station, as somebody reads it from whom the checkpoint is hidden, and in its event."""
    said = {"state": "holding", "reason": reason}
    shown = redaction.redact_state({**said, "sentences": within(said)}, FULL_VISIBILITY)
    text = STATE(reason=reason)
    row = {"number": 1, "kind": "state", "text": plain(text), "data": {}, **identity(text)}
    (event,) = redaction.redact_events([row], FULL_VISIBILITY)
    assert event["text"] == f"running -> holding: {shown['reason']}"
    return shown


@pytest.mark.parametrize(
    ("reason", "said"),
    [
        (
            ESTOPPED(pressed=PRESSED(who="ann", why="it came too near")),
            "e-stop by ann: it came too near: make safe, then release",
        ),
        (
            LOST_CAMERA(camera="cam_high", source="usb", condition="absent", why="no such device"),
            "camera cam_high (usb) is absent: no such device",
        ),
        (LINK(seconds=1.5, who=ASK), "no observation for 1.5 s: is the execution node running?"),
        (
            REFUSED(count=10, why=JUMPS(joint="left_2", distance=0.31, allowed=0.1)),
            "actions were refused, the last one: an action would have jumped farther than allowed (safety.jump)",
        ),
        (REFUSED(count=10, why="numbers of somebody else"), "safety held the robot"),
        (
            MISSING(why=OLD(seconds=0.31, allowed=0.2), seconds=1.0),
            "joints were too old (safety.joint_age_s): the run is held, and continues by itself if they are back "
            "before they are 1 s old",
        ),
        (STARVED(seconds=1.2), COVERED),
        (TUNED(strategy="rtc", task="put it there"), COVERED),
    ],
)
def test_what_tells_nothing_of_the_policy_is_said_and_what_may_is_covered(reason, said):
    shown = holding(reason)
    assert shown["reason"] == said
    whole = shown["sentences"].get("reason", identity(""))
    assert whole in (identity(shown["reason"]), identity(""))
    assert "0.31" not in str(shown)


def test_what_is_covered_by_its_id_is_no_other_sentence_that_is_shown():
    """Each id of the table is a sentence of a station: one that was renamed would be covered without a word."""
    for module in pkgutil.walk_packages(runtime.__path__, "runtime."):
        simulated = module.name.startswith(("runtime.simulation", "runtime.standins"))
        if not simulated and not module.name.endswith("__main__"):
            importlib.import_module(module.name)
    ids = {pattern.id for pattern in declared_patterns()}
    assert reasons._NOT | reasons._ALSO | {*reasons._LIMITS, *reasons._IN_A_ROW, reasons._BY_A_PERSON} <= ids
    kinds = {id.partition(".")[0] for id in ids}
    assert {*reasons._OF_THE_ROBOT, *reasons._OF_THE_STATION} <= kinds


@pytest.mark.parametrize("kind", ["policy", "rtc", "tuning", "inbox", "preflight", "rights", "queries"])
def test_of_the_policy_nothing_is_said(kind):
    pattern = Pattern(f"{kind}.anything_at_all", "the server at alder has answered")
    assert reasons.uncovered(pattern()) is None


def test_neither_numbers_nor_gaps_in_them_count_the_events_that_are_left_out():
    def told(hidden):
        rows = [{"kind": "state", "text": "idle -> ready", "time": 2.5, "data": {}}]
        rows += [{"kind": "limited", "text": "x", "time": 2.5 + 0.1 * at, "data": {}} for at in range(hidden)]
        rows += [{"kind": "estopped", "text": "e-stop", "time": 9.0, "data": {}}] * 2
        return redaction.redact_events(
            [{**row, "number": at} for at, row in enumerate(rows, 1)], FULL_VISIBILITY
        )

    assert told(0) == told(5)
    assert [row["number"] for row in told(3)] == [2_500_000, 9_000_000, 9_000_001]
    states = [
        redaction.redact_state({"state": "ready", "newest_event": newest}, FULL_VISIBILITY)
        for newest in (3, 8)
    ]
    assert states[0] == states[1]


@pytest.mark.parametrize(
    ("before", "state", "shown"),
    [
        ("setting_up", "ready", "setting_up -> ready"),
        (
            "setting_up",
            "idle",
            "setting_up -> idle: hidden until the reveal: set up again; if that fails again, ",
        ),
        (
            "running",
            "holding",
            "running -> holding: hidden until the reveal: check whether the robot stands safely",
        ),
    ],
)
def test_what_stands_for_a_hidden_reason_asks_for_nothing_where_nothing_is_to_be_done(before, state, shown):
    row = {"number": 1, "kind": "state", "text": f"{before} -> {state}: {plain(LOST)}", "data": {}}
    (event,) = redaction.redact_events([row], FULL_VISIBILITY)
    assert event["text"].startswith(shown)
    assert (event["text"] == shown) is (state == "ready")
    snapshot = redaction.redact_state({"state": state, "reason": LOST}, FULL_VISIBILITY)
    assert (plain(snapshot["reason"]) == "hidden until the reveal") is (state == "ready")
