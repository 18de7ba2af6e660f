"""How the latency benchmark reads a recording."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pyarrow as pa
import pytest

from benchmarks.latency import _from, _percentiles


def episode() -> Any:
    """Ticks every 10 ms from 1000 s on; the policy's, but held from the third to the fifth and from the eighth on."""
    sources = ["policy", "policy", "hold", "hold", "hold", "policy", "policy", "hold"]
    ticks = pa.table({"sent": [n / 100 for n in range(8)], "control_source": sources})
    camera = {"p50": 30.0, "p99": 40.0, "max": 41.0}
    outcome = {
        "muxed_ms": {"front": camera, "wrist": {**camera, "p99": 44.0}},
        "policy": {"observation_age_ms": {"p50": 5.0, "p90": 6.0, "p99": 7.0, "max": 8.0}},
    }
    return SimpleNamespace(ticks=ticks, outcome=outcome, manifest={"started_monotonic": 1000.0})


def test_a_press_reaches_the_node_with_the_first_command_that_is_not_the_policys() -> None:
    found = _from(episode(), [1000.012, 1000.055], 0.0)
    assert found["node_ms"] == pytest.approx([8.0, 15.0])


def test_what_counts_from_the_nodes_stamp_has_the_shortest_way_added_and_the_slowest_camera_counts() -> None:
    found = _from(episode(), [1000.0], 0.002)
    assert found["muxed_ms"] == {"p50": 32.0, "p99": 46.0, "max": 43.0}
    assert found["observation_ms"]["p99"] == pytest.approx(9.0)


def test_percentiles_are_computed_or_taken_as_they_were_recorded() -> None:
    assert _percentiles("a_ms", {"p99": 3.0}) == [("a_ms.p99", 3.0)]
    assert _percentiles("b_ms", [1.0, 2.0, 3.0])[0] == ("b_ms.p50", 2.0)
