"""Deployment files of the data folder: written by the first-steps pages; simulated ones are started by the lab.

A file is DATA/deployments/STATION.toml. If it was created as a simulated station, the lab of this data folder starts
it with its bench and policies; any other is a draft that a person starts. The lab writes the status of a deployment to
STATION.json in the same folder.
"""

from __future__ import annotations

import fcntl
import json
import os
import re
import shlex
import subprocess
import sys
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from itertools import takewhile
from pathlib import Path
from typing import Any
from uuid import uuid4

from django.conf import settings
from django.db import transaction
from django.db.models import ProtectedError
from django.utils import timezone

import robots
from evaweb.core.errors import (
    Conflict,
    EvaError,
    NotFound,
    StationGone,
)
from evaweb.lab.processes import LabError
from evaweb.plans.models import Plan
from evaweb.stations.models import STATION_NAME, Station
from evaweb.stations.runtime_client import connection_to
from evaweb.stations.selectors import lease_open
from evaweb.trials import lifecycle
from evaweb.trials.models import Trial
from runtime.config import draft
from runtime.config.loader import ConfigurationError, Resolved, load, tree_of
from runtime.core.environment import without_web_secrets
from runtime.recording.files import write_atomic

_TABLETOP = settings.BASE_DIR / "deployments" / "tabletop.toml"
_BASE = settings.BASE_DIR / "deployments" / "base.toml"
_CHECK_S = 60.0
_CHOSEN = "A simulated bench: the lab of this data folder starts it, with its policies."
_ASK_S = 1.0  # timeout for a station that is to be removed
# Keys that no page may write, with the reason: they would make this machine run a program.
BY_HAND = {
    ("transport", "simulated"): "a simulated station is made with a choice of its own",
    ("transport", "python"): "another program is written into the file by hand",
    ("cameras", "python"): "another program is written into the file by hand",
}


@dataclass(frozen=True, slots=True)
class StoredDeployment:
    """Deployment file of the data folder, named after its station."""

    name: str
    path: Path

    @property
    def changed_ns(self) -> int:
        """Modification time of the file [ns], 0 if it was removed."""
        try:
            return self.path.stat().st_mtime_ns
        except FileNotFoundError:
            return 0

    @property
    def chosen(self) -> bool:
        """True if the file was created as a simulated station; the lab starts no other deployments.

        The mark is in the comments at the head of the file, where input from pages never goes.
        """
        try:
            lines = self.path.read_text("utf-8", "replace").split("\n")
        except OSError:
            return False
        return f"# {_CHOSEN}" in takewhile(lambda line: line.startswith("#"), lines)

    def resolved(self) -> Resolved:
        """Return the resolved deployment.

        Raises:
            LabError: If it is not valid.
        """
        try:
            return load(self.path)
        except ConfigurationError as fault:
            raise LabError(str(fault)) from None


@dataclass(frozen=True, slots=True)
class Standing:
    """Status of a deployment in this lab.

    Attributes:
        doing: What is being started at the moment, "" if nothing is.
        up: Whether the station is running.
        failed: Why the start failed, "" if it did not.
    """

    doing: str = ""
    up: bool = False
    failed: str = ""


def is_simulated(resolved: Resolved) -> bool:
    """Return True if the deployment's transport is a simulated node, which the lab starts as well."""
    transport = resolved.deployment.transport
    return transport.kind == "zmq" and bool(getattr(transport, "simulated", False))


def stored_deployments() -> list[StoredDeployment]:
    """Return all deployment files, oldest first."""
    rows = [StoredDeployment(path.stem, path) for path in _folder().glob("*.toml")]
    return sorted(
        (row for row in rows if re.fullmatch(STATION_NAME, row.name)), key=lambda row: row.changed_ns
    )


def stored_deployment(name: str) -> StoredDeployment | None:
    """Return the deployment file of a station, or None."""
    path = _folder() / f"{name}.toml"
    return StoredDeployment(name, path) if re.fullmatch(STATION_NAME, name) and path.is_file() else None


def write_simulated(*, name: str, robot: str) -> StoredDeployment:
    """Write the deployment of a simulated bench with that robot; the lab then starts it.

    Raises:
        EvaError: If the name or the robot is not allowed, or the name is taken.
    """
    if robot not in robots.robot_names():
        raise EvaError(f"robot = {robot!r:.60}; allowed: {', '.join(robots.robot_names())}")
    tree = {**tree_of(_TABLETOP), "station": name, "robot": robot}
    return _write(name, tree, _CHOSEN)


def write_draft(
    *, name: str, robot: str, task: str, parts: Mapping[str, Mapping[str, str]]
) -> StoredDeployment:
    """Write a draft for a real robot that the runtime can load.

    Args:
        name: Name of the station.
        robot: Name of the robot.
        task: Task of the deployment.
        parts: Typed values by table: transport, policy, and cameras.KEY.

    Raises:
        EvaError: If a value is not allowed, or the name is taken.
    """
    if robot not in robots.robot_names():
        raise EvaError(f"robot = {robot!r:.60}; allowed: {', '.join(robots.robot_names())}")
    tree = {**tree_of(_BASE), "station": name, "robot": robot, "task": task}
    try:
        for place, typed in parts.items():
            part, _, key = place.partition(".")
            _require_no_program(part, typed)
            table = draft.table(part, typed.get("kind", ""), typed)
            if key:
                tree.setdefault(part, {})[key] = table
            else:
                tree[part] = table
    except ConfigurationError as fault:
        raise EvaError(str(fault)) from None
    return _write(name, tree, f"Start it on the robot's computer: {command_of(_folder() / f'{name}.toml')}")


def cameras_exchanged(*, name: str, shown: Mapping[str, str]) -> None:
    """Rename the deployment's cameras so that each name fits the image.

    `shown` maps each camera's present name to the name that fits its image.

    Raises:
        EvaError: If a name is given to two images, or if a camera to be renamed gets its name from the robot's node
            instead of the deployment.
    """
    stored = stored_deployment(name)
    tree = tree_of(stored.path) if stored else {}
    own: dict[str, Any] = tree.get("cameras", {})
    if sorted(shown.values()) != sorted(shown):
        raise EvaError(f"each camera once: {', '.join(sorted(shown))}; given: {', '.join(shown.values())}")
    moved = {camera: right for camera, right in shown.items() if camera != right}
    foreign = sorted({*moved, *moved.values()} - set(own))
    if foreign or stored is None:
        raise EvaError(
            f"{', '.join(foreign or moved)}: the robot's own node names these pictures: exchange them there, then look "
            "again"
        )
    tree["cameras"] = own | {right: own[camera] for camera, right in moved.items()}
    about = "Its cameras were exchanged on the page of first steps."
    _put(stored.path, tree, *([_CHOSEN] if stored.chosen else []), about)


def command_of(path: Path) -> str:
    """Return the command that starts the station of a deployment file on this machine."""
    return shlex.join([sys.executable, "-m", "runtime", str(path), "--set", f"data_dir={settings.DATA_DIR}"])


def faults_of(path: Path) -> str:
    """Return the errors that the runtime's own check finds in a deployment, "" if it would start."""
    try:
        completed = subprocess.run(
            [
                sys.executable,
                "-m",
                "runtime",
                str(path),
                "--check",
                "--set",
                f'data_dir="{settings.DATA_DIR}"',
            ],
            cwd=settings.BASE_DIR,
            env=without_web_secrets(os.environ),
            capture_output=True,
            text=True,
            timeout=_CHECK_S,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return f"the check of {path.name} was not done within {_CHECK_S:g} s: check it with {command_of(path)} --check"
    return "" if completed.returncode == 0 else completed.stderr.strip()


def lab_runs() -> bool:
    """Return True if a lab (manage.py lab, or demo) runs on this data folder."""
    try:
        with (Path(settings.DATA_DIR) / "lab.lock").open("rb") as lock:
            fcntl.flock(lock, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except FileNotFoundError:
        return False
    except OSError:
        return True
    return False


def standing_of(name: str) -> Standing:
    """Return the status of a deployment as last written by the lab."""
    try:
        fields = json.loads((_folder() / f"{name}.json").read_bytes())
        return Standing(str(fields["doing"]), bool(fields["up"]), str(fields["failed"]))
    except (OSError, ValueError, KeyError, TypeError):
        return Standing()


def write_status(name: str, standing: Standing) -> None:
    """Write the status of a deployment; called by the lab.

    Raises:
        OSError: If it cannot be written.
    """
    written = _folder() / f".{name}.json"
    written.write_text(json.dumps(asdict(standing)), "utf-8")
    written.replace(_folder() / f"{name}.json")


def try_again(*, name: str) -> None:
    """Touch a deployment file, so that the lab tries to start it again.

    Raises:
        NotFound: If there is none.
    """
    stored = stored_deployment(name)
    if stored is None:
        raise NotFound(f"{name!r:.80} has no deployment in the data folder")
    stored.path.touch()


def remove(*, name: str) -> None:
    """Remove a deployment; the lab then ends the programs that it has started for this deployment.

    A station without any history or plan is deleted too; any other is deactivated.

    Raises:
        NotFound: If there is no deployment of that name.
        Conflict: If the station is in use.
    """
    stored = stored_deployment(name)
    if stored is None:
        raise NotFound(f"{name!r:.80} has no deployment in the data folder")
    station = Station.objects.filter(name=name).first()
    if station is not None:
        _require_no_holder(station)
        with transaction.atomic():
            _require_no_trial(station)
            if not _deleted(station):
                Station.objects.filter(name=name).update(
                    active=False, deployment="", message="removed under First steps"
                )
    stored.path.unlink()
    (_folder() / f"{name}.json").unlink(missing_ok=True)


def _deleted(station: Station) -> bool:
    """Delete a station to which nothing refers; return whether it was deleted."""
    if Plan.objects.filter(stations=station).exists():
        return False
    try:
        station.delete()
    except ProtectedError:
        return False
    return True


def _require_no_trial(station: Station) -> None:
    trial = Trial.objects.filter(station=station, status__in=lifecycle.OPEN_STATES).order_by("pk").first()
    if trial is not None:
        raise Conflict(
            f"trial {trial.pk} of {station} is {trial.get_status_display()}: end or abandon it first (one that was cut "
            f"off is interrupted once {station} is started again), then remove {station}"
        )


def _require_no_holder(station: Station) -> None:
    """Raise Conflict if a user holds the lease; the lease of a station that does not answer counts as ended."""
    lease = lease_open(station=station)
    if lease is None:
        return
    try:
        holder = connection_to(station.name).status(timeout=_ASK_S)["lease"]["holder"]
    except StationGone:
        return
    if holder:
        raise Conflict(f"{holder} has {station}: it is given back first, or taken, then removed")


def _require_no_program(part: str, typed: Mapping[str, str]) -> None:
    """Refuse values that would make this machine run a program: keys in BY_HAND must have their defaults.

    Only a person with access to the machine may set such keys, in the file.

    Raises:
        EvaError: If such a key has another value.
        ConfigurationError: If `typed` has a kind that does not exist for this `part`.
    """
    for entry in draft.entries(part, typed.get("kind", "")):
        value = typed.get(entry.key, "").strip()
        remark = BY_HAND.get((part, entry.key))
        if remark and value not in ("", entry.default):
            raise EvaError(f"{part}.{entry.key} = {value!r:.80}; allowed here: {entry.default}; {remark}")


def _write(name: str, tree: dict[str, Any], about: str) -> StoredDeployment:
    if not re.fullmatch(STATION_NAME, name):
        raise EvaError(
            f"station = {name!r:.80}; allowed: letters, digits, '.', '_' and '-', the first a letter or digit"
        )
    path = _folder() / f"{name}.toml"
    if path.exists() or Station.objects.filter(name=name).exists():
        raise _taken(name)
    for station in Station.objects.filter(active=True).exclude(deployment=""):
        if Path(station.deployment).stem == name:
            raise Conflict(
                f"the lab calls the program of {station} {name}, after {station.deployment}: give this one another name"
            )
    try:
        _put(
            path, tree, about, place=os.link
        )  # link() never replaces a file: another page may write the same name at this moment
    except FileExistsError:
        raise _taken(name) from None
    return StoredDeployment(name, path)


def _taken(name: str) -> Conflict:
    return Conflict(f"there is a station {name} already: give this one another name")


def _put(
    path: Path, tree: Mapping[str, Any], *about: str, place: Callable[[Path, Path], object] = os.replace
) -> None:
    """Write `tree` as a deployment file to `path`, if the runtime can load it.

    `about` are lines of the comment at the head of the file. `place` moves the checked draft to `path`.

    Raises:
        EvaError: If the runtime cannot load the file.
    """
    written = (
        f"Written by First steps, {timezone.localtime():%Y-%m-%d %H:%M}. Every key: docs/configuration.md."
    )
    path.parent.mkdir(mode=0o700, exist_ok=True)
    draft_path = path.with_name(f"{path.stem}.{uuid4().hex}.draft")
    try:
        write_atomic(draft_path, draft.text_of(tree, [written, *about]).encode())
        load(draft_path)
        place(draft_path, path)
    except ConfigurationError as fault:
        raise EvaError(str(fault).replace(f"{draft_path}: ", "")) from None
    finally:
        draft_path.unlink(missing_ok=True)


def _folder() -> Path:
    return Path(settings.DATA_DIR) / "deployments"
