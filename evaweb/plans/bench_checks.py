"""Checks before a plan's trial runs: each camera is unchanged, and the bench matches its reference picture."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import timedelta
from typing import Any

from django.contrib.auth.models import User
from django.db import transaction
from django.utils import timezone

from evaweb.accounts.roles import Role, require_role
from evaweb.core.errors import Conflict, EvaError, NotAllowed
from evaweb.plans import image_store, region_matching
from evaweb.plans.allocation import allocate_trial
from evaweb.plans.blinding_rules import has_looked_at_the_same
from evaweb.plans.counting import fails_by
from evaweb.plans.design import end_at_request
from evaweb.plans.frozen_document import require_checkpoints, require_scene
from evaweb.plans.models import Achieved, CameraCheck, Handout, Plan, PlanState, Reference
from evaweb.records.journal import clean_text
from evaweb.stations.models import Station
from evaweb.stations.robot_geometry import describe_robot
from evaweb.trials.models import Position, Trial, TrialStatus
from evaweb.trials.scoring import LONGEST_NOTE
from evaweb.trials.services import register_check
from evaweb.trials.voids import register_two_person_rule
from runtime.core.sentences import Pattern, fixed

_NO_REFERENCE_PICTURE_YET_LOOK = Pattern(
    "plans.bench_checks.no_reference_picture_yet_look",
    "{missing}: no reference picture yet; look at it, then confirm it as the first one",
)
_THIS_REFERENCE_SAYS_WHAT_CAMERA = fixed(
    "plans.bench_checks.this_reference_says_what_camera",
    "this reference says what a camera shows at all; allowed: regions of a position's",
)
_HAS_NEWER_REFERENCE_HERE_BY = Pattern(
    "plans.bench_checks.has_newer_reference_here_by",
    "{camera} has a newer reference here, by {user}: draw on that one",
)
_RUNNING_HAS_JUDGED_TRIALS_BY = Pattern(
    "plans.bench_checks.running_has_judged_trials_by",
    "{plan} is running and has judged trials by the reference of {camera} here: its gate stays as it "
    "is; amend the plan for another picture or other regions",
)
_BEFORE_YOUR_FIRST_TRIAL_CONFIRM = Pattern(
    "plans.bench_checks.before_your_first_trial_confirm",
    "before your first trial: confirm that each camera of {name} shows what its reference shows",
)
_TRIAL_BENCH_LOOKED_AT_BEFORE = Pattern(
    "plans.bench_checks.trial_bench_looked_at_before",
    "trial {trial} is {status}: the bench is looked at before the run",
)
_BENCH_NOT_AS_REFERENCE_SHOWS = Pattern(
    "plans.bench_checks.bench_not_as_reference_shows",
    "the bench is not as its reference shows: {low}, wanted {least:.2f}; lay it out again, or give a reason",
)
_ENDED_TRIAL_COUNTS = Pattern(
    "plans.bench_checks.ended_trial_counts",
    "{plan} has ended: trial {trial} could not be repeated, so it counts",
)
_REVEALED_WHAT_VOIDED_NOW_WOULD = Pattern(
    "plans.bench_checks.revealed_what_voided_now_would",
    "{plan} was revealed: what is voided now would be chosen with the result in view",
)
_CLOSED_TRIAL_COULD_NOT_REPEATED = Pattern(
    "plans.bench_checks.closed_trial_could_not_repeated",
    "{plan} is closed: trial {trial} could not be repeated, so it counts",
)
_CLOSED_TRIAL_NOT_REPEATED_SO = Pattern(
    "plans.bench_checks.closed_trial_not_repeated_so",
    "{plan} is closed: trial {trial} was not repeated, so it counts; refuse its void",
)
_YOU_HAVE_SEEN_RESULTS_OPERATOR = Pattern(
    "plans.bench_checks.you_have_seen_results_operator",
    "you have seen results of {plan}: an operator who is blind scores, corrects and voids its trials",
)

HOLDS = timedelta(hours=12)  # validity of a camera check
LOOK_HOLDS = timedelta(minutes=2)  # validity of a layout record before the run


# --- cameras -------------------------------------------------------------------------------------------------


def cameras_of(station: Station) -> list[str]:
    """Return the cameras of the station's robot."""
    return [str(camera) for camera in describe_robot(station.robot)["cameras"]]


def current_camera_check(*, user: User, station: Station) -> CameraCheck | None:
    """Return the user's newest camera check of the station if it is still valid.

    None if the user must confirm the cameras before the next trial.
    """
    newest = CameraCheck.objects.filter(station=station, by=user).first()
    if newest is None or newest.boot != station.boot or timezone.now() - newest.at > HOLDS:
        return None
    return newest


@transaction.atomic
def confirm_cameras(*, user: User, station: Station, first: bool = False) -> CameraCheck:
    """Record that the user has confirmed each camera to show the same as its reference picture.

    The record has each camera's current image and its match to the reference. With `first`, missing references are
    created from the current images.
    Raises: Conflict, which names the cameras without reference.
    """
    require_role(user, Role.OPERATOR)
    cameras = cameras_of(station)
    by_camera = references(station=station, position=None)
    missing = [camera for camera in cameras if camera not in by_camera]
    if missing and not first:
        raise Conflict(_NO_REFERENCE_PICTURE_YET_LOOK(missing=", ".join(missing)))
    views = {}
    for camera, jpeg in image_store.current_images(station, cameras).items():
        name = image_store.store_image(jpeg)
        reference = by_camera.get(camera) or Reference.objects.create(
            station=station, camera=camera, picture=name, by=user
        )
        views[camera] = {
            "picture": name,
            "reference": reference.picture,
            "match": image_store.image_match(image_store.load_image(reference.picture), jpeg),
        }
    return CameraCheck.objects.create(station=station, boot=station.boot, seen=views, by=user)


# --- references ----------------------------------------------------------------------------------------------


def references(*, station: Station, position: Position | None) -> dict[str, Reference]:
    """Return the newest reference picture of each camera for a position.

    If `position` is None, return the pictures that show the views of the cameras, independently of any layout.
    """
    rows = Reference.objects.filter(station=station, position=position).order_by("pk")
    return {row.camera: row for row in rows}


@transaction.atomic
def record_references(*, user: User, station: Station, position: Position | None) -> list[Reference]:
    """Make the current images the references of a position.

    If `position` is None, they become the references that show the views of the cameras, independently of any layout.
    Older references stay in the record. Each new reference gets the regions of the one that it replaces, at the same
    place in the picture.

    Raises:
        Conflict: If a running plan uses one of the references as a gate.
    """
    require_role(user, Role.OPERATOR)
    images = image_store.current_images(station, cameras_of(station))
    Station.objects.select_for_update().get(
        pk=station.pk
    )  # serializes with `save_regions`, which needs the newest reference
    before = references(station=station, position=position)
    for reference in before.values():
        _require_unjudged(reference)
    return [
        Reference.objects.create(
            station=station,
            position=position,
            camera=camera,
            picture=image_store.store_image(jpeg),
            regions=before[camera].regions if camera in before else [],
            by=user,
        )
        for camera, jpeg in images.items()
    ]


@transaction.atomic
def save_regions(*, user: User, reference: Reference, drawn: Any) -> Reference:
    """Create a reference with the same picture and the regions `drawn`: [{"name", "x", "y", "width", "height"}, ...].

    Raises: Conflict if there is a newer reference, or if trials of a running plan with a match gate were compared with
    a reference of this camera.
    """
    require_role(user, Role.OPERATOR)
    regions = region_matching.regions_of(drawn)
    position = reference.position
    if position is None:
        raise EvaError(_THIS_REFERENCE_SAYS_WHAT_CAMERA)
    station = Station.objects.select_for_update().get(pk=reference.station_id)
    newest = references(station=station, position=position)[reference.camera]
    if newest.pk != reference.pk:
        raise Conflict(_HAS_NEWER_REFERENCE_HERE_BY(camera=reference.camera, user=newest.by.get_username()))
    region_matching.check_sizes(regions, image_store.load_image(reference.picture))
    _require_unjudged(reference)
    return Reference.objects.create(
        station=station,
        position=position,
        camera=reference.camera,
        picture=reference.picture,
        regions=[region.model_dump() for region in regions],
        by=user,
    )


def _require_unjudged(reference: Reference) -> None:
    """Raise Conflict if the reference may not be replaced, because it has already served as a gate in a running plan.

    The trials of a running plan must all be judged by the same reference of a camera.
    """
    judged = Achieved.objects.filter(
        reference__station=reference.station_id,
        reference__position=reference.position_id,
        camera=reference.camera,
    )
    plan = Plan.objects.filter(
        state=PlanState.FROZEN, match_gate__isnull=False, handouts__trial__in=judged.values("trial")
    ).first()
    if plan is not None:
        raise Conflict(_RUNNING_HAS_JUDGED_TRIALS_BY(plan=plan, camera=reference.camera))


# --- trials --------------------------------------------------------------------------------------------------


def allocate_checked_trial(*, user: User, station: Station, plan: Plan) -> Handout:
    """Allocate the next trial of a plan if the user has confirmed the cameras; see `allocation`."""
    require_role(user, Role.OPERATOR)
    if current_camera_check(user=user, station=station) is None:
        raise Conflict(_BEFORE_YOUR_FIRST_TRIAL_CONFIRM(name=station.name))
    return allocate_trial(user=user, station=station, plan=plan)


@dataclass(frozen=True, slots=True)
class CameraMatch:
    """Current image of a camera, compared with its reference picture.

    `match` and `regions` have the same meaning as in `Achieved`. Without a reference picture, `match` is None and
    `regions` is empty.
    """

    camera: str
    jpeg: bytes
    reference: Reference | None
    match: float | None
    regions: list[dict[str, Any]]

    @property
    def worst(self) -> tuple[float, str] | None:
        """Lowest match of the camera's regions or image, and its description; None without a reference.

        This is the match that is compared with the least match that the plan requires, if the plan has a match gate.
        """
        if self.regions:
            row = min(self.regions, key=lambda row: float(row["match"]))
            return row["match"], f"{self.camera}, {row['name']} {row['match']:.2f} ({row['words']})"
        return None if self.match is None else (self.match, f"{self.camera} {self.match:.2f}")


def current_matches(*, trial: Trial) -> list[CameraMatch]:
    """Return the current match of each camera that has a reference at the trial's position.

    Return [] if the trial is no longer prepared. This is no error, because a page that polls may ask a moment too late.
    """
    if trial.status != TrialStatus.PREPARED:
        return []
    by_camera = references(station=trial.station, position=trial.position)
    return _compare_cameras(
        trial, [camera for camera in cameras_of(trial.station) if camera in by_camera], 1.0
    )


def _compare_cameras(trial: Trial, cameras: Sequence[str], patience_s: float) -> list[CameraMatch]:
    if trial.status != TrialStatus.PREPARED:
        raise Conflict(_TRIAL_BENCH_LOOKED_AT_BEFORE(trial=trial.pk, status=trial.get_status_display()))
    by_camera = references(station=trial.station, position=trial.position)
    images = image_store.current_images(trial.station, cameras, patience_s)
    return [_seen(camera, jpeg, by_camera.get(camera)) for camera, jpeg in images.items()]


def _seen(camera: str, jpeg: bytes, reference: Reference | None) -> CameraMatch:
    if reference is None:
        return CameraMatch(camera, jpeg, None, None, [])
    before = image_store.load_image(reference.picture)
    drawn = region_matching.regions_of(reference.regions)
    rows = region_matching.match_regions(drawn, before, jpeg) if drawn else []
    return CameraMatch(camera, jpeg, reference, image_store.image_match(before, jpeg), rows)


def record_layout(*, user: User, trial: Trial, override: str = "") -> list[Achieved]:
    """Store the current images before the run, with their match to the position's references.

    `override` is the reason for which a low match is accepted. Raises: Conflict if a match is below the least match
    that the plan requires, and `override` is empty.
    """
    require_role(user, Role.OPERATOR)
    reason = clean_text("override", override, LONGEST_NOTE)
    matches = _compare_cameras(trial, cameras_of(trial.station), 3.0)
    _require_match(trial, matches, reason)
    return [
        Achieved.objects.create(
            trial=trial,
            camera=match.camera,
            picture=image_store.store_image(match.jpeg),
            reference=match.reference,
            match=match.match,
            regions=match.regions,
            override=reason,
            by=user,
        )
        for match in matches
    ]


def _require_match(trial: Trial, matches: Sequence[CameraMatch], reason: str) -> None:
    handout = Handout.objects.select_related("plan").filter(trial=trial).first()
    least = handout.plan.match_gate if handout else None
    if least is None or reason:
        return
    low = sorted(match.worst[1] for match in matches if match.worst is not None and match.worst[0] < least)
    if low:
        raise Conflict(_BENCH_NOT_AS_REFERENCE_SHOWS(low="; ".join(low), least=least))


def _check_before(action: str, trial: Trial, user: Any) -> None:
    """Check an action on a plan's trial (see `register_check`).

    Within a transaction the plan is locked until the transaction ends, so that it cannot be revealed between the check
    and the action.
    """
    rows = Handout.objects.select_related("plan", "trial")
    if transaction.get_connection().in_atomic_block:
        rows = rows.select_for_update(of=("plan",))
    handout = rows.filter(trial=trial).first()
    if handout is None:
        return
    if action == "run":
        newest = Achieved.objects.filter(trial=trial).last()
        if newest is None or timezone.now() - newest.at > LOOK_HOLDS:
            record_layout(user=user, trial=trial, override=newest.override if newest else "")
    if action.startswith("void") and handout.plan.state == PlanState.REVEALED:
        raise EvaError(_REVEALED_WHAT_VOIDED_NOW_WOULD(plan=handout.plan))
    if action == "voided" and handout.trial.status == TrialStatus.SCORED:
        if handout.plan.state == PlanState.CLOSED:
            raise Conflict(_CLOSED_TRIAL_COULD_NOT_REPEATED(plan=handout.plan, trial=trial.pk))
        if end_at_request(handout.plan):
            raise Conflict(_ENDED_TRIAL_COUNTS(plan=handout.plan, trial=trial.pk))
    if action == "void agreed" and handout.plan.state == PlanState.CLOSED and not _repeated(handout):
        raise Conflict(_CLOSED_TRIAL_NOT_REPEATED_SO(plan=handout.plan, trial=trial.pk))
    if action in ("run", "judged"):
        require_scene(handout.plan, trial.scene)
    if action == "prepared":  # runs before set-up and before run
        require_checkpoints(handout.plan)
    judged = action in ("scored", "voided", "void answered")
    if judged and handout.plan.sealed and has_looked_at_the_same(handout.plan, user):
        raise NotAllowed(_YOU_HAVE_SEEN_RESULTS_OPERATOR(plan=handout.plan))


def _repeated(handout: Handout) -> bool:
    """Return True if another attempt at the same slot counts."""
    repetitions = Handout.objects.filter(plan=handout.plan_id, slot=handout.slot_id).exclude(pk=handout.pk)
    return repetitions.filter(trial__status=TrialStatus.SCORED).exists()


def _of_two(trial: Trial) -> bool:
    """Return True if two operators must agree before the trial is voided.

    This is so if the trial is of a blind plan, or if the plan counts it as a failure. Otherwise a single operator could
    void an unwelcome trial in order to have it repeated.
    """
    handout = Handout.objects.select_related("plan").filter(trial=trial).first()
    return handout is not None and (handout.plan.blind or fails_by(handout.plan, trial))


register_check(_check_before)
register_two_person_rule(_of_two)
