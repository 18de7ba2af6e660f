"""Stations that a lab starts: deployment file and overrides."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from django.conf import settings

from evaweb.lab import programs
from evaweb.lab.demo_rows import station_registered
from evaweb.lab.processes import LabError, ProgramSpec
from evaweb.plans import copies
from runtime.config.loader import ConfigurationError, load


@dataclass(frozen=True, slots=True)
class Bench:
    """Station of this lab: its deployment file, and assignments that override values in it.

    If `runs` is set, the station is running already. `options` are those of a simulated bench in benchmark mode, which
    runs in the station's process.
    """

    deployment: Path
    assignments: Sequence[str] = ()
    runs: bool = False
    options: Sequence[str] = ()


def registered(bench: Bench) -> str:
    """Register the station of a bench in the database, and return its name.

    Raises:
        LabError: If its deployment file is not valid.
    """
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
    """Return the program of a bench's runtime.

    In benchmark mode that is a station in lockstep, no faster than life for people who watch; copies of it may carry
    out trials.
    """
    assignments = [f'data_dir="{settings.DATA_DIR}"', *bench.assignments]
    deployment = load(bench.deployment, bench.assignments).deployment
    if not deployment.lockstep.benchmark:
        return programs.station(str(bench.deployment), assignments)
    path, options = str(bench.deployment), tuple(bench.options)
    copies.write_copies(deployment.station, copies.Copies(path, assignments, options, {}))
    return programs.lockstep(path, assignments, deployment.robot, {}, (*options, "--paced"))
