"""Stations of a lab as it starts them: a deployment file, and what is set on top of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from django.conf import settings

from evaweb.lab import programs
from evaweb.lab.processes import LabError, ProgramSpec
from evaweb.lab.seed import station_registered
from runtime.config.loader import ConfigurationError, load


@dataclass(frozen=True, slots=True)
class Bench:
    """One station of this lab: its deployment file and what is set on top of it; one that `runs` is started already."""

    deployment: Path
    assignments: Sequence[str] = ()
    runs: bool = False


def registered(bench: Bench) -> str:
    """The name of a bench's station, which the database has from now on; LabError says what is wrong with its file."""
    try:
        deployment = load(bench.deployment, bench.assignments).deployment
    except ConfigurationError as fault:
        raise LabError(str(fault)) from None
    station = station_registered(
        name=deployment.station,
        robot=deployment.robot,
        deployment=str(bench.deployment),
        simulated=bool(getattr(deployment.transport, "simulated", False)),
    )
    return station.name


def program_of(bench: Bench) -> ProgramSpec:
    """The runtime of a bench's station."""
    assignments = [f'data_dir="{settings.DATA_DIR}"', *bench.assignments]
    return programs.station(str(bench.deployment), assignments)
