"""Marked frames become runs, however they come in blocks."""

import itertools

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from runtime.quality.report import Flag, FlagCollector, FrameRun, RunCollector


def runs_of(marked, values, cuts, apart):
    found = []
    runs = RunCollector(found.append, apart)
    edges = [0, *sorted({cut % (len(marked) + 1) for cut in cuts}), len(marked)]
    for first, end in itertools.pairwise(edges):
        runs.add(first, np.array(marked[first:end], bool), np.array(values[first:end], float))
    runs.close()
    return found


def plainly(marked, values, apart):
    """The same, frame by frame."""
    found = []
    for frame, one in enumerate(marked):
        if not one:
            continue
        if found and frame - found[-1][-1] <= apart + 1:
            found[-1].append(frame)
        else:
            found.append([frame])
    told = []
    for frames in found:
        worst = max(frames, key=lambda frame: (values[frame], -frame))
        told.append(FrameRun(frames[0], frames[-1], values[worst], worst))
    return told


FRAMES = st.lists(st.tuples(st.booleans(), st.integers(0, 5).map(float)), max_size=40)


@given(FRAMES, st.lists(st.integers(0, 1000), max_size=5), st.integers(0, 4))
def test_runs_are_the_same_in_whatever_blocks_frames_come(frames, cuts, apart):
    marked, values = [one for one, _ in frames], [value for _, value in frames]
    assert runs_of(marked, values, cuts, apart) == plainly(marked, values, apart)


def test_a_report_lists_some_flags_and_counts_all():
    flags = FlagCollector(3)
    for frame in range(10):
        flags.add(Flag("gap", "warning", 2 * frame, 2 * frame + 1, "tick_time", "a gap"))
    report = flags.report("it", 20, 30.0, {"skew": float("nan")})
    assert len(report.flags) == 3
    assert (report.counts["gap"].flags, report.counts["gap"].frames) == (10, 20)
    assert report.to_dict()["figures"] == {"skew": None}


def test_an_episode_with_remarks_alone_is_clean():
    flags = FlagCollector(3)
    flags.add(Flag("interrupted", "info", -1, -1, "", "it was interrupted"))
    assert flags.report("it", 1, 30.0, {}).clean
    flags.add(Flag("gap", "warning", 0, 0, "", "a gap"))
    report = flags.report("it", 1, 30.0, {})
    assert not report.clean
    assert report.worst == "warning"
