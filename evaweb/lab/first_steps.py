"""First steps of a new lab up to its first scored trial: six steps whose progress follows from the lab's state."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum
from hashlib import sha256
from typing import Any

from django.db import transaction
from django.urls import NoReverseMatch, reverse

from evaweb.core.errors import StationGone
from evaweb.lab import deployments
from evaweb.lab.demo_rows import demo_scene
from evaweb.lab.deployments import Standing, StoredDeployment, is_simulated, standing_of, stored_deployment
from evaweb.lab.processes import LabError
from evaweb.plans.bench_checks import cameras_of
from evaweb.plans.models import CameraCheck
from evaweb.stations.models import CARRIED_OUT, Station
from evaweb.stations.runtime_client import connection_to
from evaweb.trials.models import Checkpoint, Scene, Trial, TrialStatus

_ASK_S = 1.0  # timeout of a station's status for a page


class Progress(StrEnum):
    """Progress of a step."""

    DONE = "done"
    NOW = "now"
    LATER = "later"

    @property
    def tone(self) -> str:
        """Tone of the progress chip, by its name in the style sheets."""
        return {"done": "ok", "now": "active"}.get(self.value, "neutral")


@dataclass(frozen=True, slots=True)
class Step:
    """Step with its name, title and progress; its template has the same name."""

    name: str
    title: str
    progress: Progress

    @property
    def template(self) -> str:
        """Template shown while it is the current step."""
        return f"lab/step_{self.name}.html"


@dataclass(frozen=True)
class Walk:
    """First steps of one station, each of them done or not.

    If there is neither a station nor a deployment, the first step is the current one.

    Attributes:
        station: The station; None if its row does not exist yet.
        kept: The station's deployment file.
        standing: Status of this deployment in the lab.
        snapshot: State of the station, {} if it does not answer.
    """

    station: Station | None
    kept: StoredDeployment | None
    standing: Standing
    simulated: bool
    snapshot: dict[str, Any]
    cameras: tuple[str, ...]
    steps: tuple[Step, ...]
    checkpoints: bool
    scored: Trial | None
    others: tuple[Station, ...] = field(default=())

    @property
    def name(self) -> str:
        """Name of the station, "" if there is none."""
        return self.station.name if self.station else self.kept.name if self.kept else ""

    @property
    def now(self) -> Step | None:
        """Current step; None if all are done."""
        return next((step for step in self.steps if step.progress is Progress.NOW), None)

    @property
    def mark(self) -> str:
        """Fingerprint that changes whenever the displayed status changes."""
        fields = (self.name, self.standing, bool(self.snapshot), self.checkpoints, *self.steps)
        return sha256(repr(fields).encode()).hexdigest()[:16]

    @property
    def waits(self) -> bool:
        """True if the page has to poll, because the lab or another page is expected to act."""
        return self.now is not None and self.now.name != "deployment"


_TITLES = {
    "deployment": "Describe a station",
    "station": "Start the station",
    "cameras": "Check the cameras",
    "home": "Home the robot",
    "scene": "Create a first scene",
    "trial": "Run and score the first trial",
}


def walk(*, name: str = "") -> Walk:
    """Return the steps of the station called `name`, which need not have a database row yet.

    If there is no such station, return the steps of the newest station.
    """
    stations = tuple(Station.objects.filter(active=True).order_by("-created_at"))
    stored = stored_deployment(name) if name else None
    station = next((row for row in stations if row.name == name), None)
    if station is None and stored is None:
        station, stored = _newest(stations)
    elif station is not None:
        stored = stored_deployment(station.name)
    snapshot = _snapshot(station)
    cameras = tuple(cameras_of(station)) if station else ()
    scored = _scored(station)
    checkpoints = Checkpoint.objects.filter(active=True).exists()
    completed = {
        "deployment": station is not None or stored is not None,
        "station": bool(snapshot) or scored is not None,
        "cameras": scored is not None or _looked_at(station) or (bool(snapshot) and not cameras),
        "home": scored is not None or _homed(station),
        "scene": Scene.objects.filter(
            active=True, positions__isnull=False, milestones__isnull=False
        ).exists(),
        "trial": scored is not None,
    }
    return Walk(
        station=station,
        kept=stored,
        standing=standing_of(stored.name) if stored else Standing(),
        simulated=_simulated(station, stored),
        snapshot=snapshot,
        cameras=cameras,
        steps=_steps(completed),
        checkpoints=checkpoints,
        scored=scored,
        others=tuple(row for row in stations if row != station),
    )


@transaction.atomic
def starter_scene() -> Scene:
    """Return a scene with positions and milestones that the simulated bench can lay out; created once."""
    return demo_scene()


def scenes_address() -> str:
    """Return the address for creating scenes: the scene editor, else the administration."""
    try:
        return reverse("setup-scenes")
    except NoReverseMatch:
        return reverse("admin:trials_scene_changelist")


def _newest(stations: tuple[Station, ...]) -> tuple[Station | None, StoredDeployment | None]:
    """Return the newest deployment if it has no station yet, else the newest station with its deployment."""
    written = deployments.stored_deployments()
    if written and written[-1].name not in set(Station.objects.values_list("name", flat=True)):
        return None, written[-1]
    station = stations[0] if stations else None
    return station, stored_deployment(station.name) if station else None


def _steps(completed: dict[str, bool]) -> tuple[Step, ...]:
    open_ones = [name for name in _TITLES if not completed[name]]
    return tuple(
        Step(
            name,
            title,
            Progress.DONE if completed[name] else Progress.NOW if name == open_ones[0] else Progress.LATER,
        )
        for name, title in _TITLES.items()
    )


def _snapshot(station: Station | None) -> dict[str, Any]:
    if station is None:
        return {}
    try:
        return connection_to(station.name).status(timeout=_ASK_S)
    except StationGone:
        return {}


def _simulated(station: Station | None, stored: StoredDeployment | None) -> bool:
    if station is not None:
        return station.simulated
    try:
        return stored is not None and stored.chosen and is_simulated(stored.resolved())
    except LabError:  # its step reports the error
        return False


def _looked_at(station: Station | None) -> bool:
    return station is not None and CameraCheck.objects.filter(station=station).exists()


def _homed(station: Station | None) -> bool:
    """Return True if the robot was homed, by a home command or by a set-up."""
    if station is None:
        return False
    return station.commands.filter(kind__in=("home", "setup"), status__in=CARRIED_OUT).exists()


def _scored(station: Station | None) -> Trial | None:
    if station is None:
        return None
    return Trial.objects.filter(station=station, status=TrialStatus.SCORED).order_by("pk").first()
