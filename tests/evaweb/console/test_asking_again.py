"""Resume that is refused while a process of the station is starting: asked again for a moment, run by Node."""

from __future__ import annotations

import json
from typing import Any

import pytest

from tests.evaweb.console.test_modules import MODULES, pytestmark, run

__all__ = ["pytestmark"]

# A page whose clock the test moves by `later(ms)`, whose station answers what is `said`, and whose Resume has key r.
PAGE = """
const lines = [], posts = [], timers = [], heard = [];
let now = 0;
performance.now = () => now;
globalThis.setTimeout = (take, ms) => timers.push([now + ms, take]);
const turn = () => new Promise((resolve) => setImmediate(resolve));
const settled = async () => { for (let turns = 0; turns < 4; turns += 1) await turn(); };
const later = async (ms) => {
  for (const until = now + ms; now < until; ) {
    now += 100;
    for (const timer of timers.splice(0)) timer[0] <= now ? timer[1]() : timers.push(timer);
    await settled();
  }
};
const element = () => ({ dataset: {}, addEventListener() {} });
const line = { dataset: {}, set textContent(text) { lines.push(text); } };
const config = { textContent: '{"api": {"commands": "/commands"}}' };
const listens = (kind, take, options) => heard.push({ kind, take, capture: Boolean(options?.capture) });
globalThis.window = { addEventListener: listens };
globalThis.document = {
  getElementById: (id) => ({ outcome: line, config })[id] ?? element(),
  querySelector: () => null, querySelectorAll: () => [], addEventListener: listens, body: element(),
};
const starting = {
  status: "refused", reason: "media is starting", id: "operations.family_starting", arguments: { process: "media" },
};
let said = starting;
globalThis.fetch = async (address, { body }) => {
  posts.push(JSON.parse(body));
  return { ok: said.status === "accepted", status: 409, text: async () => JSON.stringify(said) };
};
const tell = (kind, event) => {
  for (const first of [true, false]) {
    for (const one of heard) if (one.kind === kind && one.capture === first) one.take(event);
  }
};
const button = (command) => {
  const made = { dataset: { command }, attributes: [], getAttribute: () => "false" };
  made.closest = (wanted) => (wanted === "[data-command]" || wanted.includes(`"${command}"`) ? made : null);
  made.click = () => tell("click", { target: made });
  return made;
};
const nothing = { closest: () => null };
const keys = { r: button("resume"), h: button("home") };
listens("keydown", ({ key }) => keys[key]?.click()); // as keys.js does
const press = async (key, target = nothing) => { tell("keydown", { key, target }); await settled(); };
const store = {
  on() {}, page: "p1", epoch: 4, fresh: true, lease: "mine",
  snapshot: { boot: "b1", sequence: 7, state_is: {} },
};
"""
COMMANDS = f"const {{ Commands }} = await import({json.dumps((MODULES / 'commands/commands.js').as_uri())});"
PRESSED = PAGE + COMMANDS + "new Commands(store, {}, {}); await press('r');"
PRESSING, WAITING = "Resume: pressed …", "Resume: waiting for the process media, trying again …"
REFUSED = "Resume refused: media is starting"


def page(body: str) -> Any:
    """What the page said, after Resume was pressed while the station said that a process is starting."""
    return run("../site/presses.js", PRESSED + body + "; return lines;")


def test_resume_is_asked_again_visibly_until_the_station_takes_it() -> None:
    said = page("await later(1000); said = { status: 'accepted' }; await later(5000)")
    assert said[:2] == [PRESSING, WAITING]
    assert set(said[1:-1]) == {WAITING}
    assert said[-1] == "Resume: accepted"


def test_each_is_a_command_of_its_own_of_the_same_lease_and_state() -> None:
    posts = run("../site/presses.js", PRESSED + "await later(5000); return posts;")
    assert len(posts) > 2
    assert len({post["uuid"] for post in posts}) == len(posts)
    assert {
        (post["kind"], post["page"], post["epoch"], post["boot"], post["sequence"]) for post in posts
    } == {("resume", "p1", 4, "b1", 7)}


def test_after_three_seconds_the_refusal_is_said() -> None:
    body = """
        await later(2000); const before = lines.at(-1);
        await later(1000); const asked = posts.length;
        await later(5000);
        return [before, lines.at(-1), posts.length - asked];
    """
    found = run("../site/presses.js", PRESSED + body)
    assert found == [WAITING, REFUSED, 0]


@pytest.mark.some(3)
@pytest.mark.parametrize(
    "change",
    [
        "store.snapshot = { ...store.snapshot, sequence: 8 }",
        "store.snapshot = { ...store.snapshot, boot: 'b2' }",
        "store.lease = 'free'",
        "store.epoch = 5",
        "store.fresh = false",
    ],
)
def test_another_state_or_lease_ends_it(change: str) -> None:
    assert page(change + "; await later(5000); lines.push(posts.length)") == [PRESSING, WAITING, REFUSED, 1]


@pytest.mark.parametrize(
    "other",
    [
        "press('Escape')",
        "press('x')",
        "tell('click', { target: nothing })",
        "tell('eva:press', {})",  # a button of a pad that clicks nothing
    ],
)
def test_any_other_press_ends_it_and_says_the_refusal_at_once(other: str) -> None:
    body = f"await {other}; lines.push(posts.length); await later(5000); lines.push(posts.length)"
    assert page(body) == [PRESSING, WAITING, REFUSED, 1, 1]


def test_what_another_button_says_stands_after_the_refusal() -> None:
    said = page("await press('h'); await later(5000)")
    assert said[:4] == [PRESSING, WAITING, REFUSED, "Home: pressed …"]
    assert said[4:] == ["Home refused: media is starting"], "nothing else is asked again"


def test_resume_pressed_again_does_not_end_it() -> None:
    said = page("await press('r'); await press('Enter', keys.r); await later(1000)")
    assert said[2] == "Resume: pressed already, and not answered yet"
    assert said[-1] == WAITING


def test_no_other_refusal_is_asked_again() -> None:
    body = "said = { status: 'refused', reason: 'no', id: 'session.opening' }; await later(5000)"
    assert page(body)[2:] == ["Resume refused: no"]


def test_an_answer_that_is_under_way_when_something_else_is_pressed_is_said_and_the_last() -> None:
    found = run(
        "commands/asking.js",
        """
        const waited = [], failed = [];
        let refuse;
        const asking = new m.Asking({ holds: () => true, waits: (process) => waited.push(process) });
        const answer = asking.answer(() => new Promise((_, reject) => (refuse = reject)));
        const over = answer.catch((error) => failed.push(error.message));
        const unsaid = asking.end();
        const body = { id: "operations.family_starting", arguments: { process: "media" } };
        refuse(Object.assign(new Error("starting"), { body }));
        await over;
        return [unsaid, waited, failed];
        """,
    )
    assert found == [None, [], ["starting"]]
