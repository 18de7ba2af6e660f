"""The modules of the Debug page's own controls, run by Node."""

from __future__ import annotations

from itertools import product
from typing import Any, get_args

import pytest

from runtime.core.plugins import variants
from runtime.ipc.messages import Mode
from runtime.processes.coordinator.session.machine import COMMANDS
from runtime.strategies.base import StrategyParameters
from tests.evaweb.console.test_modules import NODE, run
from tests.standing import state_flags

pytestmark = pytest.mark.skipif(NODE is None, reason="Node is not installed: the page's modules are not run")
MODES = get_args(Mode)


# --- modes -------------------------------------------------------------------------------------------------


def test_every_mode_of_the_runtime_is_offered_with_a_line() -> None:
    lines = run("debug/modes.js", "return m.MODES")

    assert set(lines) == set(MODES)
    assert all(line.endswith(".") for line in lines.values())


@pytest.mark.some(4)
@pytest.mark.parametrize(
    ("state", "mode", "chunk", "button"),
    [
        ("ready", "step", 0, "run"),
        ("idle", "", 0, "run"),
        ("running", "continuous", 0, "run"),
        ("running", "sim", 0, "run"),
        ("running", "step", 0, "step"),
        ("running", "preview", 0, "step"),
        ("running", "preview", 7, "commit"),
        ("running", "manual", 0, "move"),
        ("holding", "preview", 7, "resume"),
    ],
)
def test_there_is_one_big_button_at_each_moment(state: str, mode: str, chunk: int, button: str) -> None:
    proposal = {"chunk": chunk} if chunk else {}
    given = {**state_flags(state), "mode": mode, "proposal": proposal}

    assert run("debug/modes.js", "return m.primaryCommand(given)", given) == button


def test_before_any_news_the_big_button_is_there() -> None:
    assert run("debug/modes.js", "return m.primaryCommand(given)", {"mode": "preview"}) == "run"


def test_the_mode_that_is_shown_is_that_of_the_open_run_whatever_was_chosen() -> None:
    body = "return given.map(([station, chosen]) => m.shown(station, chosen))"
    shown = run(
        "debug/modes.js",
        body,
        [
            [{"open": True, "mode": "sim", "offered": MODES}, "manual"],
            [{"open": False, "mode": "sim", "offered": MODES}, "manual"],
            [{"open": False, "mode": "sim", "offered": MODES}, ""],
            [{"open": False, "mode": "sim", "offered": ["step"]}, "manual"],
            [{"open": False}, ""],
        ],
    )

    assert shown == ["sim", "manual", "sim", "step", "continuous"]


def test_what_the_run_does_is_said_in_words() -> None:
    body = "return given.map((snapshot) => m.phaseText(snapshot))"
    said = run(
        "debug/modes.js",
        body,
        [
            {**state_flags("running"), "phase": "executing", "control": {"remaining": 45}, "rate": 30},
            {**state_flags("running"), "phase": "asking"},
            {**state_flags("running"), "phase": "something_new"},
            {**state_flags("ready"), "phase": "executing"},
            {**state_flags("running"), "phase": ""},
        ],
    )

    assert said == ["executing, 1.5 s ahead", "asking the policy", "something new", "", ""]


def test_a_proposed_chunk_is_described_with_how_far_it_begins() -> None:
    proposal = {"chunk": 4, "rows": 50, "distance": 0.312, "joint": "left_arm.joint1", "age_s": 3.2}

    assert run(
        "debug/modes.js", "return [m.proposed(given), m.proposed({}), m.proposed(null)]", proposal
    ) == [
        "Chunk 4: 50 steps, begins 0.31 rad away (left_arm.joint1), shown for 3 s.",
        "",
        "",
    ]


# --- reasons -----------------------------------------------------------------------------------------------


def refusals(kind: str, *stores: dict[str, Any]) -> list[str]:
    """What the page says to `kind` in each of these situations."""
    found: list[str] = run(
        "commands/reasons.js", f"return given.map((store) => m.pageProblem({kind!r}, store))", list(stores)
    )
    return found


def store(**more: Any) -> dict[str, Any]:
    """A page that commands; `more` is of the snapshot or of the page."""
    page = {"fresh": True, "role": "operator", "lease": "mine"}
    page |= {key: more.pop(key) for key in tuple(more) if key in page}
    return {**page, "snapshot": {**state_flags("running"), "mode": "continuous", "allowed": [], **more}}


def test_any_operator_may_stop_a_program_that_drives_and_nothing_else() -> None:
    driven = store(lease="other", allowed=["stop", "halt", "tune"])
    driven["snapshot"]["lease"] = {"holder": "robot:lerobot#0"}
    assert refusals("stop", driven) == refusals("halt", driven) == [""]
    ask = ["someone else commands the station; ask for it"]
    assert refusals("tune", driven) == ask
    assert refusals("stop", driven | {"role": "viewer"}) != [""]
    driven["snapshot"]["lease"] = {"holder": "web:anna:1"}
    assert refusals("stop", driven) == ask


def test_a_stop_needs_no_news_and_everything_else_does() -> None:
    old, others = store(fresh=False), store(fresh=False, lease="other")

    assert refusals("stop", old) == refusals("halt", old) == [""]
    assert refusals("run", old) == ["the state of the station is not known at the moment"]
    assert refusals("stop", others) == ["the state of the station is not known at the moment"]


def test_who_does_not_command_is_told_how_to() -> None:
    said = refusals(
        "run", *(store(lease=lease) for lease in ("free", "elsewhere", "other")), store(role="viewer")
    )

    assert said == [
        "take the station first",
        "another page of yours commands the station; take it here first",
        "someone else commands the station; ask for it",
        "a viewer watches; an administrator can make you an operator",
    ]


@pytest.mark.some(4)
@pytest.mark.parametrize(
    ("kind", "situation", "reason"),
    [
        ("step", {"guarded": {"step": "the policy is being asked"}}, "the policy is being asked"),
        ("step", {**state_flags("ready")}, "run in the mode step or preview first"),
        ("commit", {**state_flags("idle")}, "run in the mode preview first"),
        ("move", {**state_flags("holding")}, "the robot holds: resume or stop first"),
        ("home", {"allowed": ["stop", "estop"]}, "not while running; possible now: Stop"),
        ("home", {"allowed": ["estop"]}, "not while running; possible now: nothing"),
        ("stop", {"allowed": ["stop"]}, ""),
    ],
)
def test_a_button_that_is_dead_says_why(kind: str, situation: dict[str, Any], reason: str) -> None:
    assert refusals(kind, store(**situation)) == [reason]


def test_every_command_has_a_reason_wherever_the_station_does_not_allow_it() -> None:
    states = ("disconnected", "idle", "setting_up", "ready", "running", "holding", "faulted")
    situations = [store(state=state, mode=mode) for state, mode in product(states, (*MODES, None))]

    body = "return given[0].flatMap((kind) => given[1].filter((one) => !m.pageProblem(kind, one)).map(() => kind))"

    assert run("commands/reasons.js", body, [list(COMMANDS), situations]) == []


# --- strategy ----------------------------------------------------------------------------------------------


def test_the_parameters_shown_are_those_that_strategies_use() -> None:
    used = set().union(*(module.USES for module in variants("runtime.strategies").values()))
    shown = run("debug/tuning.js", "return Object.keys(m.PARAMETERS)")

    assert used <= set(shown) <= set(StrategyParameters.model_fields)


def test_a_field_left_alone_stands_for_what_is_in_force() -> None:
    section = StrategyParameters().model_dump() | {"kind": "async"}
    body = """
    const fields = Object.fromEntries(Object.keys(m.PARAMETERS).map((name) => [name, m.text(name, given[name])]));
    return m.changes(given.kind, fields, given, Object.keys(m.PARAMETERS));
    """

    assert run("debug/tuning.js", body, section) == {"changes": {}, "error": ""}
    assert run("debug/tuning.js", body, section | {"blend_window": "all", "k_max": 3}) == {
        "changes": {},
        "error": "",
    }


def test_only_what_was_edited_is_sent_and_an_empty_field_means_none() -> None:
    body = """
    const uses = ["execution_horizon", "blend_window", "k_max"];
    return m.changes("naive", { execution_horizon: "16", blend_window: "", k_max: "3" }, given, uses);
    """
    in_force = {"kind": "async", "execution_horizon": None, "blend_window": 8, "k_max": 3}

    assert run("debug/tuning.js", body, in_force)["changes"] == {
        "kind": "naive",
        "execution_horizon": 16,
        "blend_window": "all",
    }


@pytest.mark.parametrize(
    ("name", "typed", "sentence"),
    [
        ("blend_window", "0", "Blend over: a whole number from 1, or empty for all; given 0"),
        ("k_max", "1.5", "k max: a whole number from 0, or empty for no bound; given 1.5"),
        ("ensemble_m", "", "Ensemble m: a number is needed"),
        ("delay_quantile", "2", "Delay quantile: a number from 0.01 to 1; given 2"),
        ("inference_rate", "fast", "Ask at: a number from 0.1, or empty for back to back; given fast"),
    ],
)
def test_what_cannot_be_is_said_before_it_is_sent(name: str, typed: str, sentence: str) -> None:
    body = "return m.changes('async', { [given[0]]: given[1] }, { kind: 'async' }, [given[0]])"

    assert run("debug/tuning.js", body, [name, typed]) == {"changes": {}, "error": sentence}


def test_the_cost_of_a_window_is_said_in_time() -> None:
    cost = run("debug/tuning.js", "return m.cost('async', { blend_window: 15 }, 30)")

    assert "15 steps = 500 ms" in cost


def test_every_strategy_has_its_cost() -> None:
    kinds = list(variants("runtime.strategies"))
    given = [kinds, StrategyParameters().model_dump()]
    costs = run("debug/tuning.js", "return given[0].map((kind) => m.cost(kind, given[1], 30))", given)

    assert all(cost.endswith(".") for cost in costs)
    assert not any("undefined" in cost or "NaN" in cost for cost in costs)


# --- targets -----------------------------------------------------------------------------------------------

FACTS = {
    "joint_names": ["left_arm.joint0", "left_arm.joint6", "right_arm.joint0", "lift"],
    "lower": [-2.6, 0.0, -2.6, None],
    "upper": [2.6, 0.1, 2.6, None],
    "units": ["rad", "m", "rad", ""],
    "gripper_dims": [1],
}


def test_joints_come_in_the_robots_groups_with_their_limits() -> None:
    groups = run("manual/targets.js", "return m.groupJoints(given)", FACTS)

    assert [group["name"] for group in groups] == ["left_arm", "right_arm", "joints"]
    assert groups[0]["joints"][1] == {
        "index": 1,
        "joint": "joint6",
        "full": "left_arm.joint6",
        "label": "gripper",
        "unit": "m",
        "gripper": True,
        "lower": 0.0,
        "upper": 0.1,
    }
    assert groups[2]["joints"][0]["lower"] == pytest.approx(-6.283, abs=0.001)  # turns without an end


@pytest.mark.some(4)
@pytest.mark.parametrize(
    ("joints", "labels"),
    [
        (["joint0", "joint1"], ["joint0", "joint1"]),
        (["panda_joint1", "panda_joint2"], ["joint1", "joint2"]),
        (["idx21_arm_l_joint1", "idx22_arm_l_joint2"], ["joint1", "joint2"]),
        (
            ["shoulder_pan_joint", "shoulder_lift_joint", "elbow_joint", "wrist_1_joint"],
            ["shoulder pan", "shoulder lift", "elbow", "wrist 1"],
        ),
        (["left_wheel", "right_wheel"], ["left", "right"]),
        (["wheel"], ["wheel"]),
        (["linear_x", "linear_y", "angular_z"], ["x", "y", "z"]),
        (["arm_1", "leg_1"], ["arm", "leg"]),
        ([], []),
    ],
)
def test_a_joints_label_is_as_short_as_tells_it_from_others(joints: list[str], labels: list[str]) -> None:
    assert run("manual/joint_names.js", "return m.shortLabels(given)", joints) == labels


def test_a_value_beyond_a_limit_is_clipped_and_said() -> None:
    body = """
    const [joint] = m.groupJoints(given)[0].joints;
    return [m.clampToLimits(joint, 9), m.clampToLimits(joint, 1)];
    """

    assert run("manual/targets.js", body, FACTS) == [
        {"value": 2.6, "said": "left_arm.joint0 ends at 2.600"},
        {"value": 1, "said": ""},
    ]


def test_arrow_keys_go_by_round_steps() -> None:
    body = "return given.map(([lower, upper]) => m.stepOf({ lower, upper }))"

    steps = run("curves/units.js", body, [[-2.618, 2.618], [0, 0.1], [-6.28, 6.28], [0, 100], [0, 1]])

    assert steps == pytest.approx([0.01, 0.0001, 0.01, 0.1, 0.001])


def test_numbers_have_the_digits_of_their_steps() -> None:
    ranges = [
        {"lower": -2.6, "upper": 2.6, "unit": "rad"},
        {"lower": -0.785, "upper": 0.0, "unit": "rad"},
        {"lower": 0, "upper": 0.1, "unit": "m"},
        {"lower": 0, "upper": 100, "unit": "%"},
        {"lower": 0, "upper": 1, "unit": "opening, 0 to 1"},
        {"lower": 0, "upper": 1000, "unit": ""},
    ]

    assert run("curves/units.js", "return given.map((one) => m.digitsOf(one))", ranges) == [3, 3, 4, 1, 3, 0]


def test_a_long_unit_stands_elsewhere() -> None:
    body = "return given.map((unit) => [m.shortUnit(unit), m.withUnit('0.5', unit)])"

    assert run("curves/units.js", body, ["rad", "%", "", "opening, 0 to 1"]) == [
        ["rad", "0.5 rad"],
        ["%", "0.5 %"],
        ["", "0.5"],
        ["", "opening 0.5"],
    ]


def test_how_poses_were_met_is_said_in_words() -> None:
    chunks = [
        {},
        {
            "rows": 50,
            "over": 0,
            "limit": 0,
            "velocity": 0,
            "singular": 0,
            "worst_mm": 0.012,
            "worst_deg": 0.003,
        },
        {"rows": 50, "over": 0, "worst_mm": 0.0, "worst_deg": 2e-5},
        {
            "rows": 50,
            "over": 3,
            "limit": 3,
            "velocity": 0,
            "singular": 1,
            "worst_mm": 31.4,
            "worst_deg": 2.06,
        },
        {"rows": 50, "over": 1, "limit": 0, "velocity": 1, "worst_mm": None, "worst_deg": None},
    ]

    assert run("scene/ik_text.js", "return given.map((ik) => m.ikText(ik))", chunks) == [
        "",
        "50 poses reached, worst 0.012 mm and 0.003°",
        "50 poses reached, worst 0.000 mm and below 0.001°",
        "3 of 50 poses not reached, worst 31.4 mm and 2.1°; 3 at a joint limit; 1 near singular",
        "1 of 50 poses not reached; 1 as fast as joints may",
    ]


def test_the_target_begins_where_the_robot_is_told_to_be_else_where_it_is() -> None:
    joints = {"measured": [1, 2], "commanded": [1.1, 2.1]}
    body = """
    const engaged = [true, false].map((engaged) => m.initialTarget({ ...given, engaged }));
    return [...engaged, m.initialTarget()];
    """

    assert run("manual/targets.js", body, joints) == [[1.1, 2.1], [1, 2], None]


def test_the_verdict_on_a_target_says_distance_time_and_what_is_wrong() -> None:
    answers = [
        {"ok": True, "distance": 0.5, "duration_s": 1.0, "reached": True, "clipped": []},
        {"ok": True, "distance": 0.5, "duration_s": 1.0, "clipped": ["left_arm.joint1"]},
        {
            "ok": True,
            "reached": False,
            "position_error_mm": 31.4,
            "rotation_error_deg": 2.06,
            "distance": 1.0,
            "duration_s": 2.0,
        },
        {"ok": True, "distance": 0.0004, "duration_s": 0.0},
        {"ok": False, "reason": "no pose is called nest"},
    ]

    assert run(
        "manual/targets.js", "return given.map((answer) => m.aimText(answer, 0.25).text)", answers
    ) == [
        "0.50 rad from the robot, 4.0 s.",
        "0.50 rad from the robot, 4.0 s. Limited: left_arm.joint1.",
        "Out of reach: the nearest is 31 mm and 2.1° off.",
        "The robot is there, within 0.005 rad.",
        "no pose is called nest",
    ]


def test_a_step_of_the_hand_is_in_metres_and_radians() -> None:
    asked = {
        "arm": "left_arm",
        "frame": "tool",
        "axis": "y",
        "sign": -1,
        "turned": False,
        "mm": 20,
        "degrees": 90,
    }
    step = run("manual/targets.js", "return m.jogArguments(given)", asked)
    turn = run("manual/targets.js", "return m.jogArguments(given)", asked | {"turned": True})

    assert step == {"arm": "left_arm", "frame": "tool", "translation": [0, -0.02, 0]}
    assert turn["rotation"] == pytest.approx([0, -1.5708, 0], abs=1e-4)


def test_the_hand_is_said_in_millimetres() -> None:
    poses = [0.1, -0.2, 0.3, 1, 0, 0, 0, 0.05, 0.4, 0.5, 0.6, 1, 0, 0, 0, 0.0]

    assert run(
        "manual/targets.js",
        "return [m.tipPositionText(given, 1), m.tipPositionText(given, 2), m.tipPositionText(null, 0)]",
        poses,
    ) == [
        "x 400  y 500  z 600 mm",
        "",
        "",
    ]


AIM = """
const told = [], sent = [];
globalThis.document = { dispatchEvent: ({ detail }) => told.push(detail && detail.id) };
globalThis.CustomEvent = class { constructor(name, { detail }) { Object.assign(this, { name, detail }); } };
const aim = new m.Aim((message) => { sent.push(message); return given.open; });
"""


def test_a_slider_that_runs_asks_the_newest_place_alone() -> None:
    body = """
    const heard = [];
    for (const x of [1, 2, 3, 4]) aim.follow({ joints: [x] }, (answer) => heard.push(answer.id));
    aim.answered({ id: 1, ok: true });
    await new Promise((resolve) => setTimeout(resolve, 120));
    aim.answered({ id: 2, ok: true });
    await new Promise((resolve) => setTimeout(resolve, 0));
    aim.clear();
    return { sent: sent.map(({ id, args }) => [id, args.joints[0]]), heard, told };
    """
    found = run("manual/aim.js", AIM + body, {"open": True})

    assert found["sent"] == [[1, 1], [2, 4]]
    assert found["told"] == [1, 2, None]
    assert found["heard"] == [1, 2]


def test_on_a_slow_connection_each_answer_is_shown_before_the_next_question_goes_out() -> None:
    body = """
    const heard = [], ask = (x) => aim.follow({ joints: [x] }, (answer) => heard.push(answer.id));
    ask(1);
    for (const x of [2, 3]) {
      ask(x);
      await new Promise((resolve) => setTimeout(resolve, 100)); // longer than the pause between two questions
    }
    const before = sent.length;
    aim.answered({ id: 1, ok: true });
    await new Promise((resolve) => setTimeout(resolve, 0));
    aim.answered({ id: 2, ok: true });
    await new Promise((resolve) => setTimeout(resolve, 0));
    return { before, asked: sent.map(({ args }) => args.joints[0]), heard, told };
    """

    assert run("manual/aim.js", AIM + body, {"open": True}) == {
        "before": 1,
        "asked": [1, 3],
        "heard": [1, 2],
        "told": [1, 2],
    }


def test_an_answer_that_comes_after_the_target_was_dropped_shows_no_ghost() -> None:
    body = """
    const asked = aim.ask({ pose: "home" });
    aim.clear();
    aim.answered({ id: 1, ok: true });
    aim.answered({ id: 9, ok: true });
    return { told, ok: (await asked).ok };
    """

    assert run("manual/aim.js", AIM + body, {"open": True}) == {"told": [None], "ok": True}


def test_without_a_connection_a_target_has_no_answer_but_a_sentence() -> None:
    body = "const { ok, reason } = await aim.ask({ pose: 'home' }); return { ok, reason }"

    assert run("manual/aim.js", AIM + body, {"open": False}) == {
        "ok": False,
        "reason": "no connection to the lab",
    }


# --- set-up, robot, keys -----------------------------------------------------------------------------------


def test_stages_are_shown_while_they_go_on_and_after_one_failed() -> None:
    failed = [{"name": "connect", "state": "failed", "seconds": 5.0}]
    done = [{"name": "connect", "state": "done", "seconds": 0.2}]
    snapshots = [
        {**state_flags("setting_up"), "stages": done},
        {**state_flags("idle"), "stages": failed},
        {**state_flags("idle"), "stages": done},
        {**state_flags("ready"), "stages": done},
        {**state_flags("idle")},
    ]

    assert run("trial/setup.js", "return given.map((snapshot) => m.isUnfinished(snapshot))", snapshots) == [
        True,
        True,
        False,
        False,
        False,
    ]


def test_a_stage_says_how_long_it_took() -> None:
    stages = [
        {"state": "done", "seconds": 0.24},
        {"state": "active", "seconds": 75.0},
        {"state": "waiting", "seconds": 0.0},
        {"state": "skipped", "seconds": 0.0},
    ]

    assert run("trial/setup.js", "return given.map((stage) => m.stageDuration(stage))", stages) == [
        "0.2 s",
        "1:15",
        "",
        "",
    ]


def test_drives_and_grippers_say_what_is_the_matter() -> None:
    drives = [{}, {"enabled": True, "faults": []}, {"enabled": False, "faults": []}]
    drives.append({"enabled": False, "faults": ["overheated"]})
    words = run("debug/robot_panel.js", "return given.map((drives) => m.driveWords(drives))", drives)
    grippers = [{"locked": True, "at": 0.05}, {"locked": False, "at": 0.1}, {"locked": False, "at": None}]

    assert [one["weight"] for one in words] == ["", "good", "warn", "bad"]
    assert words[3]["text"] == "Fault: overheated"
    assert run(
        "debug/robot_panel.js",
        "return given.map((one) => m.gripperWords(one, { unit: 'm', lower: 0, upper: 0.1 }))",
        grippers,
    ) == [
        "locked at 0.0500 m",
        "at 0.1000 m",
        "not known",
    ]
    body = "return m.gripperWords({ at: 57.31 }, { unit: '%', lower: 0, upper: 100 })"
    assert run("debug/robot_panel.js", body) == "at 57.3 %"
    body = "return m.gripperWords({ at: 0.5 }, { unit: 'opening, 0 to 1', lower: 0, upper: 1 })"
    assert run("debug/robot_panel.js", body) == "at opening 0.500"


def test_a_key_with_shift_is_its_own_and_else_the_key_without() -> None:
    pressed = [
        {"key": "s"},
        {"key": "S", "shiftKey": True},
        {"key": "S"},
        {"key": "ArrowLeft", "shiftKey": True},
        {"key": "?", "shiftKey": True},
        {"key": "Enter", "ctrlKey": True, "shiftKey": True},
    ]

    assert run("commands/keys.js", "return given.map((event) => m.namesOf(event))", pressed) == [
        ["s"],
        ["shift+s", "s"],
        ["s"],
        ["shift+arrowleft", "arrowleft"],
        ["?"],
        ["ctrl+enter"],
    ]


def test_keys_are_written_as_they_stand_on_a_keyboard() -> None:
    keys = ["s", "shift+i", "shift+pageup", "ctrl+enter", ","]

    assert run("commands/keys.js", "return given.map((key) => m.label(key))", keys) == [
        "S",
        "⇧I",
        "⇧PgUp",
        "Ctrl + Enter",
        ",",
    ]
