"""What the pages of the console show."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import robots
from django.contrib.sessions.backends.base import SessionBase
from django.db.models import QuerySet

from evaweb.errors import NotFound
from evaweb.stations.models import Command, CommandStatus, Lease, LeaseRequest, Station
from evaweb.trials.models import Checkpoint, Position, Scene, Score, Trial, TrialStatus

SESSION_KEY = "station"
FAILURES_OFFERED = 12

_OPEN = (TrialStatus.PREPARED, TrialStatus.RUNNING, TrialStatus.PAUSED, TrialStatus.ENDED)
_ANSWERED = (CommandStatus.ACCEPTED, CommandStatus.DONE)


@dataclass(frozen=True, slots=True)
class StationRow:
    """One station as the home page lists it; `lease` and `trial` are what is open there."""

    station: Station
    lease: Lease | None
    trial: Trial | None


@dataclass(frozen=True, slots=True)
class Panel:
    """What the four steps of an evaluation show.

    `trial` is the open one; `last` the newest closed one, from which the choice is prefilled where there is no
    open one. `set_up` says whether the station was set up for `trial`.
    """

    station: Station
    trial: Trial | None
    last: Trial | None
    scene: Scene | None
    positions: tuple[Position, ...]
    position: Position | None
    checkpoint: Checkpoint | None
    scenes: tuple[Scene, ...]
    checkpoints: tuple[Checkpoint, ...]
    set_up: bool
    failures: tuple[str, ...]


def station_get(*, name: str) -> Station:
    """The station of this name; NotFound names those that exist."""
    found = Station.objects.filter(name=name).first()
    if found is None:
        known = ", ".join(Station.objects.values_list("name", flat=True)) or "none yet"
        raise NotFound(f"there is no station {name!r}; stations: {known}")
    return found


def station_last_used(*, session: SessionBase) -> Station | None:
    """The station that this browser last looked at, else the only one there is."""
    used = session.get(SESSION_KEY)
    found = Station.objects.filter(name=used).first() if used else None
    if found is not None:
        return found
    first_two = list(Station.objects.filter(active=True)[:2])
    return first_two[0] if len(first_two) == 1 else None


def station_rows() -> list[StationRow]:
    """Every station, the active ones first, with its open lease and trial."""
    leases = {lease.station_id: lease for lease in Lease.objects.filter(ended_at=None).select_related("user")}
    trials = {trial.station_id: trial for trial in _trials().filter(status__in=_OPEN).order_by("pk")}
    stations = Station.objects.order_by("-active", "name")
    return [StationRow(station, leases.get(station.pk), trials.get(station.pk)) for station in stations]


def lease_requests(*, station: Station) -> QuerySet[LeaseRequest]:
    """Who waits for the station, the longest first."""
    return station.lease_requests.filter(answer=LeaseRequest.Answer.OPEN).select_related("user")


def lease_open(*, station: Station) -> Lease | None:
    """The lease that the database holds for given; the station's own word is in its snapshot."""
    return station.leases.filter(ended_at=None).select_related("user").first()


def joint_units(*, robot: str) -> dict[str, Any]:
    """Names and units of the robot's vector; empty with the reason where its description cannot be read."""
    try:
        described = robots.load(robot)
    except robots.RobotError as error:
        return {"names": [], "units": [], "cameras": [], "title": robot, "error": str(error)}
    units = ["rad"] * described.dim
    for group in described.groups:
        if group.gripper is not None and group.gripper_dim is not None:
            units[group.gripper_dim] = group.gripper.unit
    return {
        "names": list(described.joint_names),
        "units": units,
        "cameras": [camera.key for camera in described.cameras],
        "title": described.title,
        "error": "",
    }


def panel(*, station: Station, scene: str = "") -> Panel:
    """The evaluation panel of a station; `scene` is the name of the one being chosen, where one is."""
    trial = _trials().filter(station=station, status__in=_OPEN).first()
    last = None if trial else _trials().filter(station=station).first()
    scenes = tuple(Scene.objects.filter(active=True))
    checkpoints = tuple(Checkpoint.objects.filter(active=True))
    chosen = _chosen_scene(scenes, scene, trial or last)
    positions = tuple(chosen.positions.all()) if chosen else ()
    return Panel(
        station=station,
        trial=trial,
        last=last,
        scene=chosen,
        positions=positions,
        position=_next_position(positions, last),
        checkpoint=last.checkpoint if last and last.checkpoint in checkpoints else None,
        scenes=scenes,
        checkpoints=checkpoints,
        set_up=trial is not None and _set_up_since(trial),
        failures=_failures(),
    )


def _trials() -> QuerySet[Trial]:
    return Trial.objects.select_related("scene", "position", "checkpoint", "operator", "episode")


def _chosen_scene(scenes: tuple[Scene, ...], name: str, trial: Trial | None) -> Scene | None:
    wanted = name or (trial.scene.name if trial else "")
    return next((scene for scene in scenes if scene.name == wanted), scenes[0] if scenes else None)


def _next_position(positions: tuple[Position, ...], last: Trial | None) -> Position | None:
    """The one after the last trial's; the same again where that trial gave no score."""
    if not positions:
        return None
    if last is None or last.position not in positions:
        return positions[0]
    at = positions.index(last.position)
    return positions[(at + 1) % len(positions)] if last.status == TrialStatus.SCORED else positions[at]


def _set_up_since(trial: Trial) -> bool:
    return Command.objects.filter(
        station=trial.station_id, kind="setup", status__in=_ANSWERED, issued_at__gte=trial.prepared_at
    ).exists()


def _failures() -> tuple[str, ...]:
    """The words that were last used for what went wrong, the newest first."""
    newest = Score.objects.exclude(failure="").order_by("-pk").values_list("failure", flat=True)[:200]
    return tuple(dict.fromkeys(newest))[:FAILURES_OFFERED]
