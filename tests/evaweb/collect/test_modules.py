"""What the buttons of the Collect page mean, and presses of gamepads: the page's own modules, run by Node."""

from __future__ import annotations

from typing import Any

import pytest

from tests.evaweb.console.test_modules import pytestmark, run
from tests.standing import state_flags

__all__ = ["pytestmark"]
MOMENTS, PADS = "../collect/actions.js", "../collect/pad_buttons.js"
COLLECT = {"set_up": True, "armed": True, "why_not": "", "episode": None, "last": None, "leader": None}


def call(name: str, *given: Any) -> Any:
    return run(MOMENTS, f"return m.{name}(...given);", list(given))


@pytest.mark.parametrize("state", ["setting_up", "running", "holding"])
def test_wherever_the_robot_moves_the_big_button_stops_it(state: str) -> None:
    assert call("primaryAction", state_flags(state))["kind"] == "stop"


@pytest.mark.parametrize("state", ["ready", "idle", "faulted", "disconnected"])
def test_at_rest_it_starts(state: str) -> None:
    assert call("primaryAction", state_flags(state)) == {"kind": "run", "text": "Start"}


@pytest.mark.parametrize(
    ("changes", "session", "said"),
    [
        ({}, "s", ""),
        ({}, "", "open or resume a session first"),
        ({"set_up": False}, "s", "set up first"),
        ({"armed": False}, "s", "arm first"),
    ],
)
def test_nothing_starts_without_session_set_up_and_arm(
    changes: dict[str, Any], session: str, said: str
) -> None:
    assert call("startProblem", {"collect": {**COLLECT, **changes}}, session) == said


def test_a_station_that_collects_nothing_starts_nothing() -> None:
    assert call("startProblem", {"collect": None}, "s") == "this station collects nothing"


def test_what_is_said_is_about_the_open_episode_else_the_newest() -> None:
    last = {"uuid": "c", "result": None, "discarded": False}
    assert call("labelTarget", {**COLLECT, "episode": "a", "last": last}, "b") == "a"
    assert call("labelTarget", {**COLLECT, "last": last}, "b") == "b"
    assert call("labelTarget", {**COLLECT, "last": last}, None) == "c"


def test_a_discarded_episode_is_not_labelled_and_not_discarded_again() -> None:
    snapshot = {**state_flags("ready"), "collect": {**COLLECT, "last": {"uuid": "a", "discarded": True}}}
    assert call("labelProblem", snapshot, "a") == "the episode is discarded"
    assert call("discardProblem", snapshot, "a") == "the episode is discarded already"
    assert call("labelProblem", snapshot, "b") == ""


def test_the_open_episode_is_not_named_where_it_is_discarded() -> None:
    assert call("discardArguments", {**COLLECT, "episode": "a"}, "a") == {}
    assert call("discardArguments", COLLECT, "a") == {"episode": "a"}


def test_an_episode_is_labelled_once_it_is_over() -> None:
    assert (
        call("labelProblem", {**state_flags("running"), "collect": {**COLLECT, "episode": "a"}}, "a")
        == "stop and save first"
    )


def test_the_step_to_do_is_the_result_until_somebody_has_said_it() -> None:
    last = {"uuid": "a", "result": None, "discarded": False}
    ready = {**state_flags("ready"), "collect": {**COLLECT, "last": last}}
    assert call("collectStep", ready, None) == "session"
    assert call("collectStep", ready, "s") == "result"
    assert (
        call(
            "collectStep",
            {**state_flags("ready"), "collect": {**COLLECT, "last": {**last, "result": "fail"}}},
            "s",
        )
        == "record"
    )
    assert call("collectStep", {**state_flags("idle"), "collect": COLLECT}, "s") == "setup"


def twice(body: str) -> Any:
    """What `body` returns, and what was forgotten of the questions that it asked."""
    return run(
        MOMENTS,
        "const forgotten = []; const twice = new m.Twice((what) => forgotten.push(what));"
        f"const found = (() => {{ {body} }})(); return [found, forgotten];",
    )


def test_what_cannot_be_taken_back_is_asked_once_however_long_that_stands() -> None:
    pressed = """
    const pressed = [twice.press("discard")];
    performance.now = () => 1e9;
    return [...pressed, twice.asks("discard"), twice.press("discard"), twice.asks("discard"), twice.press("discard")];
    """
    assert twice(pressed) == [[False, True, True, False, False], []]


def test_another_question_takes_its_place() -> None:
    pressed = 'return ["discard", "rerecord", "discard"].map((what) => twice.press(what));'
    assert twice(pressed) == [[False, False, False], []]


def test_after_anything_else_it_is_asked_anew() -> None:
    pressed = 'twice.press("discard"); twice.clear(); twice.clear(); return twice.press("discard");'
    assert twice(pressed) == [False, ["discard"]]


def test_a_question_never_carries_over_to_another_episode_or_back() -> None:
    pressed = """
    twice.about("a"); twice.press("discard"); twice.about("a");
    const stands = twice.asks("discard");
    twice.about("b"); twice.about("a");
    return [stands, twice.press("discard")];
    """
    assert twice(pressed) == [[True, False], ["discard"]]


# Keys as keys.js has them, `d` being ours; `other` counts the presses that are somebody else's.
WINDOW = """
const heard = [];
globalThis.window = {
  addEventListener: (kind, take, options) => heard.push({ kind, take, capture: Boolean(options?.capture) }),
};
const tell = (kind, event) => {
  for (const first of [true, false]) {
    for (const one of heard) if (one.kind === kind && one.capture === first) one.take(event);
  }
};
const [ours, theirs] = [{ ours: true }, { ours: false }];
const click = (target) => tell("click", { target });
window.addEventListener("keydown", ({ key }) => (key === "d" ? click(ours) : key === "h" && click(theirs)));
let other = 0;
m.otherPresses((target) => target.ours, () => (other += 1));
const press = (key, target = theirs, repeat = false) => tell("keydown", { key, target, repeat });
"""


@pytest.mark.some(4)
@pytest.mark.parametrize(
    ("pressed", "others"),
    [
        ("press('d')", False),
        ("click(ours)", False),
        ("press('d'); press('d', theirs, true)", False),  # held
        ("press('Enter', ours); click(ours)", False),
        ("press('h')", True),
        ("press('x')", True),
        ("press('Escape')", True),
        ("press('x', ours)", True),
        ("click(ours); press('x')", True),
        ("click(theirs)", True),
        ("tell(m.PRESSED, {})", True),  # a pad
    ],
)
def test_keys_fingers_and_pads_are_presses_and_those_of_ones_own_button_are_no_other(
    pressed: str, others: bool
) -> None:
    assert run("../site/presses.js", WINDOW + pressed + "; return other > 0;") is others


def looks(*frames: list[dict[str, Any]]) -> list[list[int]]:
    """The buttons pressed in each look; a frame is the pads that are there."""
    program = """
    const presses = new m.Presses();
    return given.map((pads) => presses.look(pads).map(({ button }) => button));
    """
    return run(PADS, program, list(frames))


def pad(*down: int, id: str = "pad", connected: bool = True) -> dict[str, Any]:
    return {
        "index": 0,
        "id": id,
        "connected": connected,
        "buttons": [{"pressed": n in down} for n in range(17)],
    }


def test_a_button_that_goes_down_is_one_press_however_long_it_is_held() -> None:
    assert looks([pad()], [pad(0)], [pad(0)], [pad(0, 1)], [pad()], [pad(0)]) == [[], [0], [], [1], [], [0]]


def test_a_button_held_while_the_pad_connects_does_nothing_until_it_was_let_go() -> None:
    assert looks([pad(0)], [pad(0)], [pad()], [pad(0)]) == [[], [], [], [0]]


@pytest.mark.parametrize("between", [[], [pad(0, connected=False)], [pad(0, id="another")]])
def test_a_pad_that_was_away_begins_anew(between: list[dict[str, Any]]) -> None:
    assert looks([pad()], between, [pad(0)], [pad(0)]) == [[], [], [], []]


def test_after_a_while_of_not_looking_nothing_counts_as_pressed() -> None:
    program = "const p = new m.Presses(); p.look([given[0]]); p.forget(); return p.look([given[1]]).length;"
    assert run(PADS, program, [pad(), pad(0)]) == 0


def test_a_button_does_one_thing_and_what_was_kept_badly_is_as_delivered() -> None:
    changed = run(PADS, "return m.withAssignment(m.defaultMapping(), 'arm', 0);")
    assert (changed["arm"], changed["big"], changed["discard"]) == (0, None, 1)
    kept = '{"arm": 4, "big": null, "discard": [], "fail": -1, "other": 3}'
    found = run(PADS, "return m.parseMapping(given);", kept)
    assert (found["arm"], found["big"], found["discard"], found["fail"]) == (4, None, 1, 13)
    assert run(PADS, "return m.parseMapping('{');") == run(PADS, "return m.defaultMapping();")
    assert run(PADS, "return [m.buttonName(0, 'standard'), m.buttonName(9, ''), m.buttonName(null)];") == [
        "A (0)",
        "button 9",
        "none",
    ]


@pytest.mark.parametrize(
    ("key", "said"),
    [
        (" ", "Space is the e-stop"),
        ("Escape", "Esc is the e-stop"),
        ("D", "the page already uses D"),
        ("Shift", "Shift alone cannot be assigned"),
        ("b", ""),
        ("F13", ""),
    ],
)
def test_the_key_of_a_pedal_is_neither_the_e_stop_nor_one_of_the_pages(key: str, said: str) -> None:
    assert run(PADS, "return m.whyNotKey(given, ['d', 'enter']);", key) == said


def test_the_key_of_a_pedal_is_kept_as_a_button_is() -> None:
    found = run(
        PADS, "return m.parseMapping(JSON.stringify(m.withAssignment(m.defaultMapping(), 'big', 'b')));"
    )
    assert (found["big"], found["arm"]) == ("b", 9)
    assert run(PADS, "return m.buttonName('b');") == "key B"
    assert run(PADS, "return m.parseMapping(given).big;", '{"big": " "}') == 0
