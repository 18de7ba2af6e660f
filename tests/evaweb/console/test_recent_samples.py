"""Every sample reaches a page that draws fewer frames than samples come."""

from __future__ import annotations

import numpy as np

from evaweb.console import frame_parts
from evaweb.console.recent_samples import SAMPLES, RecentSamples
from evaweb.core.binary_frames import decode

NOTHING = np.full(3, np.nan, np.float32)


def row(value):
    return np.full(3, value, np.float32)


def sampled(count, dim=3, recent=None, **words):
    """The stream after `count` samples: sample k is measured at k, one second after the one before."""
    recent = recent or RecentSamples()
    for number in range(count):
        vectors = {
            "measured": np.full(dim, number, np.float32),
            "commanded": np.full(dim, -number, np.float32),
        }
        made = recent.add_sample(vectors, {"step": number, **words}, float(number))
    return decode(frame_parts.build_frame([made], 1, 0.0))


def one(vectors, **words):
    made = RecentSamples().add_sample({"measured": row(1), "commanded": row(2)} | vectors, words, 0.0)
    return decode(frame_parts.build_frame([made], 1, 0.0))


def facts(frame):
    return frame.header["streams"]["recent"]["json"]


def test_the_newest_samples_stand_in_columns_the_oldest_first():
    frame = sampled(SAMPLES + 5)
    numbers = list(range(5, SAMPLES + 5))
    assert facts(frame)["t"] == facts(frame)["step"] == numbers
    assert frame.array("recent", "measured")[:, 2].tolist() == numbers


def test_two_parts_in_a_row_leave_no_sample_out():
    recent = RecentSamples()
    first = sampled(SAMPLES, recent=recent)
    second = sampled(SAMPLES - 1, recent=recent)
    steps = facts(first)["step"] + facts(second)["step"][1:]
    assert steps == [*range(SAMPLES), *range(SAMPLES - 1)]


def test_chunk_boundaries_and_what_safety_did_stand_beside_their_samples():
    frame = sampled(2, chunk=7, chunks=2, limited=True)
    assert facts(frame) == {
        "t": [0.0, 1.0],
        "step": [0, 1],
        "chunk": [7, 7],
        "chunks": [2, 2],
        "limited": [True, True],
        "simulated": [False, False],
    }


def test_a_runtime_that_says_nothing_of_chunks_has_none():
    found = facts(sampled(1))
    assert (found["chunk"], found["chunks"], found["limited"]) == ([-1], [0], [False])


def test_executed_is_what_was_sent_and_nothing_where_nothing_was():
    assert one({}, engaged=True).array("recent", "executed").tolist() == [[2, 2, 2]]
    assert np.isnan(one({}, engaged=False).array("recent", "executed")).all()


def test_in_simulation_executed_is_the_simulated_robot_whatever_the_real_one_is_sent():
    frame = one({"simulated": row(3)}, engaged=True)
    assert frame.array("recent", "executed").tolist() == [[3, 3, 3]]
    assert facts(frame)["simulated"] == [True]
    assert one({"simulated": NOTHING}, engaged=True).array("recent", "executed").tolist() == [[2, 2, 2]]


def test_raw_and_planned_are_missing_where_they_were_not_said():
    frame = one({"planned": row(5)})
    assert frame.array("recent", "planned").tolist() == [[5, 5, 5]]
    assert np.isnan(frame.array("recent", "raw")).all()


def test_another_robot_begins_anew():
    recent = RecentSamples()
    sampled(4, recent=recent)
    frame = sampled(2, dim=5, recent=recent)
    assert frame.array("recent", "measured").shape == (2, 5)
