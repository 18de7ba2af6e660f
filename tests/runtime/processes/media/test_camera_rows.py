from __future__ import annotations

from itertools import pairwise

from hypothesis import given, settings
from hypothesis import strategies as st

from runtime.ipc.messages import Event
from runtime.processes.media.camera_rows import QUIET_S, DropoutLog
from tests.examples import some

RATE = 10.0  # rows per second


def played(silent: list[bool], camera: str = "cam") -> tuple[list[Event], list[Event]]:
    """What is said of a camera that is silent in these rows, and at the end."""
    silences = DropoutLog([camera])
    events: list[Event] = []
    for row, here in enumerate(silent):
        events += silences.update(row / RATE, row, {camera: 0.6} if here else {})
    return events, silences.flush(len(silent) / RATE)


def rows(*stretches: tuple[bool, float]) -> list[bool]:
    return [silent for silent, seconds in stretches for _ in range(round(seconds * RATE))]


def test_one_silence_is_said_when_it_begins_and_when_it_ends() -> None:
    events, rest = played(rows((False, 1), (True, 9), (False, 1)))
    assert [(event.kind, event.time, event.data) for event in events] == [
        ("pictures_stopped", 1.0, {"camera": "cam", "row": 10}),
        ("pictures_back", 10.0, {"camera": "cam", "row": 100}),
    ]
    assert (
        events[0].text == "camera cam has given no new picture for 0.6 s: rows from 10 on repeat its last one"
    )
    assert rest == []


def test_many_silences_are_one_pair_and_a_number() -> None:
    flutter = rows(*[(True, 0.1), (False, 0.1)] * 24)  # until 4.8 s: one said, 23 counted
    events, rest = played([*flutter, *rows((False, 2))])
    assert [(event.kind, event.time) for event in events] == [
        ("pictures_stopped", 0.0),
        ("pictures_back", 0.1),
        ("pictures_back", 5.0),
    ]
    assert events[2].text == (
        "camera cam gives pictures again, from row 47 on; it stopped 23 more times since row 2"
    )
    assert events[2].data == {"camera": "cam", "row": 47, "more": 23, "since_row": 2}
    assert rest == []


def test_a_silence_that_began_among_others_and_lasts_is_said_with_its_own_row() -> None:
    events, _ = played(rows((True, 0.1), (False, 0.9), (True, 0.2), (False, 0.8), (True, 9)))
    assert [(event.kind, event.time, event.data) for event in events] == [
        ("pictures_stopped", 0.0, {"camera": "cam", "row": 0}),
        ("pictures_back", 0.1, {"camera": "cam", "row": 1}),
        ("pictures_stopped", 5.0, {"camera": "cam", "row": 20, "more": 1, "since_row": 10}),
    ]
    assert "1 more time since row 10" in events[2].text


def test_what_was_counted_is_said_at_the_end_of_the_episode() -> None:
    events, rest = played(rows((True, 0.1), (False, 0.1), (True, 0.1), (False, 0.1), (True, 0.1)))
    assert len(events) == 2
    (last,) = rest
    assert (last.kind, last.data) == (
        "pictures_stopped",
        {"camera": "cam", "row": 4, "more": 1, "since_row": 2},
    )


def test_each_camera_has_a_quiet_time_of_its_own() -> None:
    silences = DropoutLog(["wrist", "high"])
    assert [event.data["camera"] for event in silences.update(0.0, 0, {"wrist": 1.0})] == ["wrist"]
    assert [event.data["camera"] for event in silences.update(1.0, 1, {"wrist": 2.0, "high": 1.0})] == [
        "high"
    ]


@settings(max_examples=some(200))
@given(st.lists(st.tuples(st.booleans(), st.integers(1, 40)), min_size=1, max_size=60))
def test_whatever_the_camera_does_little_is_said_and_every_silence_is_counted_once(
    stretches: list[tuple[bool, int]],
) -> None:
    silent = [here for here, count in stretches for _ in range(count)]
    events, rest = played(silent)
    begun = sum(here and not before for before, here in pairwise([False, *silent]))
    told = [*events, *rest]
    assert begun == sum((event.kind == "pictures_stopped") + int(event.data.get("more", 0)) for event in told)
    stops = [event.time for event in events if event.kind == "pictures_stopped"]
    assert all(later - earlier >= QUIET_S for earlier, later in pairwise(stops))
    assert len(events) <= 2 * (len(silent) / RATE / QUIET_S + 1)
    for event in told:
        row = event.data["row"]
        assert silent[row] is (event.kind == "pictures_stopped")
        assert row == 0 or silent[row - 1] is not silent[row]
