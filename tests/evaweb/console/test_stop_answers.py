"""What pages say of commands whose answers come late: run by Node on a stand-in of the page."""

from __future__ import annotations

import json

import pytest

from tests.evaweb.console.test_modules import MODULES, NODE, run

pytestmark = pytest.mark.skipif(NODE is None, reason="Node is not installed: the page's modules are not run")

PAGE = """
const heard = {};
const timers = [];
const element = () => ({
  dataset: {}, textContent: "", title: "", innerHTML: "rest",
  append() {}, toggleAttribute() {}, querySelector: () => null,
  addEventListener(kind, take) { heard[kind] = take; },
});
const elements = { config: { textContent: '{"api": {"estop": "/web/estop", "commands": "/web"}}' } };
globalThis.document = {
  getElementById: (id) => (elements[id] ??= element()),
  querySelector: () => null, querySelectorAll: () => [], createElement: element, addEventListener() {},
  body: element(),
};
globalThis.window = { addEventListener() {} };
globalThis.setTimeout = (take) => timers.push(take);
globalThis.clearTimeout = (id) => { timers[id - 1] = () => {}; };
const posts = [];
globalThis.fetch = (address, { body }) => new Promise((resolve) => {
  posts.push((said) => resolve({ ok: true, json: async () => said, text: async () => JSON.stringify(said) }));
});
const settled = () => new Promise((resolve) => setImmediate(resolve));
const area = document.getElementById("estop-area");
const kinds = [];
const look = async () => { await settled(); kinds.push(area.dataset.kind ?? "rest"); };
const sent = [];
const told = (name) => ({ state: name, state_is: { latched: name === "faulted" } });
const store = { on(_, take) { this.take = take; }, snapshot: told("idle"), page: "p1", epoch: 1 };
const state = (name) => { store.snapshot = told(name); store.take(); };
let ours = 0;
performance.now = () => 1000 * ours;  // this page's clock, which the test moves [s]
const news = (name, clock, boot = "b1") => { store.snapshot = { ...told(name), clock, boot }; store.take(); };
const socket = { send: (message) => { sent.push(message); return true; } };
const way = { there: true, estop: "/stops/estop", ask: async () => true };
const late = () => timers.forEach((take) => take());
"""
PRESSES = (
    PAGE + f"const {{ EStop }} = await import({json.dumps((MODULES / 'commands/estop.js').as_uri())});"
    "const estop = new EStop(store, socket, way);"
    'const ack = (index, status = "done") => estop.acknowledged({ uuid: sent[index].uuid, status, reason: "why" });'
)


def pressing(body: str) -> list[str]:
    """What the area of the button shows at each `look` of `body`."""
    return run("../site/identity.js", PRESSES + body + "return kinds;")


def test_an_answer_of_a_press_that_was_answered_changes_nothing_after_the_release() -> None:
    assert pressing(
        """
        estop.press("button"); ack(0); await look();
        state("faulted"); state("idle"); await look();
        posts[0]({ status: "done" }); await look();
        ack(0); await look();
        """
    ) == ["stopped", "rest", "rest", "rest"]


def test_an_answer_of_an_earlier_press_acknowledges_no_later_one() -> None:
    assert pressing(
        """
        estop.press("button"); ack(0); state("faulted"); state("idle");
        estop.press("button"); await look();
        posts[0]({ status: "done" }); await look();
        late(); await look();
        posts[0]({ status: "done" }); ack(0); await look();
        """
    ) == ["pressed", "pressed", "failed", "failed"]


def test_the_answer_of_a_press_that_waits_answers_those_before_it_and_not_those_after() -> None:
    assert pressing(
        """
        estop.press("one"); estop.press("two");
        ack(0); await look();
        late(); await look();
        estop.press("three"); ack(2); late(); await look();
        ack(1, "failed"); await look();
        """
    ) == ["pressed", "failed", "stopped", "stopped"]


def test_an_answer_that_comes_after_the_release_does_not_say_that_the_robot_is_held() -> None:
    assert pressing(
        """
        ours = 100; news("idle", 5100);
        estop.press("button"); late(); await look();
        ours = 103; news("faulted", 5103); await look();
        ours = 110; news("idle", 5110); await look();
        ack(0); posts[0]({ status: "done" }); await look();
        """
    ) == ["failed", "failed", "rest", "rest"]


def test_a_release_that_is_told_late_leaves_the_red_letters_of_a_later_press() -> None:
    assert pressing(
        """
        ours = 100; news("idle", 5100); news("faulted", 5100.2);
        ours = 120; estop.press("button"); late(); await look();
        ours = 121; news("idle", 5119.5); await look();
        ours = 123; news("faulted", 5119.9); news("idle", 5119.95); await look();
        ack(0); await look();
        ours = 130; news("faulted", 5130); await look();
        """
    ) == ["failed", "failed", "failed", "rest", "stopped"]


def test_news_that_others_have_overtaken_say_nothing() -> None:
    assert pressing(
        """
        ours = 100; news("faulted", 5100); await look();
        news("idle", 5099); await look();
        news("idle", 7, "b2"); await look();
        """
    ) == ["stopped", "stopped", "rest"]


def test_what_an_answer_said_is_believed_until_the_station_says_later_that_it_is_not_held() -> None:
    assert pressing(
        """
        ours = 100; news("running", 5100);
        estop.press("button"); ack(0); await look();
        ours = 100.1; news("running", 5100.05); await look();
        ours = 105; news("running", 5105); await look();
        """
    ) == ["stopped", "stopped", "rest"]


def test_answers_over_the_socket_reach_who_pressed_though_another_part_of_the_page_fails() -> None:
    body = f"""
        const {{ Store }} = await import({json.dumps((MODULES / "live/store.js").as_uri())});
        const {{ Commands }} = await import({json.dumps((MODULES / "commands/commands.js").as_uri())});
        const page = new Store({{ user: "ann", role: "operator", page: "p1" }});
        const failures = [];
        globalThis.reportError = (error) => failures.push(error.message);
        page.on(["ack", "open"], () => {{ throw new Error("a panel"); }});
        let asked = 0;
        way.ask = async () => {{ asked += 1; return true; }};
        const button = new EStop(page, socket, way), commands = new Commands(page, socket, way);
        const line = document.getElementById("outcome");
        button.press("button"); commands.give("halt"); await look();
        page.tell("ack", {{ kind: "halt", uuid: sent[1].uuid, status: "accepted" }}); await look();
        kinds.push(line.dataset.kind);
        page.tell("ack", {{ kind: "estop", uuid: sent[0].uuid, status: "done" }}); await look();
        page.open = true; page.tell("open");
        return [...kinds, asked, failures.length];
    """
    assert run("../site/identity.js", PRESSES + "way.post = () => null;" + body) == [
        "pressed",
        "pressed",
        "accepted",
        "stopped",
        2,
        3,
    ]


def test_the_process_for_stops_is_asked_again_until_it_answers() -> None:
    answers = "const answers = [false, false, true]; way.ask = async () => answers.shift();"
    body = """
        area.toggleAttribute = (name, there) => kinds.push(there);
        const asked = new EStop(store, socket, way);
        for (let turn = 0; turn < 4; turn += 1) { await settled(); late(); }
        return kinds;
    """
    assert run("../site/identity.js", PRESSES + "await settled();" + answers + body) == [False, False, True]


EARLY = (
    PAGE
    + """
    globalThis.crypto ??= (await import("node:crypto")).webcrypto;
    area.dataset.address = "/estop"; area.dataset.stops = "";
    const { readFileSync } = await import("node:fs");
    (0, eval)(readFileSync(given, "utf8"));
    const press = () => heard.click();
    """
)


@pytest.mark.parametrize(
    ("body", "shown"),
    [
        (
            "press(); press(); posts[0]({status: 'done'}); await look(); posts[1]({status: 'done'}); await look();",
            ["pressed", "stopped"],
        ),
        (
            "press(); press(); posts[1]({status: 'no'}); await look(); posts[0]({status: 'done'}); await look();",
            ["failed", "failed"],
        ),
        (
            "press(); press(); posts[1]({status: 'done'}); posts[0]({status: 'no'}); await look();",
            ["stopped"],
        ),
    ],
)
def test_before_the_modules_run_an_answer_counts_for_the_last_press_alone(
    body: str, shown: list[str]
) -> None:
    script = str(MODULES / "commands/estop_early.js")
    assert run("../site/identity.js", EARLY + body + "return kinds;", script) == shown


def test_an_answer_to_the_early_script_says_nothing_of_a_press_of_the_modules() -> None:
    modules = json.dumps((MODULES / "commands/estop.js").as_uri())
    body = f"""
        press(); await look();
        const {{ EStop }} = await import({modules});
        const estop = new EStop(store, socket, way);
        if (given.again) estop.press("button");
        posts[0]({{ status: "done" }}); await look();
        late(); await look();
    """
    script = str(MODULES / "commands/estop_early.js")
    early = EARLY.replace("readFileSync(given,", "readFileSync(given.script,")
    shown = [
        run("../site/identity.js", early + body + "return kinds;", {"script": script, "again": again})
        for again in (True, False)
    ]
    assert shown == [["pressed", "pressed", "failed"], ["pressed", "stopped", "stopped"]]


def test_the_early_scripts_missing_answer_outlives_a_late_release_too() -> None:
    modules = json.dumps((MODULES / "commands/estop.js").as_uri())
    body = f"""
        press(); posts[0]({{ status: "no" }}); await look();
        const {{ EStop }} = await import({modules});
        ours = 100;
        new EStop(store, socket, way);
        news("faulted", 5099.5); await look();
        ours = 100.2; news("idle", 5099.7); await look();
        ours = 104; news("faulted", 5104); ours = 105; news("idle", 5105); await look();
    """
    script = str(MODULES / "commands/estop_early.js")
    shown = run("../site/identity.js", EARLY + body + "return kinds;", script)
    assert shown == ["failed", "failed", "failed", "rest"]


STOPS = (
    PAGE
    + f"const {{ Commands }} = await import({json.dumps((MODULES / 'commands/commands.js').as_uri())});"
    + """
    const answers = [];
    way.post = () => new Promise((resolve, reject) => answers.push([resolve, reject]));
    const commands = new Commands(store, socket, way);
    commands.gate = () => {};
    const line = document.getElementById("outcome");
    const said = async () => { await settled(); await settled(); kinds.push(line.dataset.kind); };
    """
)


def test_an_answer_to_an_earlier_stop_is_not_said_of_the_later_one() -> None:
    assert run(
        "../site/identity.js",
        STOPS
        + """
        commands.give("stop"); commands.give("stop"); await said();
        answers[0][0]({ status: "done" }); await said();
        answers[1][1](new Error("gone"));
        commands.acknowledged({ uuid: sent[1].uuid, kind: "stop", status: "unknown", reason: "?" }); await said();
        commands.acknowledged({ uuid: sent[0].uuid, kind: "stop", status: "done" }); await said();
        commands.acknowledged({ uuid: sent[1].uuid, kind: "stop", status: "done" }); await said();
        return kinds;
        """,
    ) == ["pressed", "pressed", "unknown", "unknown", "accepted"]


@pytest.mark.parametrize(("said", "stands"), [("refused", "refused"), ("pressed", "accepted")])
def test_that_a_command_was_accepted_does_not_cover_why_a_later_press_was_refused(
    said: str, stands: str
) -> None:
    assert run(
        "../site/identity.js",
        STOPS
        + f"""
        let answer;
        globalThis.fetch = () => new Promise((resolve) => {{ answer = resolve; }});
        commands.give("setup"); await said();
        commands.say("Start: arm first", "{said}"); await said();
        answer({{ ok: true, status: 200, text: async () => JSON.stringify({{ status: "accepted" }}) }}); await said();
        return kinds;
        """,
    ) == ["pressed", said, stands]


def test_a_button_that_is_pressed_before_its_first_press_is_answered_says_so_and_sends_nothing() -> None:
    assert run(
        "../site/identity.js",
        STOPS
        + """
        let click;
        document.addEventListener = (_, take) => { click = take; };
        new Commands(store, socket, way);
        const button = { dataset: { command: "setup" }, attributes: [], getAttribute: () => "false" };
        const press = async () => { click({ target: { closest: () => button } }); await settled(); };
        await press(); await said();
        line.textContent = "Stop: done";
        await press(); kinds.push(line.textContent, posts.length);
        posts[0]({ status: "accepted" }); await said();
        await press(); await said(); kinds.push(posts.length);
        return kinds;
        """,
    ) == ["pressed", "Set up: pressed already, and not answered yet", 1, "accepted", "pressed", 2]


GATED = (
    STOPS
    + """
    Object.assign(store, { fresh: true, role: "operator", lease: "mine" });
    Object.assign(store.snapshot, { allowed: ["stop"] });
    const happens = {};
    document.body.addEventListener = (moment, act) => { happens[moment] = act; };
    const gated = (command) => ({
      dataset: { command }, mark: "true", getAttribute() { return this.mark; }, setAttribute(_, to) { this.mark = to; },
    });
    const stop = gated("stop"), setup = gated("setup"), reported = [];
    new Commands(store, socket, way);
    """
)


def test_a_button_of_a_fragment_that_came_can_be_pressed_at_once() -> None:
    body = 'document.querySelectorAll = () => [stop]; happens["htmx:afterSwap"](); return stop.mark;'
    assert run("../site/identity.js", GATED + body) == "false"


def test_a_button_whose_reason_cannot_be_found_does_not_keep_stop_disabled() -> None:
    body = """
    globalThis.reportError = (error) => reported.push(error.name);
    document.querySelectorAll = () => [setup, stop];
    delete store.snapshot.state_is;
    happens["htmx:afterSettle"]();
    return [setup.mark, stop.mark, reported];
    """
    assert run("../site/identity.js", GATED + body) == ["true", "false", ["TypeError"]]
