"""Contents of the console's pages."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from django.contrib.sessions.backends.base import SessionBase

from evaweb.blinding.visibility import Visibility
from evaweb.plans.allocation import Progress, plan_progress
from evaweb.plans.bench_checks import cameras_of, current_camera_check, references
from evaweb.plans.models import CameraCheck, Handout, Plan, Reference
from evaweb.plans.selectors import handout_of, plans_open
from evaweb.stations.models import Lease, Station
from evaweb.stations.robot_geometry import describe_robot
from evaweb.stations.selectors import last_set_up, leases_open, station_list
from evaweb.trials.failures import Level, failure_choices
from evaweb.trials.models import Checkpoint, Milestone, Position, Scene, Trial, TrialStatus
from evaweb.trials.selectors import UNFINISHED, checkpoint_list, scene_list, trial_list, trial_open
from evaweb.trials.services import failing

SESSION_KEY = "station"


@dataclass(frozen=True, slots=True)
class StationRow:
    """Station in the list of the home page, with its open `lease` and its open `trial`."""

    station: Station
    lease: Lease | None
    trial: Trial | None


@dataclass(frozen=True, slots=True)
class EvalPanel:
    """Contents of the four steps of an evaluation, as visible to one user.

    Attributes:
        trial: The unfinished trial.
        last: The newest finished trial.
        scene, position, checkpoint: Without an unfinished trial, the initial choice, which follows from `last`.
        milestones: Milestones of the trial's scene.
        set_up: Whether the station was last set up for the unfinished trial.
        failures: Phases and causes of failure that can be selected.
        plans: Plans that are open at this station.
        plan: The selected plan.
        handout: Allocation of the trial by its plan.
        cameras: The user's camera check while it is valid.
        views: Reference images by camera: those of the trial's position or, without a trial, of the camera.
    """

    station: Station
    trial: Trial | None
    last: Trial | None
    scenes: tuple[Scene, ...]
    checkpoints: tuple[Checkpoint, ...]
    scene: Scene | None
    positions: tuple[Position, ...]
    position: Position | None
    checkpoint: Checkpoint | None
    milestones: tuple[Milestone, ...]
    set_up: bool
    failures: tuple[Level, ...]
    hidden: bool  # whether the trial's checkpoint is hidden from the user
    fails: str = ""  # reason for which the trial is a failure whatever was reached
    plans: tuple[Plan, ...] = ()
    plan: Plan | None = None
    handout: Handout | None = None
    progress: Progress | None = None
    cameras: CameraCheck | None = None
    views: tuple[tuple[str, Reference | None], ...] = ()

    @property
    def lacks_references(self) -> bool:
        """True if a camera has no reference image yet."""
        return any(row is None for _, row in self.views)

    @property
    def reference_addresses(self) -> dict[str, str]:
        """Address of the reference image of the trial's position, by camera."""
        return (
            {camera: f"/pictures/{row.picture}.jpg" for camera, row in self.views if row}
            if self.trial
            else {}
        )

    @property
    def implied(self) -> bool:
        """True if the milestones decide on success: at least one of them is required."""
        return any(milestone.required for milestone in self.milestones)

    @property
    def layout(self) -> str:
        """Description of the bench layout."""
        scene = self.trial.scene if self.trial else self.scene
        return scene.layout if scene else ""

    @property
    def last_address(self) -> str:
        """Address of the last trial's page."""
        return f"/result/trials/{self.last.pk}/" if self.last else ""


def last_used_station(*, session: SessionBase) -> Station | None:
    """Return the station that this browser last used, else the only station, else None."""
    used = session.get(SESSION_KEY)
    station = Station.objects.filter(name=used).first() if used else None
    if station is not None:
        return station
    first_two = list(station_list()[:2])
    return first_two[0] if len(first_two) == 1 else None


def station_rows() -> list[StationRow]:
    """Return every station, active ones first, with its open lease and trial."""
    leases = leases_open()
    unfinished = trial_list().filter(status__in=UNFINISHED).order_by("pk")
    trials = {trial.station_id: trial for trial in unfinished}
    stations = station_list(all_of_them=True).order_by("-active", "name")
    return [StationRow(station, leases.get(station.pk), trials.get(station.pk)) for station in stations]


def robot_facts(*, robot: str) -> dict[str, Any]:
    """Return names and units of the robot's vector, and its cameras.

    If the description of the robot is unreadable, they are empty and "error" is the reason.
    """
    description = describe_robot(robot)
    return {
        "names": description["joint_names"],
        "units": description["units"],
        "grippers": description["gripper_dims"],
        "cameras": description["cameras"],
        "title": description["title"],
        "error": description.get("error", ""),
    }


def eval_panel(
    *, station: Station, user: Any, sight: Visibility, scene: str = "", plan: str | None = None
) -> EvalPanel:
    """Return the evaluation panel of a station.

    Args:
        station: The station.
        user: User who sees the panel.
        sight: Visibility of that user.
        scene: Name of the scene being chosen; "" for the last one.
        plan: Name of the plan to work on; "" for no plan, None for the plan of the last trial.
    """
    trial = trial_open(station)
    last = None if trial else trial_list().filter(station=station).first()
    scenes, checkpoints = tuple(scene_list()), tuple(checkpoint_list(sight=sight))
    handout = handout_of(trial=trial) if trial else None
    plans = tuple(plans_open(station=station))
    worked = handout.plan if handout else None if trial else _plan(plans, plan, last)
    chosen = _chosen_scene(scenes, scene or (last.scene.name if last else ""))
    positions = tuple(chosen.positions.all()) if chosen else ()
    return EvalPanel(
        station=station,
        trial=trial,
        last=last,
        scenes=scenes,
        checkpoints=checkpoints,
        scene=chosen,
        positions=positions,
        position=_next_position(positions, last),
        checkpoint=last.checkpoint if last and not sight.hides(last) else None,
        milestones=tuple(trial.scene.milestones.order_by("order")) if trial else (),
        set_up=trial is not None and _is_set_up(trial),
        failures=failure_choices() if trial else (),
        hidden=trial is not None and sight.hides(trial),
        fails=failing(trial) if trial else "",
        plans=plans,
        plan=worked,
        handout=handout,
        progress=plan_progress(worked) if worked else None,
        cameras=current_camera_check(user=user, station=station) if worked else None,
        views=_views(station, trial) if worked else (),
    )


def _plan(plans: tuple[Plan, ...], name: str | None, last: Trial | None) -> Plan | None:
    """Return the open plan called `name`, None if there is no such plan.

    If `name` is None, it is the last trial's plan, if that is still open.
    """
    if name is not None:
        return next((plan for plan in plans if plan.name == name), None)
    handout = handout_of(trial=last) if last else None
    return next((plan for plan in plans if handout and plan.name == handout.plan.name), None)


def _views(station: Station, trial: Trial | None) -> tuple[tuple[str, Reference | None], ...]:
    by_camera = references(station=station, position=trial.position if trial else None)
    return tuple((camera, by_camera.get(camera)) for camera in cameras_of(station))


def _chosen_scene(scenes: tuple[Scene, ...], name: str) -> Scene | None:
    return next((scene for scene in scenes if scene.name == name), scenes[0] if scenes else None)


def _next_position(positions: tuple[Position, ...], last: Trial | None) -> Position | None:
    """Return the position that follows that of the trial `last`; after the last position, the first.

    If `last` has no score, its own position is returned. If `last` is None, or its position is not among `positions`,
    the first position is returned. The result is None if there are no positions.
    """
    if not positions:
        return None
    if last is None or last.position not in positions:
        return positions[0]
    at = positions.index(last.position)
    return positions[(at + 1) % len(positions)] if last.status == TrialStatus.SCORED else positions[at]


def _is_set_up(trial: Trial) -> bool:
    """Return True if the last set-up of the station that may have been executed was for this trial."""
    last = last_set_up(station=trial.station)
    return last is not None and last == trial.setup
