"""Contents of a bundle: versions, machine, settings, deployments, stations, jobs, database.

All parts respect the reader's visibility; logs are included only if nothing is hidden from the reader.
"""

from __future__ import annotations

import os
import platform
import time
from collections.abc import Iterator, Mapping
from dataclasses import asdict
from importlib.metadata import distributions
from pathlib import Path
from typing import Any

from django.apps import apps
from django.conf import settings
from django.db import connection
from django.db.migrations.executor import MigrationExecutor
from django.utils import timezone

from evaweb.blinding.visibility import HIDDEN, Visibility
from evaweb.core.binary_frames import to_json_value
from evaweb.core.errors import StationGone
from evaweb.jobs.models import Job
from evaweb.lab import deployments, machine_check
from evaweb.stations import redaction
from evaweb.stations.models import Command, Station
from evaweb.stations.runtime_client import connection_to
from runtime.config.loader import ConfigurationError, tree_of
from runtime.core.git_revision import revision

_ASK_S = 2.0
_COMMANDS, _JOBS = 200, 100  # newest rows
# Environment variables with values in the bundle; of all others only the names.
_SHOWN = (
    *(
        "EVA_DATA_DIR",
        "EVA_ROBOTS",
        "EVA_ROBOT_MESHES",
        "EVA_ALLOWED_HOSTS",
        "EVA_TRUSTED_ORIGINS",
        "EVA_HTTPS",
    ),
    *(
        "EVA_HSTS_S",
        "EVA_GATE",
        "EVA_GATE_NAME",
        "EVA_PROXIES",
        "EVA_TIME_ZONE",
        "EVA_LOG_LEVEL",
        "EVA_COMMAND_TIMEOUT_S",
        "EVA_JOB_STALE_S",
    ),
    *(
        "EVA_WORKER_GRACE_S",
        "EVA_WORKER_NICE",
        "EVA_COPIES",
        "EVA_DEBUG",
        "EVA_HUB_LAB_ACCOUNT",
        "TZ",
        "LANG",
        "XDG_RUNTIME_DIR",
    ),
)


def versions() -> dict[str, Any]:
    """Return the versions of program, Python, kernel and packages."""
    release = Path("/etc/os-release")
    lines = release.read_text("utf-8").splitlines() if release.is_file() else []
    system = next(
        (line.partition("=")[2].strip('"') for line in lines if line.startswith("PRETTY_NAME=")), ""
    )
    return {
        "revision": dict(revision()) or "no checkout of git",
        "python": platform.python_version(),
        "kernel": " ".join((platform.system(), platform.release(), platform.machine())),
        "system": system,
        "packages": dict(sorted({package.name: package.version for package in distributions()}.items())),
    }


def machine() -> list[dict[str, Any]]:
    """Return the current results of the machine check."""
    return [asdict(line) for line in machine_check.lines()]


def lab_settings() -> dict[str, Any]:
    """Return the settings of the lab that a diagnostic bundle may contain.

    Of the environment variables, only those on the allow list are given with their values; of the lab's other variables
    that are set, only the names are given.
    """
    names = sorted(
        name for name in os.environ if name.startswith("EVA_") or name in ("DATABASE_URL", "REDIS_URL")
    )
    return {
        "environment": {name: os.environ[name] for name in _SHOWN if name in os.environ},
        "set_and_not_shown": [name for name in names if name not in _SHOWN],
        "database": settings.DATABASES["default"]["ENGINE"].rpartition(".")[2],
        "time_zone": settings.TIME_ZONE,
        "now": timezone.localtime().isoformat(),
    }


def database() -> dict[str, Any]:
    """Return the unapplied migrations, and the number of rows of each table."""
    executor = MigrationExecutor(connection)
    plan = executor.migration_plan(executor.loader.graph.leaf_nodes())
    models = [model for model in apps.get_models() if model.__module__.startswith("evaweb.")]
    return {
        "migrations_to_apply": [f"{migration.app_label}.{migration.name}" for migration, _ in plan],
        "migrations_applied": sorted(".".join(key) for key in executor.loader.applied_migrations),
        "rows": {model._meta.label: model.objects.count() for model in models},
    }


def jobs(sight: Visibility) -> list[dict[str, Any]]:
    """Return the newest jobs; details that may reveal a checkpoint are hidden from blind readers."""
    names = ("id", "kind", "key", "queue", "status", "attempts", "deaths", "progress", "error")
    rows = []
    for job in Job.objects.order_by("-created_at", "-pk")[:_JOBS]:
        row = {name: getattr(job, name) for name in names} | {"result": job.result}
        if not sight.hides_nothing:
            row |= {name: HIDDEN if row[name] else "" for name in ("progress", "error")} | {"result": {}}
        times = {name: getattr(job, name) for name in ("created_at", "claimed_at", "finished_at")}
        rows.append(row | {name: at and at.isoformat() for name, at in times.items()})
    return rows


def deployment_files(sight: Visibility) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield name and content of each deployment of a station or of the data folder, without comments."""
    paths = {stored.name: stored.path for stored in deployments.stored_deployments()}
    for station in Station.objects.exclude(deployment=""):
        paths.setdefault(station.name, Path(station.deployment))
    for name, path in sorted(paths.items()):
        try:
            tree = tree_of(path)
        except ConfigurationError as fault:
            tree = {"unreadable": str(fault)}
        if not sight.hides_nothing and "policy" in tree:
            tree["policy"] = HIDDEN
        yield name, tree


def station_parts(station: Station, sight: Visibility) -> Iterator[tuple[str, Any]]:
    """Yield (part, content) of a station: current state, newest events, newest commands."""
    wire = connection_to(station.name)
    about = {name: getattr(station, name) for name in ("name", "robot", "simulated", "active", "message")}
    try:
        snapshot: Mapping[str, Any] = wire.status(timeout=_ASK_S)
        _, events = wire.events_since(0, timeout=_ASK_S)
    except StationGone as gone:
        yield "state", {"station": about, "gone": str(gone)}
    else:
        veiled = not sight.hides_nothing and (
            sight.redacts_snapshot(station.name, snapshot) or sight.redacts_events(station.name)
        )
        yield (
            "state",
            {"station": about, "snapshot": redaction.redact_state(snapshot, sight) if veiled else snapshot},
        )
        yield "events", redaction.redact_events(events, sight) if veiled else events
    yield "commands", [_command(row, sight) for row in station.commands.select_related("user")[:_COMMANDS]]


def logs() -> list[Path]:
    """Return the logs of this lab's programs, newest first."""
    files = [path for path in (Path(settings.DATA_DIR) / "logs").glob("*.log*") if path.is_file()]
    return sorted(files, key=lambda path: path.stat().st_mtime, reverse=True)


def programs(sight: Visibility) -> list[dict[str, Any]]:
    """Return whether the lab runs and, for each program with a log, the time since the log's last line [s].

    If anything is hidden from the reader, the programs are omitted: the policy whose log has the newest line would
    reveal the checkpoint.
    """
    now = time.time()
    rows: list[dict[str, Any]] = [{"program": "lab", "runs": deployments.lab_runs()}]
    files = logs() if sight.hides_nothing else []
    return rows + [{"program": path.stem, "silent_s": round(now - path.stat().st_mtime, 1)} for path in files]


def _command(row: Command, visibility: Visibility) -> dict[str, Any]:
    hidden = not visibility.hides_nothing and visibility.redacts_events(row.station.name)
    return {
        "at": row.issued_at.isoformat(),
        "kind": row.kind,
        "user": row.user.get_username() if row.user else "",
        "status": row.status,
        "reason": visibility.redact_text(row.reason) if hidden else row.reason,
        "args": {} if hidden else to_json_value(row.args),
    }
