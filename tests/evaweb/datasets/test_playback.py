"""What the replay's modules compute, run by Node: the clock's range, addresses, episodes on one time axis."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.evaweb.console import test_modules
from tests.examples import some

run = test_modules.run
pytestmark = pytest.mark.skipif(test_modules.NODE is None, reason="Node is not installed")
CLOCK, LINK, ALIGNED = "../replay/clock.js", "../replay/url_state.js", "../replay/aligned.js"
BY_HAND = """
let now = 0;
let next = null;
globalThis.performance = { now: () => now };
globalThis.requestAnimationFrame = (call) => (next = call);
const go = (ms) => { now += ms; const call = next; next = null; call?.(now); };
"""


def test_no_rounding_shows_the_row_after_the_end_of_a_loop() -> None:
    """Browsers tell frames in tenths of a millisecond: their sums come to 3.9999999 where a range ends at 4."""
    found = run(
        CLOCK,
        BY_HAND
        + """
        const clock = new m.Clock({ fps: 10, frames: 100 });
        clock.rate = 2;
        clock.loop = true;
        const seen = new Set();
        for (const step of [10, 12.5, 16.6, 16.7, 20, 0.7]) {
            for (const from of [20, 21, 31]) {
                clock.narrow({ from, to: 40 });
                clock.seekRow(from);
                clock.play();
                for (let k = 0; k < 2000; k += 1) { go(step); seen.add(clock.row); }
                clock.pause();
            }
        }
        return { least: Math.min(...seen), most: Math.max(...seen) };
        """,
    )
    assert found == {"least": 20, "most": 39}


def test_a_range_ends_at_its_last_row_and_a_loop_begins_it_again() -> None:
    found = run(
        CLOCK,
        BY_HAND
        + """
        const clock = new m.Clock({ fps: 10, frames: 100 });
        clock.narrow({ from: 20, to: 25 });
        clock.play();
        const rows = [clock.row];
        for (let k = 0; k < 6; k += 1) { go(100); rows.push(clock.row); }
        const stopped = { row: clock.row, playing: clock.playing };
        clock.loop = true;
        clock.play();
        const looped = [clock.row];
        for (let k = 0; k < 8; k += 1) { go(100); looped.push(clock.row); }
        clock.narrow(null);
        return { rows, stopped, looped, all: clock.range, narrowed: clock.narrowed };
        """,
    )
    assert found["rows"] == [20, 21, 22, 23, 24, 24, 24]
    assert found["stopped"] == {"row": 24, "playing": False}
    assert found["looped"] == [20, 21, 22, 23, 24, 20, 21, 22, 23]
    assert (found["all"], found["narrowed"]) == ({"from": 0, "to": 100}, False)


def test_a_clock_waits_for_everybody_who_asks_it_to() -> None:
    found = run(
        CLOCK,
        BY_HAND
        + """
        const clock = new m.Clock({ fps: 10, frames: 100 });
        const ready = [true, false];
        ready.forEach((_, index) => clock.waitFor(() => ready[index]));
        clock.play();
        go(100);
        const waited = clock.row;
        ready[1] = true;
        go(100);
        return [waited, clock.row];
        """,
    )
    assert found == [0, 1]


def test_one_of_several_episodes_rests_before_it_begins_and_after_its_end() -> None:
    found = run(
        CLOCK,
        """
        const clock = new m.Clock({ fps: 10, frames: 100 });
        const late = new m.Shifted(clock, { fps: 10, frames: 30 }, 2);
        const at = (row) => { clock.seekRow(row); return [late.row, late.resting]; };
        late.waitFor(() => false);
        const seen = [at(0), at(20), at(35), at(49), at(60)];
        late.seekRow(4);
        return { seen, shared: clock.row };
        """,
    )
    assert found["seen"] == [[0, True], [0, False], [15, False], [29, False], [29, True]]
    assert found["shared"] == 24


@given(
    row=st.integers(0, 2000),
    first=st.integers(0, 1000),
    length=st.integers(1, 500),
    fps=st.sampled_from([10, 15, 25, 30, 29.97, 50, 60]),
    narrowed=st.booleans(),
    loop=st.booleans(),
    speed=st.sampled_from([0.1, 0.25, 0.5, 1, 2, 4]),
)
@settings(max_examples=some(15))
def test_an_address_brings_back_what_it_was_written_for(
    row: int, first: int, length: int, fps: float, narrowed: bool, loop: bool, speed: float
) -> None:
    state = {
        "row": row,
        "range": {"from": first, "to": first + length} if narrowed else None,
        "loop": loop,
        "speed": speed,
    }
    search, back = run(
        LINK,
        "const search = m.toSearch('?robot=ur5e&t=9', given[0], given[1]);"
        "return [search, m.parseSearch(search, given[1])];",
        [state, fps],
    )
    assert search.startswith("?robot=ur5e")
    assert back == state | {"row": row or None, "speed": None if speed == 1 else speed}


@pytest.mark.parametrize(
    ("search", "expected"),
    [
        ("", {"row": None, "range": None, "loop": False, "speed": None}),
        ("?t=x&from=1&speed=", {"row": None, "range": None, "loop": False, "speed": None}),
        ("?t=-4&from=3&to=1", {"row": 0, "range": None, "loop": False, "speed": None}),
        (
            "?from=1&to=2.5&loop=1",
            {"row": None, "range": {"from": 10, "to": 25}, "loop": True, "speed": None},
        ),
    ],
)
def test_an_address_that_says_nothing_of_use_changes_nothing(
    search: str, expected: dict[str, object]
) -> None:
    assert run(LINK, "return m.parseSearch(given, 10);", search) == expected


def test_what_is_drawn_waits_for_pictures_and_for_none_that_never_come() -> None:
    found = run(
        "../replay/cameras.js",
        """
        globalThis.HTMLMediaElement = { HAVE_CURRENT_DATA: 2 };
        const video = (more) => ({ tagName: "VIDEO", error: null, readyState: 0, seeking: false, ...more });
        const waits = async (all, change) => {
          let over = false;
          const coming = m.firstPictures({ querySelectorAll: () => all }).then(() => (over = true));
          await new Promise((go) => setTimeout(go, 50));
          const before = over;
          change();
          await coming;
          return before;
        };
        const late = video({});
        const seeking = video({ readyState: 4, seeking: true });
        const image = { tagName: "IMG", complete: true, hasAttribute: () => false };
        return [
          await waits([video({ readyState: 2 }), video({ error: {} })], () => {}),
          await waits([video({ readyState: 2 }), late], () => (late.readyState = 2)),
          await waits([seeking], () => (seeking.seeking = false)),
          await waits([image], () => (image.hasAttribute = () => true)),
          await waits([], () => {}),
          await waits([video({})], () => {}),
        ];
        """,
    )
    assert found == [True, False, False, False, True, False]


@pytest.mark.some(4)
@pytest.mark.parametrize(
    ("camera", "row", "said"),
    [
        ("high", 19, ""),
        ("high", 20, "lost: the one before"),
        ("high", 22, "lost: the one before"),
        ("high", 23, ""),
        ("wrist", 21, ""),
        ("wrist", 30, "ended at row 30"),
        ("wrist", 99, "ended at row 30"),
        ("side", 0, "no video"),
        ("black", 5, ""),
    ],
)
def test_a_camera_that_shows_another_picture_than_the_rows_says_so(camera: str, row: int, said: str) -> None:
    flags = [
        {"kind": "lost", "stream": "high", "first": 20, "last": 22},
        {"kind": "video_lost", "stream": "wrist", "first": 30, "last": 99},
        {"kind": "video_lost", "stream": "side", "first": 0, "last": 99},
        {"kind": "black", "stream": "black", "first": 0, "last": 99},
    ]
    assert run("../replay/lost_frames.js", "return m.lostFrameText(...given);", [flags, camera, row]) == said


def test_episodes_begin_together_or_as_much_later_as_is_said() -> None:
    found = run(
        ALIGNED,
        """
        const episodes = [{ fps: 30, frames: 60 }, { fps: 10, frames: 30 }];
        return [null, "0,1.5", "-0.5,x"].map((said) => {
          const starts = m.startTimes(said, 2);
          return [starts.shifts, m.commonClock(episodes, starts)];
        });
        """,
    )
    assert found == [
        [[0, 0], {"fps": 30, "frames": 90}],
        [[0, 1.5], {"fps": 30, "frames": 135}],
        [[0, 0.5], {"fps": 30, "frames": 105}],
    ]


def test_curves_of_another_rate_and_start_lie_at_their_time_and_nowhere_else() -> None:
    found = run(
        ALIGNED,
        """
        const stored = {
          time: Float64Array.from([0, 0.2, 0.4]),
          measured: Float32Array.from([9, 9, 9, 1, 2, NaN]),
          executed: Float32Array.from([9, 9, 9, 4, 5, 6]),
        };
        const arrays = { time: "time", measured: "measured", executed: "executed" };
        const header = { joints: ["a", "b"], period: 0.2, streams: { ticks: { arrays } } };
        const episode = { header, shift: 0.1, numbers: (name) => stored[name] };
        const times = m.clockTimes({ fps: 10, frames: 9 });
        return [m.sampleAt(times, episode, "b"), m.sampleAt(times, episode, "none").state];
        """,
    )
    sampled, absent = found
    assert sampled["state"] == [None, 1, 1, 2, 2, None, None, None, None]
    assert sampled["executed"] == [None, 4, 4, 5, 5, 6, 6, 6, None]
    assert absent == [None] * 9


def test_the_joint_that_is_shown_first_is_the_one_that_differs_most() -> None:
    found = run(
        ALIGNED,
        """
        const arrays = { time: "time", measured: "measured", executed: "executed" };
        const header = { joints: ["a", "b", "c"], period: 0.1, streams: { ticks: { arrays } } };
        const episode = (...states) => {
          const measured = Float32Array.from(states.flat());
          const stored = { time: Float64Array.from([0, 0.1]), measured, executed: new Float32Array(6) };
          return { header, shift: 0, numbers: (name) => stored[name] };
        };
        const one = episode([0, 9], [1, 1], [0, NaN]);
        const other = episode([0, 9], [1, 3], [NaN, 50]);
        const times = m.clockTimes({ fps: 10, frames: 2 });
        return [m.differing(times, [one, other], ["a", "b", "c"]), m.differing(times, [one, one], ["a", "b", "c"])];
        """,
    )
    assert found == [1, 0]
