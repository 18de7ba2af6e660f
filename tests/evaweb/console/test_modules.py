"""The page's modules that need no browser, run by Node; frames are those that the server makes."""

from __future__ import annotations

import base64
import json
import shutil
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from evaweb.console import frame_parts
from tests.standing import state_flags

MODULES = Path(__file__).parents[3] / "static" / "console"
NODE = shutil.which("node")
pytestmark = pytest.mark.skipif(NODE is None, reason="Node is not installed: the page's modules are not run")


def run(module: str, body: str, given: Any = None) -> Any:
    """What `body` returns, where `m` is the module and `given` the argument."""
    script = (
        f"const m = await import({json.dumps((MODULES / module).as_uri())});"
        "const given = JSON.parse((await import('node:fs')).readFileSync(0, 'utf8'));"
        f"console.log(JSON.stringify(await (async () => {{ {body} }})()));"
        "process.exit();"  # no timer that is left is waited for
    )
    assert NODE is not None
    found = subprocess.run(
        [NODE, "--input-type=module", "-e", script],
        input=json.dumps(given),
        capture_output=True,
        text=True,
        check=False,
    )
    assert found.returncode == 0, found.stderr
    return json.loads(found.stdout)


def test_a_frame_of_the_server_is_read_with_every_number_and_picture() -> None:
    rows = np.arange(14, dtype=np.float32) / 8
    poses = np.arange(2 * 3 * 16, dtype=np.float32).reshape(2, 3, 16)
    frame = frame_parts.build_frame(
        [
            frame_parts.encode_facts("state", {"state": "running", "nothing": float("nan")}, 1.0),
            frame_parts.encode_numbers(
                "joints", {"engaged": True}, {"measured": rows, "commanded": -rows}, 1.0
            ),
            frame_parts.encode_picture("camera/cam_high", b"\xff\xd8jpeg", 1.0),
            frame_parts.encode_array("poses", poses, 1.0),
        ],
        7,
        1.25,
    )
    read = run(
        "live/frame.js",
        """
        const bytes = Buffer.from(given, "base64");
        const frame = m.decode(bytes.buffer.slice(bytes.byteOffset, bytes.byteOffset + bytes.length));
        const { state, joints, poses, "camera/cam_high": picture } = frame.header.streams;
        return {
          header: [frame.header.frame, frame.header.t], state: state.json, engaged: joints.json.engaged,
          measured: [...frame.numbers(joints.arrays.measured)],
          commanded: [...frame.numbers(joints.arrays.commanded)],
          shape: poses.shape, poses: [...frame.numbers(poses)],
          picture: [...frame.bytes(picture)], age: picture.age,
        };
        """,
        base64.b64encode(frame).decode(),
    )

    assert read["header"] == [7, 1.25]
    assert read["state"] == {"state": "running", "nothing": None}
    assert read["engaged"] is True
    assert read["measured"] == rows.tolist()
    assert read["commanded"] == (-rows).tolist()
    assert read["shape"] == [2, 3, 16]
    assert read["poses"] == poses.ravel().tolist()
    assert bytes(read["picture"]) == b"\xff\xd8jpeg"
    assert read["age"] == 0.25


@pytest.mark.parametrize("message", [b"", b"\x01", b"\xff\xff\xff\x7f{}"])
def test_what_is_no_frame_is_refused(message: bytes) -> None:
    said = run(
        "live/frame.js",
        """
        const bytes = Uint8Array.from(given);
        try { m.decode(bytes.buffer); return "read"; }
        catch (error) { return error instanceof m.BadFrame ? error.message : `not a BadFrame: ${error}`; }
        """,
        list(message),
    )

    assert "bytes" in said
    assert not said.startswith("not a BadFrame")


def test_a_spike_survives_decimation() -> None:
    flat = [0.0] * 20_000
    flat[12_345], flat[777] = 9.0, -9.0
    calm = [float(index % 2) for index in range(20_000)]
    kept = run("curves/decimate.js", "return m.decimate(given, 1200)", [flat, calm])

    assert len(kept) <= 1200
    assert {777, 12_345} <= set(kept)
    assert kept == sorted(set(kept))


def test_few_points_are_all_kept() -> None:
    assert run("curves/decimate.js", "return m.decimate(given, 1000)", [[1.0, 2.0, 3.0]]) == [0, 1, 2]


def test_a_gap_stays_a_gap() -> None:
    kept = run(
        "curves/decimate.js",
        "return m.decimate([Array.from({length: 900}, (_, i) => i > 300 && i < 600 ? NaN : i)], 90)",
    )

    assert any(300 < index < 600 for index in kept)


def test_the_trace_keeps_the_newest_rows_and_knows_what_did_not_come() -> None:
    found = run(
        "curves/trace.js",
        """
        const trace = new m.Trace({ dim: 2, kinds: ["measured", "commanded"], rows: 4 });
        for (let t = 1; t <= 6; t += 1) trace.add(t, { measured: [t, 10 * t], commanded: t > 4 ? [0, t] : undefined });
        trace.add(3, { measured: [99, 99] });  // overtaken by newer ones
        const { times, values } = trace.joint(1, 4);
        const [measured, commanded] = [[...values.measured], [...values.commanded]];
        return { newest: trace.newest, times: [...times], measured, commanded };
        """,
    )

    assert found["newest"] == 6
    assert found["times"] == [4, 5, 6]
    assert found["measured"] == [40, 50, 60]
    assert found["commanded"] == [None, 5, 6]  # NaN where nothing was sent


def test_a_copy_of_the_trace_stays_when_the_trace_goes_on() -> None:
    found = run(
        "curves/trace.js",
        """
        const trace = new m.Trace({ dim: 1, kinds: ["state"], rows: 3 });
        for (let t = 1; t <= 3; t += 1) trace.add(t, { state: [t] }, { chunk: t, limited: t === 2 });
        const paused = trace.copy();
        for (let t = 4; t <= 9; t += 1) trace.add(t, { state: [t] });
        const { times, values, columns } = paused.joint(0, 0, 3);
        const { chunk, limited } = columns;
        return { times: [...times], state: [...values.state], chunk: [...chunk], limited: [...limited] };
        """,
    )

    assert found == {"times": [-2, -1, 0], "state": [1, 2, 3], "chunk": [1, 2, 3], "limited": [0, 1, 0]}


def marks(chunk: list[int], **columns: list[int]) -> Any:
    """The marks of samples a tenth of a second apart, in tenths."""
    given = {"chunk": chunk, **dict.fromkeys(("chunks", "limited", "simulated"), [0] * len(chunk)), **columns}
    body = """
    const found = m.marks(given.chunk.map((_, index) => index / 10), given);
    const { seams, bands, limits, simulations } = found;
    return { seams, bands: bands.flat(), limits, simulations: simulations.flat() };
    """
    found = run("curves/curve_marks.js", body, given)
    return {name: [round(10 * time, 1) for time in times] for name, times in found.items()}


def test_a_hairline_stands_at_the_first_sample_of_another_chunk() -> None:
    assert marks([-1, -1, 1, 1, 2, 2, 2, 5])["seams"] == [2, 4, 7]


def test_what_no_chunk_planned_begins_no_chunk() -> None:
    assert marks([1, 0, 0, -1, -1, 1])["seams"] == [5]


def test_a_band_covers_the_samples_that_more_than_one_chunk_made() -> None:
    assert marks([1] * 9, chunks=[1, 2, 2, 3, 1, 1, 2, 1, 2])["bands"] == [1, 4, 6, 7, 8, 9]


def test_the_newest_sample_stands_for_a_tenth_of_a_second() -> None:
    assert marks([1, 1], chunks=[1, 2])["bands"] == [1, 2]


def test_what_a_simulated_robot_executed_is_a_stretch_of_its_own() -> None:
    assert marks([1] * 6, simulated=[0, 1, 1, 1, 0, 1])["simulations"] == [1, 4, 5, 6]


def test_every_sample_that_safety_changed_is_marked() -> None:
    assert marks([1] * 5, limited=[0, 1, 1, 0, 1])["limits"] == [1, 2, 4]


def test_the_sample_at_the_cursor_is_the_last_that_began() -> None:
    body = "return [-1, 0, 0.5, 1, 7].map((t) => m.lastNotAbove([0, 1, 2], t))"

    assert run("../site/binary_search.js", body) == [-1, 0, 0, 1, 2]


@pytest.mark.parametrize(
    ("chunk", "seam", "looks"),
    [
        ({"state": "merged", "targets": [-1, 7, 8, 9, -1], "overlap": 2}, 1, "idle blended blended own idle"),
        ({"state": "merged", "targets": [4, 5], "overlap": 0}, 0, "own own"),
        ({"state": "proposed", "targets": [-1, -1]}, 0, "own own"),
        ({"state": "dropped", "targets": [-1, -1]}, -1, "idle idle"),
        ({"state": "merged", "targets": [-1, -1]}, -1, "idle idle"),
    ],
)
def test_the_seam_of_a_chunk_is_its_first_row_that_is_executed(
    chunk: dict[str, Any], seam: int, looks: str
) -> None:
    assert run("scene/scene_chunk.js", "return m.rowsOf(given)", chunk) == {
        "seam": seam,
        "looks": looks.split(),
    }


def test_the_film_of_a_chunk_takes_as_long_as_the_chunk_and_begins_again() -> None:
    body = """
    return [0, 0.5, 1.75, 4, 4.5, 4.7].map((t) => m.moment([0, 2, 4], 1, t)).map(({ from, to, share }) =>
      [from, to, Math.round(100 * share) / 100]);
    """

    assert run("scene/scene_preview.js", body) == [
        [0, 1, 0],
        [0, 1, 0.25],
        [0, 1, 0.88],
        [2, 2, 0],  # it rests at its end
        [2, 2, 0],
        [0, 1, 0],
    ]


@pytest.mark.some(4)
@pytest.mark.parametrize("direction", [[0.75, 0.62, 0.62], [0, 1, 0.12], [0.0, -0.002, 1], [-1, 1, 0.3]])
@pytest.mark.parametrize("lower", [0.0, 0.02])
def test_everything_that_has_to_be_in_view_is(direction: list[float], lower: float) -> None:
    wide, high = 0.5, 0.3
    low, top = np.array([-0.5, -0.9, -0.7]), np.array([0.4, 0.6, 1.1])
    corners = [[(low, top)[bits >> axis & 1][axis] for axis in range(3)] for bits in range(8)]
    body = "return m.eyeFor(given.corners, given.direction, given.wide, given.high, given.lower)"
    given = {"corners": corners, "direction": direction, "wide": wide, "high": high, "lower": lower}
    found = run("scene/scene_views.js", body, given)

    eye, back = np.array(found["eye"]), np.array(direction) / np.linalg.norm(direction)
    assert np.allclose(np.cross(eye - found["target"], back), 0, atol=1e-9)
    right = np.cross([0, 0, 1], back)
    right /= np.linalg.norm(right)
    off = np.array(corners) - eye
    depth = -off @ back
    across, up = off @ right / depth, off @ np.cross(back, right) / depth + lower
    assert (depth > 0).all()
    assert np.abs(across).max() <= wide * 1.03
    assert np.abs(up).max() <= high * 1.04
    assert max(np.abs(across).max() / wide, np.abs(up).max() / high) > 0.93  # and no farther away than needed


def test_a_film_of_one_row_stands_still() -> None:
    assert run("scene/scene_preview.js", "return m.moment([0], 0.1, 5)") == {"from": 0, "to": 0, "share": 0}


def test_the_preview_is_between_its_keyframes() -> None:
    found = run(
        "scene/scene_preview.js",
        """
        const preview = new m.Preview();
        const before = preview.at(0);
        preview.begin([0, 1], Float32Array.from([0, 10, 4, 30]), 1);
        const middle = [...preview.at(performance.now() + 500)];
        preview.end();
        return { before, middle: middle.map(Math.round), after: preview.at(0) };
        """,
    )

    assert found == {"before": None, "middle": [2, 20], "after": None}


@given(
    st.lists(st.lists(st.integers(0, 60), min_size=1, max_size=60), min_size=1, max_size=20), st.booleans()
)
@settings(max_examples=5)
def test_every_value_of_a_distribution_is_in_one_bar_between_its_ends(
    many: list[list[int]], whole: bool
) -> None:
    found = run(
        "debug/distribution.js",
        "return given[0].map((values) => m.bars(values, given[1]))",
        [many, {"whole": whole}],
    )

    for values, made in zip(many, found, strict=True):
        assert sum(made["counts"]) == len(values)
        assert made["low"] <= min(values)
        assert made["high"] >= max(values)
        assert 1 <= len(made["counts"]) <= 24


def test_each_whole_number_has_a_bar_of_its_own() -> None:
    found = run("debug/distribution.js", "return m.bars([3, 3, 5, 4, 3], { whole: true })")

    assert found == {"low": 3, "high": 5, "counts": [3, 1, 1]}


def test_equal_values_are_no_spread() -> None:
    found = run("debug/distribution.js", "return m.bars([80, 80], { narrow: 10 })")

    assert (found["low"], found["high"], max(found["counts"])) == (75, 85, 2)


@given(
    st.lists(st.lists(st.floats(0, 1000), min_size=1, max_size=30), min_size=1, max_size=20),
    st.integers(0, 100),
)
@settings(max_examples=5)
def test_quantiles_are_those_of_numpy(many: list[list[float]], percent: int) -> None:
    found = run(
        "debug/distribution.js",
        "return given[0].map((values) => m.quantile(values, given[1]))",
        [many, percent],
    )

    assert found == pytest.approx([np.percentile(values, percent) for values in many])


def test_of_nothing_there_is_no_quantile() -> None:
    assert run("debug/distribution.js", "return Number.isNaN(m.quantile([], 50))") is True


@pytest.mark.some(3)
@pytest.mark.parametrize(
    ("panel", "state", "step"),
    [
        ({"panel": "eval", "status": "", "setUp": ""}, "idle", "choose"),
        ({"panel": "eval", "status": "", "setUp": ""}, "ready", "choose"),
        ({"panel": "eval", "status": "prepared", "setUp": ""}, "ready", "setup"),
        ({"panel": "eval", "status": "prepared", "setUp": "yes"}, "setting_up", "setup"),
        ({"panel": "eval", "status": "prepared", "setUp": "yes"}, "ready", "run"),
        ({"panel": "eval", "status": "prepared", "setUp": "yes"}, "faulted", "setup"),
        ({"panel": "eval", "status": "running", "setUp": "yes"}, "running", "run"),
        ({"panel": "eval", "status": "paused", "setUp": "yes"}, "holding", "run"),
        ({"panel": "eval", "status": "ended", "setUp": "yes"}, "ready", "score"),
        ({"panel": "debug"}, "idle", "setup"),
        ({"panel": "debug"}, "ready", "run"),
        ({"panel": "debug"}, "holding", "run"),
    ],
)
def test_the_step_to_do_now_follows_trial_and_state(panel: dict[str, str], state: str, step: str) -> None:
    assert (
        run("trial/steps.js", "return m.currentStep(given[0], given[1])", [panel, state_flags(state)]) == step
    )


def test_an_identity_is_a_random_uuid_of_version_four() -> None:
    first, second = run("../site/identity.js", "return [m.uuid(), m.uuid()]")

    assert first != second
    assert first[14] == "4"
    assert first[19] in "89ab"
    assert [len(part) for part in first.split("-")] == [8, 4, 4, 4, 12]


STOPS = """
const sent = [], posted = [], late = [];
const stops = new m.Stops({
  send: (message) => { if (given.open) sent.push(message); return given.open; },
  post: async (command) => { posted.push(command); return given.post ?? new Promise(() => {}); },
  late: (ack) => late.push(ack.status),
});
const order = { kind: "stop", uuid: "u1", epoch: 4, page: "p1" };
const said = stops
  .give(order, given.patience)
  .then((answer) => answer.status, (error) => [error.message, error.unknown]);
"""


def test_a_stop_that_the_socket_answers_is_not_posted() -> None:
    found = run(
        "commands/stops.js",
        STOPS
        + """
        stops.acknowledged({ uuid: "u1", kind: "stop", status: "done", reason: "" });
        return { said: await said, sent, posted };
        """,
        {"open": True, "patience": 10_000},
    )

    assert found == {"said": "done", "sent": [{"type": "stop", "uuid": "u1", "epoch": 4}], "posted": []}


def test_a_stop_goes_by_post_under_the_same_uuid_where_the_socket_is_closed() -> None:
    given = {"open": False, "patience": 10_000, "post": {"status": "accepted"}}
    found = run("commands/stops.js", STOPS + "return { said: await said, posted };", given)

    assert found["said"] == "accepted"
    assert [order["uuid"] for order in found["posted"]] == ["u1"]


def test_a_stop_that_nobody_acknowledges_is_posted_too_and_the_first_answer_counts() -> None:
    given = {"open": True, "patience": 5, "post": {"status": "done"}}
    posted_first = run("commands/stops.js", STOPS + "return { said: await said, sent, posted };", given)
    acknowledged_first = run(
        "commands/stops.js",
        STOPS
        + """
        while (!posted.length) await new Promise((resolve) => setTimeout(resolve, 1));
        stops.acknowledged({ uuid: "u1", kind: "stop", status: "accepted" });
        return await said;
        """,
        {"open": True, "patience": 5},
    )

    assert posted_first["said"] == "done"
    assert [order["uuid"] for order in posted_first["sent"] + posted_first["posted"]] == ["u1", "u1"]
    assert acknowledged_first == "accepted"


BESIDE = STOPS.replace(
    "  post:",
    "beside: async () => { if (given.fault) throw new Error(given.fault); return given.beside; },\n  post:",
)


@pytest.mark.parametrize("open_", [True, False])
def test_a_stop_goes_to_the_process_for_stops_at_once_whose_answer_counts_where_it_is_the_first(
    open_: bool,
) -> None:
    given = {"open": open_, "patience": 10_000, "beside": {"status": "accepted"}}
    assert run("commands/stops.js", BESIDE + "return { said: await said, sent };", given) == {
        "said": "accepted",
        "sent": [{"type": "stop", "uuid": "u1", "epoch": 4}] if open_ else [],
    }


def test_a_process_for_stops_that_fails_is_told_only_where_all_ways_have_failed() -> None:
    acknowledge = 'stops.acknowledged({ uuid: "u1", kind: "stop", status: given.status, reason: "why" });'
    given = {"open": True, "patience": 10_000, "fault": "it is gone"}
    found = [
        run("commands/stops.js", BESIDE + acknowledge + "return await said;", {**given, "status": status})
        for status in ("done", "refused")
    ]
    assert found == ["done", ["why", False]]
    left = {**given, "patience": 5, "post": {"status": "done"}}
    assert run("commands/stops.js", BESIDE + "return await said;", left) == "done"


def test_a_stop_that_was_not_carried_out_is_never_called_done() -> None:
    body = """
    return given.map((status) => {
      try { return m.answered({ status, reason: "because" }).status; }
      catch (error) { return [error.message, error.unknown]; }
    });
    """
    found = run("commands/stops.js", body, ["accepted", "done", "refused", "failed", "unknown", "pressed"])

    assert found[:2] == ["accepted", "done"]
    assert found[2:] == [["because", False], ["because", False], ["because", True], ["because", True]]


def test_an_answer_after_the_page_was_told_is_passed_on() -> None:
    found = run(
        "commands/stops.js",
        STOPS + 'await said; stops.acknowledged({ uuid: "u1", status: "done" }); return late;',
        {"open": False, "patience": 10_000, "post": {"status": "done"}},
    )

    assert found == ["done"]


def test_the_page_knows_whether_it_or_another_of_the_same_person_commands() -> None:
    body = """
    const store = new m.Store({ user: "ada", page: "p1", role: "operator" });
    return given.map((holder) => {
      store.snapshot = { lease: { holder, epoch: 1 } };
      return store.lease;
    });
    """
    holders = ["", "web:ada:p1", "web:ada:p2", "web:adam:p1", "terminal"]

    assert run("live/store.js", body, holders) == ["free", "mine", "elsewhere", "other", "other"]


def test_curves_have_one_word_and_one_colour_each() -> None:
    kinds = run("curves/curve_kinds.js", "return m.KINDS")

    assert [kind["name"] for kind in kinds] == ["raw", "smoothed", "state", "executed"]
    assert len({kind["colour"] for kind in kinds}) == len(kinds)


def test_no_value_is_a_gap_to_the_plot() -> None:
    assert run("curves/curve_kinds.js", "return m.blank([1, NaN, 2])") == [1, None, 2]


def test_a_state_asks_for_the_robots_picture_only_where_it_says_that_there_is_none() -> None:
    states = [{"label": "limp"}, {"connected": True}, {"connected": False}]
    body = "return given.map((is) => m.advice(is)?.title ?? null)"
    assert run("live/labels.js", body, states) == [None, None, "No complete picture of the robot"]


def test_an_event_is_said_in_words_with_its_weight() -> None:
    events = [
        {"kind": "state", "text": "setting_up -> ready: 50 rows", "data": state_flags("ready")},
        {"kind": "state", "text": "running -> holding: halted", "data": state_flags("holding")},
        {"kind": "state", "text": "running -> faulted: e-stop", "data": state_flags("faulted")},
        {"kind": "command", "text": "run by ann: accepted"},
        {"kind": "command", "text": "run by bob: refused, web:ann:6b9c-1 holds the lease"},
        {"kind": "source_frames_lost", "text": "source: frames lost (3 so far)"},
        {"kind": "recording_failed", "text": "the disk is full"},
        {"kind": "estopped", "text": "by ann"},
        {"kind": "setup", "text": "idle"},
        {"kind": "limited", "text": "left_arm.joint1 limited"},
        {"kind": "limited_sum", "text": "12 actions were limited"},
        {"kind": "policy_lost", "text": "no answer within 2 s"},
        {"kind": "policy_back", "text": "the policy answers again after 1.2 s"},
        {"kind": "tuned_to", "text": "strategy sync, task 'x'"},
        {"kind": "rtc_warning", "text": "the server does not know a prefix"},
        {"kind": "drives", "text": "drives disabled", "data": {"enabled": False, "faults": []}},
        {"kind": "drives", "text": "drives enabled", "data": {"enabled": True, "faults": []}},
        {"kind": "episode_opened", "text": "recording 0a5624d8-64f2-4530-9518-f914c2fefd90"},
        {"kind": "a_new_kind", "text": "said"},
    ]
    body = "return given.map((event) => [m.kindLabel(event.kind), m.eventText(event), m.severity(event)])"

    assert run("live/event_text.js", body, events) == [
        ["state", "setting up → ready: 50 rows", ""],
        ["state", "running → holding: halted", "warn"],
        ["state", "running → faulted: e-stop", "bad"],
        ["command", "Run by ann: accepted", ""],
        ["command", "Run by bob: refused, ann (page 6b9c) holds the lease", "warn"],
        ["robot link", "frames lost (3 so far)", "warn"],
        ["recording failed", "the disk is full", "bad"],
        ["e-stop", "by ann", "bad"],
        ["set-up", "the set-up is over", ""],
        ["safety", "left_arm.joint1 limited", "warn"],
        ["safety", "12 actions were limited", ""],
        ["policy lost", "no answer within 2 s", "bad"],
        ["policy is back", "the policy answers again after 1.2 s", "good"],
        ["strategy asked", "strategy sync, task 'x'", ""],
        ["RTC", "the server does not know a prefix", "warn"],
        ["drives", "drives disabled", "bad"],
        ["drives", "drives enabled", "good"],
        ["recording", "begun: 0a5624d8", ""],
        ["a new kind", "said", ""],
    ]


EARLY = """
const source = (await import("node:fs")).readFileSync(new URL(given.module), "utf8");
const listeners = {}, posted = [];
const part = (id) => ({ dataset: {}, innerHTML: "at rest", addEventListener: (kind, act) => (listeners[id] = act) });
const parts = Object.fromEntries(["estop-area", "estop-note", "estop", "outcome"].map((id) => [id, part(id)]));
Object.assign(parts["estop-area"].dataset, { address: "/estop", stops: given.stops ?? "" });
const document = { getElementById: (id) => parts[id], querySelector: () => ({ value: "token" }) };
const window = { addEventListener: (kind, act) => (listeners[kind] = act) };
const fetch = async (address, { body }) => {
  posted.push([address, JSON.parse(body).why]);
  if (given.dead === address) throw new TypeError("refused");
  return { ok: given.status === 200, status: given.status, json: async () => ({ status: given.said }) };
};
const quiet = { error() {} };
let late;
const later = (act) => (late = act);
new Function("document", "window", "fetch", "console", "setTimeout", source)(document, window, fetch, quiet, later);
const settled = () => new Promise((resolve) => setTimeout(resolve, 5));
const shown = () => [parts["estop-area"].dataset.kind, parts["estop-note"].textContent];
"""


def test_the_e_stop_works_before_and_without_the_modules() -> None:
    given = {"module": (MODULES / "commands/estop_early.js").as_uri(), "status": 200, "said": "accepted"}
    body = """
    listeners.estop();
    await settled();
    const first = shown();
    listeners.keydown({ code: "Escape", preventDefault() {}, target: {} });
    listeners.keydown({ code: "Space", preventDefault() {}, target: { closest: () => true } });
    parts["estop-area"].dataset.ready = "";
    listeners.estop();
    return { first, posted, rest: parts["estop-note"].dataset.rest };
    """
    found = run("live/labels.js", EARLY + body, given)

    assert found["first"] == ["stopped", "E-stop acknowledged: the robot is held."]
    assert found["posted"] == [
        ["/estop", "button on the page, before it had started"],
        ["/estop", "Escape on the page, before it had started"],
        ["/estop", "Space on the page, before it had started"],
    ]
    assert found["rest"] == "at rest"


@pytest.mark.parametrize(("status", "said"), [(409, "failed"), (200, "unknown"), (403, None)])
def test_an_early_e_stop_that_failed_says_to_use_the_hardware_stop(status: int, said: str | None) -> None:
    given = {"module": (MODULES / "commands/estop_early.js").as_uri(), "status": status, "said": said}
    found = run("live/labels.js", EARLY + "listeners.estop(); await settled(); return shown();", given)

    assert found == ["failed", "USE THE HARDWARE STOP"]


@pytest.mark.parametrize("dead", ["/estop", "http://lab:8001/estop", ""])
def test_an_early_e_stop_goes_both_ways_and_one_is_enough(dead: str) -> None:
    given = {
        "module": (MODULES / "commands/estop_early.js").as_uri(),
        "status": 200,
        "said": "done",
        "dead": dead,
    }
    body = (
        EARLY + "listeners.estop(); await settled(); return [shown()[0], posted.map(([address]) => address)];"
    )
    found = run("live/labels.js", body, {**given, "stops": "http://lab:8001"})
    assert found == ["stopped", ["http://lab:8001/estop", "/estop"]]


PRESSED = """
const element = () => ({
  dataset: {}, classList: [], title: "", textContent: "", addEventListener() {}, append() {}, toggleAttribute() {},
});
const elements = Object.fromEntries(["estop", "estop-note", "estop-area"].map((id) => [id, element()]));
const kinds = [];
elements["estop-area"].dataset = new Proxy({}, {
  set: (target, key, value) => Boolean((target[key] = value) || true) && (key !== "kind" || kinds.push(value) > 0),
});
elements.config = { textContent: JSON.stringify({ page: "eval", api: { estop: "/estop" } }) };
globalThis.document = { getElementById: (id) => elements[id], createElement: element, querySelector: () => null };
globalThis.window = { addEventListener() {} };
const posted = [], sent = [];
globalThis.fetch = async (address, { body, headers }) => {
  posted.push([address, JSON.parse(body).uuid === sent[0]?.uuid, headers["Content-Type"]]);
  if (given.dead.includes(address)) throw new TypeError("refused");
  if (given.silent.includes(address)) await new Promise(() => {});
  return { ok: true, text: async () => JSON.stringify({ status: "done" }) };
};
const { EStop } = await import(given.module);
const way = { there: Boolean(given.way), estop: given.way, ask: async () => true };
const socket = { send: (message) => { sent.push(message); return given.open; } };
const estop = new EStop({ on() {} }, socket, way);
const kind = () => elements["estop-area"].dataset.kind;
const until = async (reached) => { while (!reached()) await new Promise((resolve) => setTimeout(resolve, 5)); };
estop.press("button");
const ack = (status) => estop.acknowledged({ uuid: sent[0].uuid, status, reason: "" });
"""
STOPS_AT = "http://lab:8001/estop"


def pressed(body: str, **given: Any) -> Any:
    known = {
        "module": (MODULES / "commands/estop.js").as_uri(),
        "open": True,
        "way": STOPS_AT,
        "dead": [],
        "silent": [],
    }
    return run("live/labels.js", PRESSED + body, known | given)


def test_a_press_goes_both_ways_at_once_under_one_uuid_and_the_first_answer_counts() -> None:
    ends = 'await until(() => kind() === "stopped"); return posted;'
    once = [[STOPS_AT, True, "text/plain"]]
    assert pressed(ends) == once
    assert pressed('ack("done"); ' + ends, silent=[STOPS_AT]) == once
    assert pressed('ack("failed"); ' + ends) == once, "one way's failure is no failure"


def test_a_press_without_a_socket_goes_to_both_processes_and_one_without_a_way_as_ever() -> None:
    ends = 'await until(() => kind() === "stopped"); return posted.map(([address]) => address);'
    assert pressed(ends, open=False, dead=[STOPS_AT]) == [STOPS_AT, "/estop"]
    assert pressed('ack("done"); ' + ends, way="") == []
    assert pressed(ends, way="", open=False) == ["/estop"]


def test_a_press_that_fails_both_ways_says_so_and_what_is_left_is_tried() -> None:
    told = 'await until(() => kind() === "stopped"); return [kinds, posted.map(([address]) => address)];'
    once_more = [["pressed", "failed", "stopped"], [STOPS_AT, "/estop"]]
    assert pressed(told, silent=[STOPS_AT]) == once_more, "half a second of silence"
    assert pressed('ack("failed"); ' + told, dead=[STOPS_AT]) == once_more
    dead = 'ack("failed"); await until(() => posted.length === 2 && kinds.length === 3); return kinds;'
    assert pressed(dead, dead=[STOPS_AT, "/estop"]) == ["pressed", "failed", "failed"]


SPACES = """
const keys = [];
globalThis.window.addEventListener = (kind, act) => kind === "keydown" && keys.push(act);
const store = { on() {}, open: true, fresh: true, snapshot: { state: "idle", estop: false } };
new EStop(store, socket, way);
const press = (over) => {
  sent.length = 0;
  const control = over ? { checkVisibility: () => true } : null;
  const event = { code: "Space", target: { closest: () => control }, prevented: 0 };
  event.preventDefault = () => (event.prevented = 1);
  keys.at(-1)(event);
  return [sent.length, event.prevented];
};
const found = {};
for (const state of given.states) {
  store.snapshot = { ...store.snapshot, state };
  found[state] = [press(true), press(false)];
}
store.fresh = false;
store.snapshot = { ...store.snapshot, state: "idle" };
found.unheard = [press(true), press(false)];
return found;
"""


def test_space_is_a_controls_only_while_the_robot_is_idle_or_ready() -> None:
    stops, types = (1, 1), (0, 0)
    moving = ("setting_up", "running", "holding", "disconnected")
    found = pressed(SPACES, states=["idle", "ready", *moving])
    assert {state: tuple(of_state[0]) for state, of_state in found.items()} == {
        **dict.fromkeys(("idle", "ready"), types),
        **dict.fromkeys((*moving, "unheard"), stops),
    }
    assert all(tuple(of_state[1]) == stops for of_state in found.values())


KEYS = """
const handlers = [], clicked = [], said = [];
globalThis.window = { addEventListener: (kind, act) => handlers.push(act) };
globalThis.CSS = { escape: (text) => text };
const all = given.controls.map(([key, shown]) => ({
  dataset: { key, keyText: "Save the score" }, matches: () => false, click: () => clicked.push(key),
  checkVisibility: () => shown,
}));
globalThis.document = {
  getElementById: () => null, querySelector: () => (given.modal ? {} : null),
  querySelectorAll: (selector) => all.filter(({ dataset }) => selector === `[data-key="${dataset.key}"]`),
};
const { keyboard } = await import(given.module);
keyboard((words) => said.push(words));
handlers[0]({ key: given.key, target: { closest: () => null, checkVisibility: () => true }, preventDefault: () => {} });
return [clicked, said];
"""


@pytest.mark.parametrize(
    ("controls", "key", "modal", "found"),
    [
        ([["s", False], ["s", True]], "s", False, [["s"], []]),
        ([["s", False]], "s", False, [[], ["Save the score (S): not on the screen at the moment"]]),
        ([["s", False]], "s", True, [[], []]),
        ([["s", False]], "x", False, [[], []]),
    ],
)
def test_a_key_whose_control_is_not_on_the_screen_says_so(
    controls: list[Any], key: str, modal: bool, found: list[Any]
) -> None:
    module = (MODULES.parent / "site/keys.js").as_uri()
    given = {"module": module, "controls": controls, "key": key, "modal": modal}
    assert run("live/labels.js", KEYS, given) == found


LEASE = """
const quiet = () => {};
globalThis.document = {
  title: "bench-1", hidden: false, body: { dataset: {}, addEventListener: quiet }, addEventListener: quiet,
  querySelectorAll: () => [], querySelector: () => null,
  getElementById: () => ({ textContent: JSON.stringify({ page: "eval", api: { lease: "/lease" }, beat: "/beat.js" }) }),
};
globalThis.window = { addEventListener: quiet, htmx: { trigger: quiet } };
globalThis.Worker = class { addEventListener() {} };
globalThis.fetch = async () => ({ ok: given.answers, status: given.answers ? 200 : 409, text: async () => "{}" });
let now = 0;
globalThis.performance = { now: () => now };
const handlers = {}, said = [];
const { LeaseControls } = await import(given.module);
const store = {
  on: (names, act) => [names].flat().forEach((name) => (handlers[name] = act)),
  page: "p", commander: "bob", fresh: true, lease: "mine", snapshot: { facts: { lease_ttl_s: 5 }, state_is: {} },
};
const clicks = [];
globalThis.document.addEventListener = (kind, act) => kind === "click" && clicks.push(act);
new LeaseControls(store, { send: quiet }, { say: (text) => said.push(text), fail: quiet });
const becomes = (lease, fresh = true) => { Object.assign(store, { lease, fresh }); handlers.snapshot(); };
const press = (action) => clicks[0]({ target: { closest: () => ({ dataset: { lease: action } }) } });
const lost = () => said.filter((text) => text.startsWith("You do not")).map((text) => text.replace(/[0-9:]{8}/, "T"));
"""


@pytest.mark.parametrize(
    ("body", "said"),
    [
        ('now = 4500; becomes("free")', "your page was not heard for 5 s"),
        ('becomes("mine", false); now = 7000; becomes("free")', "your page was not heard for 7 s"),
        ('now = 4500; handlers.renewed({ ok: true }); becomes("other")', "bob commands"),
        ('now = 6000; becomes("other")', "your page was not heard for 6 s; bob commands"),
        ('becomes("elsewhere")', "you took the station on another page"),
        ('await press("give_up"); becomes("free")', ""),
        ('store.lease = "free"; becomes("free"); becomes("other")', ""),
    ],
)
def test_a_page_says_that_it_commands_no_more_with_since_when_and_why(body: str, said: str) -> None:
    given = {"module": (MODULES / "commands/lease.js").as_uri(), "answers": True}
    opened = LEASE.replace('lease: "mine"', 'lease: "free"') if "store.lease" in body else LEASE
    found = run("live/labels.js", opened + body + '; becomes("free"); return lost();', given)
    assert found == ([f"You do not command any more, since T: {said}."] if said else [])


def test_a_page_that_starts_late_takes_back_that_it_has_not() -> None:
    given = {"module": (MODULES / "commands/estop_early.js").as_uri(), "status": 200, "said": "accepted"}
    early = run(
        "live/labels.js", EARLY + "late(); return [parts.outcome.textContent, parts.outcome.dataset];", given
    )
    assert early == ["This page has not started: reload it. Its e-stop works.", {"late": ""}]
    body = """
    elements.outcome = { dataset: { late: "" }, textContent: "This page has not started" };
    new EStop({ on() {} }, socket, way);
    const late = elements.outcome.textContent;
    elements.outcome.textContent = "accepted";
    new EStop({ on() {} }, socket, way);
    return [late, elements.outcome.textContent];
    """
    assert pressed(body) == ["", "accepted"]


def camera(
    condition: str, why: str = "", since: float = 10.0, losses: int = 0, age: float | None = 0.04
) -> Any:
    """As the runtime tells of it."""
    told = {"kind": "rtsp", "source": "rtsp://10.0.0.7:554/one", "condition": condition, "since": since}
    return {**told, "why": why, "losses": losses, "age": age}


def test_a_camera_of_the_stations_own_is_named_with_what_is_wrong() -> None:
    refused = "refused: nothing listens at that port"
    cameras = {
        "live": camera("live"),
        "absent": camera("opening", refused, age=None),
        "lost": camera("lost", refused, since=12.5, losses=1),
        "ended": camera("ended", "the file is over"),
        "other": camera("melting", "it is hot"),
        "transports": None,
    }
    body = "return Object.fromEntries(Object.entries(given).map(([name, told]) => [name, m.cameraProblem(told, 16)]))"
    assert run("live/camera_text.js", body, cameras) == {
        "live": None,
        "absent": {"word": "no picture yet", "reason": refused},
        "lost": {"word": "reconnecting, lost 3.5 s ago", "reason": refused},
        "ended": {"word": "the video is over", "reason": "the file is over"},
        "other": {"word": "melting", "reason": "it is hot"},
        "transports": None,
    }


def test_all_cameras_of_the_stations_own_are_told_in_a_line() -> None:
    cameras = {"cam_high": camera("live", losses=2), "cam_wrist": camera("opening", "404", age=None)}
    body = "return [m.cameraSummary(given, 16), m.cameraSummary(undefined, 16), m.cameraSummary({}, 16)]"
    assert run("live/camera_text.js", body, cameras) == [
        "cam_high: rtsp from rtsp://10.0.0.7:554/one: newest picture 40 ms old, lost 2 times; "
        "cam_wrist: no picture yet (404)",
        "",
        "",
    ]
    once = {"a": camera("live", losses=1, age=None)}
    assert run("live/camera_text.js", "return m.cameraSummary(given, 16)", once) == (
        "a: rtsp from rtsp://10.0.0.7:554/one: no picture yet, lost once"
    )


# A page with one camera whose pictures are words: what is on its canvas, whether it is stale, what was decoded.
ONE_CAMERA = """
globalThis.setInterval = () => 0;
const decoded = [];
globalThis.createImageBitmap = async (blob) => {
  const word = await blob.text();
  decoded.push(word);
  if (word.startsWith("broken")) throw new Error("no picture");
  return { width: 1, height: 1, word, close() {} };
};
const part = () => ({ textContent: "" });
const canvas = new EventTarget();
let lost = false;
canvas.getContext = () => ({ drawImage: ({ word }) => lost || (canvas.word = word), isContextLost: () => lost });
const happens = (event) => {
  lost = event === "contextlost";
  canvas.word = "";
  canvas.dispatchEvent(new Event(event));
};
const figure = {
  dataset: { camera: "wrist" },
  querySelector: (what) => (what === "canvas" ? canvas : part()),
  appendChild: (one) => one,
  toggleAttribute: (name, on) => (figure[name] = on),
};
globalThis.document = { querySelectorAll: () => [figure], createElement: part };
const cameras = new m.Cameras({ on() {} });
const coming = (word, age = 0) =>
  cameras.prepare({
    header: { streams: { "camera/wrist": { mime: "image/jpeg", age } } },
    bytes: () => new TextEncoder().encode(word),
  });
const show = async (...words) => {
  await Promise.all(words.map((word) => coming(word).then((draw) => draw())));
  return [canvas.word ?? "", figure["data-stale"]];
};
"""


@pytest.mark.some(4)
@pytest.mark.parametrize(
    ("body", "shown", "decodings"),
    [
        ("return [await show('a'), await show('a')]", [["a", False], ["a", False]], ["a"]),
        ("return [await show('a'), await show('b', 'a')]", [["a", False], ["a", False]], ["a", "b", "a"]),
        ("return [await show('a'), await show('b', 'b')]", [["a", False], ["b", False]], ["a", "b"]),
        ("return [await show('')]", [["", False]], [""]),
        (
            "const first = await show('broken');"
            "return [first, await show('broken'), await show('a'), await show('broken')]",
            [["", True], ["", True], ["a", False], ["a", False]],
            ["broken", "a", "broken"],
        ),
        (  # the browser lost what it draws with: what is there again is blank
            "const before = await show('a'); happens('contextlost'); const without = await show('a');"
            "happens('contextrestored'); return [before, without, await show('a')]",
            [["a", False], ["", True], ["a", False]],
            ["a", "a", "a"],
        ),
    ],
)
def test_a_picture_is_decoded_again_unless_it_is_on_the_screen(
    body: str, shown: list[Any], decodings: list[str]
) -> None:
    said = ONE_CAMERA + body.replace("return [", "const shown = [") + "; return [shown, decoded]"
    assert run("live/cameras.js", said) == [shown, decodings]


def test_what_happens_to_cameras_is_weighed() -> None:
    kinds = ["camera_absent", "camera_lost", "camera_ended", "camera_is_a_video", "camera_back"]
    body = "return given.map((kind) => [m.kindLabel(kind), m.severity({kind, text: ''})])"
    assert run("live/event_text.js", body, kinds) == [
        ["camera absent", "warn"],
        ["camera lost", "warn"],
        ["video is over", "warn"],
        ["video as camera", "warn"],
        ["camera is back", "good"],
    ]


def test_rectangles_are_drawn_from_any_corner_moved_and_typed_and_stay_inside_the_picture() -> None:
    found = run(
        "../plans/rectangles.js",
        """
        const drawn = m.fromPoints({ x: 0.6, y: 0.9 }, { x: 0.2, y: -0.1 });
        const typed = m.withValue({ name: "cup", x: 0.5, y: 0.5, width: 0.2, height: 0.2 }, "width", 0.8);
        const pushed = [m.translate(drawn, 0.9, 0.9), typed, m.withValue(typed, "y", 7), m.withValue(typed, "x", NaN)];
        return [drawn, ...pushed, m.unusedName(["object 1", "cup"])];
        """,
    )
    assert found == [
        {"x": 0.2, "y": 0, "width": 0.4, "height": 0.9},
        {"x": 0.6, "y": 0.1, "width": 0.4, "height": 0.9},
        {"name": "cup", "x": 0.2, "y": 0.5, "width": 0.8, "height": 0.2},
        {"name": "cup", "x": 0.2, "y": 1, "width": 0.8, "height": 0},
        {"name": "cup", "x": 0, "y": 0.5, "width": 0.8, "height": 0.2},
        "object 2",
    ]


def test_a_region_is_said_in_words_and_shown_with_what_lies_around_it_inside_the_picture() -> None:
    found = run(
        "trial/region_view.js",
        """
        const low = { name: "block", match: 0.434, words: "18 px to the left", low: true };
        return [m.regionText(low), m.cropAround([0.4, 0.4, 0.2, 0.2]), m.cropAround([0, 0.9, 0.2, 0.1])];
        """,
    )
    assert found[0] == "block: 0.43 !, 18 px to the left"
    assert np.allclose(found[1:], [[0.3, 0.3, 0.4, 0.4], [0, 0.85, 0.3, 0.15]])
