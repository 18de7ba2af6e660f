"""Checks before a trial of a plan runs: that each camera is the one it should be, and that the bench is laid
out as its reference picture shows.
"""

from __future__ import annotations

from collections.abc import Mapping
from datetime import timedelta
from typing import Any

from django.contrib.auth.models import User
from django.db import transaction
from django.utils import timezone

from evaweb.errors import Conflict, EvaError, NotAllowed
from evaweb.journal import text
from evaweb.plans import pictures
from evaweb.plans.allocation import hand_out
from evaweb.plans.blinding_rules import has_looked_at_a_version
from evaweb.plans.models import Achieved, CameraCheck, Handout, Plan, PlanState, Reference
from evaweb.roles import Role, require
from evaweb.stations.models import Station
from evaweb.stations.robot_geometry import facts_of
from evaweb.trials.models import Position, Trial, TrialStatus
from evaweb.trials.services import declare_check
from evaweb.trials.verdicts import LONGEST_NOTE
from evaweb.trials.voids import declare_by_two

HOLDS = timedelta(hours=12)  # somebody's look at the cameras


# --- cameras -------------------------------------------------------------------------------------------------


def cameras_of(station: Station) -> list[str]:
    """The cameras of the station's robot."""
    return [str(camera) for camera in facts_of(station.robot)["cameras"]]


def cameras_confirmed(*, user: User, station: Station) -> CameraCheck | None:
    """The look at the cameras that still holds for this user; None: they look at them before their next trial."""
    newest = CameraCheck.objects.filter(station=station, by=user).first()
    if newest is None or newest.boot != station.boot or timezone.now() - newest.at > HOLDS:
        return None
    return newest


@transaction.atomic
def cameras_confirm(*, user: User, station: Station, first: bool = False) -> CameraCheck:
    """Write down that each camera shows what its reference shows, with what it shows now.

    `first`: where a camera has no reference yet, what it shows becomes it; without that Conflict names the camera.
    """
    require(user, Role.OPERATOR)
    cameras = cameras_of(station)
    known = references(station=station, position=None)
    missing = [camera for camera in cameras if camera not in known]
    if missing and not first:
        raise Conflict(
            f"{', '.join(missing)}: no reference picture yet; look at it, then confirm it as the first one"
        )
    seen = {}
    for camera, jpeg in pictures.now(station, cameras).items():
        name = pictures.keep(jpeg)
        reference = known.get(camera) or Reference.objects.create(
            station=station, camera=camera, picture=name, by=user
        )
        seen[camera] = {
            "picture": name,
            "reference": reference.picture,
            "match": pictures.match(pictures.kept(reference.picture), jpeg),
        }
    return CameraCheck.objects.create(station=station, boot=station.boot, seen=seen, by=user)


# --- references ----------------------------------------------------------------------------------------------


def references(*, station: Station, position: Position | None) -> dict[str, Reference]:
    """The newest reference of each camera, at a position or, without one, at all."""
    rows = Reference.objects.filter(station=station, position=position).order_by("pk")
    return {row.camera: row for row in rows}


@transaction.atomic
def references_take(*, user: User, station: Station, position: Position | None) -> list[Reference]:
    """Make what the cameras show now the references of a position, or of the cameras; others stay in the record."""
    require(user, Role.OPERATOR)
    found = pictures.now(station, cameras_of(station))
    return [
        Reference.objects.create(
            station=station, position=position, camera=camera, picture=pictures.keep(jpeg), by=user
        )
        for camera, jpeg in found.items()
    ]


# --- trials --------------------------------------------------------------------------------------------------


def next_trial(*, user: User, station: Station, plan: Plan) -> Handout:
    """The next trial of a plan, for a user who has looked at the cameras; see evaweb.plans.allocation."""
    require(user, Role.OPERATOR)
    if cameras_confirmed(user=user, station=station) is None:
        raise Conflict(
            f"before your first trial: confirm that each camera of {station.name} shows what its reference shows"
        )
    return hand_out(user=user, station=station, plan=plan)


def achieve(*, user: User, trial: Trial, override: str = "") -> list[Achieved]:
    """Keep what the cameras show now, before the run, with how well it matches the position's references.

    Conflict where a match is below the plan's least and there is no reason in `override`.
    """
    require(user, Role.OPERATOR)
    why = text("override", override, LONGEST_NOTE)
    if trial.status != TrialStatus.PREPARED:
        raise Conflict(
            f"trial {trial.pk} is {trial.get_status_display()}: the bench is looked at before the run"
        )
    known = references(station=trial.station, position=trial.position)
    found = pictures.now(trial.station, cameras_of(trial.station))
    matches = {
        camera: pictures.match(pictures.kept(known[camera].picture), jpeg)
        for camera, jpeg in found.items()
        if camera in known
    }
    _require_match(trial, matches, why)
    return [
        Achieved.objects.create(
            trial=trial,
            camera=camera,
            picture=pictures.keep(jpeg),
            reference=known.get(camera),
            match=matches.get(camera),
            override=why,
            by=user,
        )
        for camera, jpeg in found.items()
    ]


def _require_match(trial: Trial, matches: Mapping[str, float], why: str) -> None:
    handout = Handout.objects.select_related("plan").filter(trial=trial).first()
    least = handout.plan.match_gate if handout else None
    if least is None or why:
        return
    low = [f"{camera} {matched:.2f}" for camera, matched in sorted(matches.items()) if matched < least]
    if low:
        raise Conflict(
            f"the bench is not as its reference shows: {', '.join(low)}, wanted {least:.2f}; lay it out again, or give "
            "a reason"
        )


def _before(what: str, trial: Trial, user: Any) -> None:
    """Check trials of plans before they run, or are taken out of the count."""
    handout = Handout.objects.select_related("plan").filter(trial=trial).first()
    if handout is None:
        return
    if what == "run" and not Achieved.objects.filter(trial=trial).exists():
        achieve(user=user, trial=trial)
    if what.startswith("void") and handout.plan.state == PlanState.REVEALED:
        raise EvaError(
            f"{handout.plan} was revealed: what is voided now would be chosen with the result in view"
        )
    judged = what in ("scored", "voided", "void answered")
    if judged and handout.plan.sealed and has_looked_at_a_version(handout.plan, user):
        raise NotAllowed(
            f"you have seen results of {handout.plan}: an operator who is blind scores, corrects and voids its trials"
        )


def _blind(trial: Trial) -> bool:
    return Plan.objects.filter(handouts__trial=trial, blind=True).exists()


declare_check(_before)
declare_by_two(_blind)
