"""A station in benchmark mode is one process with its bench, and has copies."""

from __future__ import annotations

from pathlib import Path

import pytest
from django.conf import settings

from evaweb.lab.benches import Bench, program_of, registered
from evaweb.plans.copies import copies_of
from evaweb.stations.models import Station

DEPLOYMENTS = settings.BASE_DIR / "deployments"


@pytest.mark.django_db
def test_a_station_in_benchmark_mode_runs_in_lockstep_and_its_copies_are_started_like_it(
    settings: object, tmp_path: Path
) -> None:
    settings.DATA_DIR = tmp_path  # type: ignore[attr-defined]
    bench = Bench(DEPLOYMENTS / "metaworld.toml", ['policy.url="ws://127.0.0.1:1"'], options=("--seed", "1"))
    station = Station.objects.get(name=registered(bench))
    assert (station.robot, station.simulated) == ("metaworld", True)
    program = program_of(bench)
    assert program.arguments[:3] == ("-m", "runtime.standins.lockstep", str(bench.deployment))
    assert program.arguments[-3:] == ("--seed", "1", "--paced")
    copied = copies_of(station)
    assert (copied.deployment, copied.options, copied.servers) == (str(bench.deployment), ["--seed", "1"], {})
    assert 'policy.url="ws://127.0.0.1:1"' in copied.assignments
    other = program_of(Bench(DEPLOYMENTS / "tabletop.toml"))
    assert other.arguments[:2] == ("-m", "runtime")
