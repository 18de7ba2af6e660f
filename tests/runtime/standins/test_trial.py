"""One trial in a process of its own: what it records depends on its orders alone."""

from __future__ import annotations

import io
import json
from pathlib import Path
from typing import Any

import pytest

from runtime.core.errors import SetupError
from runtime.recording.reader import open_episode
from runtime.standins import trial
from tests.runtime.lockstep_station import column
from tests.runtime.simulation.tabletop_station import DEPLOYMENTS

SERVED = "openpi --robot agilex_piper --port 0"


def orders(seed: int, seconds: float = 2.0) -> dict[str, Any]:
    return {
        "setup": {
            "task": "put the block on the plate",
            "policy": {"kind": "openpi", "delay_ms": 80},
            "bench": {"id": f"b{seed}", "seed": seed, "positions": None},
        },
        "run": {"mode": "continuous", "duration_s": seconds, "trial": {}},
    }


def options(tmp_path, *more):
    own = ("--set", f'data_dir="{tmp_path}"', "--set", "recording.min_free_bytes=0", "--serve", SERVED)
    size = ("--width", "64", "--height", "48")
    return trial.parser().parse_args([str(DEPLOYMENTS / "tabletop.toml"), *own, *size, *more])


def test_what_it_records_depends_on_its_orders_alone(tmp_path):
    def made(name, seed):
        done = trial.run_trial(options(tmp_path / name), orders(seed))
        assert (done.episode["status"], done.reason) == ("finished", "the run's 2 s are over")
        assert [event["kind"] for event in done.events][-2:] == ["truth", "episode_closed"]
        return open_episode(Path(done.episode["path"]))

    alone, other, after = made("alone", 7), made("other", 8), made("after", 7)
    for name in alone.rows.column_names:
        assert (column(alone.rows, name) == column(after.rows, name)).all(), name
    assert [episode.manifest["bench"]["seed"] for episode in (alone, other)] == [7, 8]
    laid = [_truth(episode)["plate"] for episode in (alone, other, after)]
    assert laid[0] == laid[2] != laid[1]


def _truth(episode):
    return next(event["data"] for event in episode.events if event["kind"] == "truth")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "the orders are not JSON"),
        ("[1]", "allowed: an object with setup and run"),
        ('{"halt": {}}', "orders.halt = {}; allowed: setup and run"),
        ('{"run": 3}', "orders.run = 3; allowed: setup and run, each an object"),
    ],
)
def test_orders_that_cannot_be_read_are_named(text, words):
    with pytest.raises(SetupError) as refused:
        trial.read_orders(text)
    assert words in str(refused.value)


def test_a_trial_that_cannot_be_set_up_says_why_and_prints_no_result(tmp_path, monkeypatch, capsys):
    refused = orders(7)
    refused["setup"]["bench"]["positions"] = {"block": [9.0, 9.0, 0.0], "plate": [0.4, 0.0]}
    monkeypatch.setattr("sys.stdin", io.StringIO(json.dumps(refused)))
    own = ("--set", f'data_dir="{tmp_path}"', "--serve", SERVED, "--width", "64", "--height", "48")
    assert trial.main([str(DEPLOYMENTS / "tabletop.toml"), *own]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert "block" in err
