"""The benchmark of the e-stop: how presses are judged, and that each attack is one on a lab that can be pressed."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import pytest

from benchmarks import estop
from benchmarks.attacks.__main__ import ATTACKS
from benchmarks.estop_presses import PATIENCE_S, Press
from benchmarks.estop_station import Station

SHARE = 0.02


def test_what_was_not_done_counts_as_all_of_the_patience() -> None:
    presses = [Press("done", "", 20.0), Press("failed", "control is away", 60.0), Press("", "no answer", 0.0)]
    found = estop.summarize_presses(presses, lost=1)
    assert found["max_ms"] == PATIENCE_S * 1000.0
    assert (found["presses"], found["failed"], found["unanswered"], found["lost"]) == (3, 1, 1, 1)
    assert found["undone"] == ["failed: control is away", "unanswered: no answer"]


def test_figures_say_what_is_wanted_of_an_attack() -> None:
    found = estop.summarize_presses([Press("done", "", 20.0)], lost=0)
    slow = estop.summarize_presses([Press("done", "", 900.0)], lost=0)
    row = {"attack": "logins", "interrupted": "", "recovery_s": 0.1, **dict.fromkeys(estop.WAYS, slow)}
    row |= {"main_late_ms": 3.0, "web_growth_mb": 1.0, "station_growth_mb": 0.0}
    figures = {figure.name: figure.holds for figure in estop.figures(row)}
    assert figures["estop_p99_ms.logins"] is False
    assert figures["rest_p99_ms.logins"] is None
    assert figures["socket_p99_ms.logins"] is None
    assert figures["estop_lost.logins"] is True
    assert figures["run_interrupted.logins"] is True
    assert {figure.name: figure.holds for figure in estop.figures(row | {"estop": found})}[
        "estop_p99_ms.logins"
    ]
    assert {figure.name: figure.holds for figure in estop.figures(row | {"interrupted": "it holds"})}[
        "run_interrupted.logins"
    ] is False


def test_every_attack_that_is_measured_has_a_program() -> None:
    assert set(estop.ATTACKS) == {"none", *ATTACKS}


@pytest.mark.parametrize(
    ("events", "interruption"),
    [
        ([], ""),
        (
            [
                ("command", "renewed"),
                ("state", "running -> faulted: e-stop by x: make safe"),
                ("state", "faulted -> idle"),
            ],
            "",
        ),
        (
            [("state", "running -> holding: no sign of life"), ("state", "holding -> faulted: e-stop by x")],
            "no sign",
        ),
        (
            [("family_died", "the process coordinator died"), ("state", "running -> faulted: e-stop by x")],
            "coordinator died",
        ),
    ],
)
def test_a_run_is_interrupted_by_what_ended_it_before_the_first_press(
    tmp_path: Path, events: list[tuple[str, str]], interruption: str
) -> None:
    station = Station(tmp_path)
    told = [{"kind": kind, "text": text} for kind, text in events]
    station.client = SimpleNamespace(status=dict, events_since=lambda number: told)  # type: ignore[assignment]
    assert interruption in station.interruption()
    assert bool(interruption) == bool(station.interruption())


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Iterator[estop.Bench]:
    with estop.bench(tmp_path_factory.mktemp("estop")) as found:
        yield found


@pytest.mark.lab
@pytest.mark.slow
@pytest.mark.parametrize("attack", estop.ATTACKS)
def test_presses_beside_a_small_attack_arrive_and_are_done(lab: estop.Bench, attack: str) -> None:
    row = estop.measure_attack(lab, attack, seconds=0.0, share=SHARE, moving=attack == "none")
    for way in estop.WAYS:
        found = row[way]
        assert (found["lost"], found["unanswered"]) == (0, 0), found["undone"]
        assert found["failed"] < found["presses"], found["undone"]
    assert row["recovered"]
