"""Plans: open plans, next trial, the bench before a trial, and the reveal."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated, Any

from django.http import HttpRequest
from ninja import Field, Query, Router, Schema, Status
from pydantic import StrictBool

from evaweb.api.responses import (
    FAILURES,
    Body,
    Page,
    Paging,
)
from evaweb.api.trials import TrialDetail
from evaweb.blinding.visibility import visibility_for_request
from evaweb.plans import allocation, copies, services
from evaweb.plans import bench_checks as bench
from evaweb.plans.allocation import plan_progress
from evaweb.plans.blinding_rules import is_sealed_for, record_unblinding
from evaweb.plans.design import visible_close_reason
from evaweb.plans.models import Achieved, CameraCheck, Plan, PlanState, Reference
from evaweb.plans.selectors import plan_get, plan_list, reference_get
from evaweb.stations.selectors import station_get
from evaweb.trials import selectors as trials

router = Router(tags=["plans"])


class PlanOut(Schema):
    """One version of a plan.

    While it is blind for the caller, `document`, `digest` and `key` are empty, and `closed_because` states only that
    its design has ended. `counted` of `total` trials are scored; `attempts` were handed out.
    """

    name: str
    version: int
    title: str
    state: PlanState
    blind: bool
    sealed: bool
    owner: str
    stations: list[str]
    total: int
    counted: int
    attempts: int
    commitment: str
    question: str
    digest: str
    key: str
    document: dict[str, Any] | None
    frozen_at: datetime | None
    closed_at: datetime | None
    closed_because: str
    revealed_at: datetime | None

    @staticmethod
    def of(plan: Plan, user: Any) -> dict[str, Any]:
        """Return the plan with this user's visibility."""
        sealed = is_sealed_for(plan, user)
        before = (
            plan.amends if plan.state == PlanState.DRAFT else None
        )  # a draft has no document that names it yet
        progress = plan_progress(plan)
        plain = ("name", "version", "title", "state", "blind", "commitment")
        times = ("frozen_at", "closed_at", "revealed_at")
        return {
            **{name: getattr(plan, name) for name in (*plain, *times)},
            "closed_because": visible_close_reason(plan, sealed),
            "sealed": sealed,
            "owner": plan.owner.get_username(),
            "stations": [station.name for station in plan.stations.all()],
            "total": progress.total,
            "counted": progress.counted,
            "attempts": progress.attempts,
            "question": "" if sealed or (before and is_sealed_for(before, user)) else plan.question,
            "digest": "" if sealed else plan.digest,
            "document": None if sealed else plan.document,
            "key": bytes(plan.key or b"").hex() if plan.state == PlanState.REVEALED else "",
        }


class HandoutOut(Schema):
    """The trial that was handed out; `reason` tells why the attempt before it does not count."""

    code: str
    number: int
    attempt: int
    reason: str
    trial: TrialDetail


class StationIn(Body):
    """Station that runs the trial."""

    station: str


class CopiesIn(Body):
    """Simulated station, and how many of its copies run trials at the same time."""

    station: Annotated[str, Field(max_length=63)]
    count: Annotated[int, Field(ge=1, le=copies.MOST_COPIES, strict=True)] = 1


class CopiesOut(Schema):
    """How trials are carried out at copies: of `copies`, `running` run a trial.

    `left_s` is the time until all trials are scored [s]. `lacks` is why no worker runs them. `ended` is why the last
    copies ended before the plan; if it may name what is hidden from the caller, it is empty and `hidden` is true.
    """

    copies: int
    running: int
    lacks: str
    counted: int
    total: int
    left_s: float | None
    ended: str
    hidden: bool


class ReleaseSlotsIn(Body):
    """Station whose unused trials are released to others, and the reason."""

    station: str
    reason: Annotated[str, Field(min_length=1, max_length=2000)]


class ReleasedOut(Schema):
    """Number of trials that can now be handed to others."""

    freed: int


class Reason(Body):
    """Reason, for later readers."""

    reason: str = ""


class RegionIn(Body):
    """A named rectangle: its upper left corner and its size, as fractions of the picture's width and height."""

    name: str
    x: float
    y: float
    width: float
    height: float


class RegionsIn(Body):
    """All regions of a reference picture."""

    regions: list[RegionIn]


class RegionOut(Schema):
    """Match of one region, 0 to 1, and its object's offset to the right and down [pixels]; null if not found."""

    name: str
    at: list[float]
    match: float
    dx: int | None
    dy: int | None
    words: str


class CameraMatchOut(Schema):
    """Picture of one camera, its reference ("" for none), and how well they match, at most 1."""

    camera: str
    picture: str
    reference: str
    match: float | None


class LayoutOut(CameraMatchOut):
    """A camera's match together with the match of each region of its reference."""

    regions: list[RegionOut]


class BenchOut(Schema):
    """Current view of one camera: its reference, how well they match (at most 1), and the match of each region."""

    camera: str
    reference: str
    match: float
    regions: list[RegionOut]


class CamerasOut(Schema):
    """The caller's confirmation of the station's cameras, with the pictures they showed."""

    confirmed: bool
    at: datetime | None
    cameras: list[CameraMatchOut]

    @staticmethod
    def of(check: CameraCheck | None) -> dict[str, Any]:
        """Return the camera check as a dict; if `check` is None, nothing is confirmed."""
        views = check.seen if check else {}
        rows = [{"camera": camera, **facts} for camera, facts in views.items()]
        return {"confirmed": check is not None, "at": check.at if check else None, "cameras": rows}


class CamerasIn(Body):
    """Confirmation of the cameras; with `first` the current picture becomes the reference of a camera without one."""

    first: StrictBool = False


class ReferenceIn(Body):
    """Scene and position that the references belong to; without a scene, the references identify the station's
    cameras.
    """

    scene: str | int | None = None
    position: int | None = None


class ReferenceOut(Schema):
    """One reference picture, with the regions in which the bench is compared."""

    id: int
    camera: str
    picture: str
    regions: list[RegionIn]
    by: str
    at: datetime

    @staticmethod
    def of(row: Reference) -> dict[str, Any]:
        """Return the reference with the user who created it."""
        return {
            "id": row.pk,
            "camera": row.camera,
            "picture": row.picture,
            "regions": row.regions,
            "by": row.by.get_username(),
            "at": row.at,
        }


class LayoutIn(Body):
    """Reason for accepting a match below the plan's minimum."""

    override: str = ""


@router.get("/plans", response={200: Page[PlanOut], **FAILURES}, summary="Plans", url_name="plans")
def plans(request: HttpRequest, paging: Query[Paging], state: PlanState | None = None) -> Any:
    """Return all versions of the plans by name, newest first; drafts are shown to their owners and administrators."""
    rows = plan_list(user=request.auth)
    return paging.page(rows.filter(state=state.value) if state else rows, PlanOut, request.auth)


@router.get("/plans/{name}", response={200: PlanOut, **FAILURES}, summary="One plan", url_name="plan")
def plan(request: HttpRequest, name: str, version: int | None = None) -> Any:
    """Return a plan by its name; without a version the newest that is not a draft."""
    return PlanOut.of(plan_get(name=name, version=version, user=request.auth), request.auth)


@router.post(
    "/plans/{name}/next", response={201: HandoutOut, **FAILURES}, summary="Next trial", url_name="plan-next"
)
def next_trial(request: HttpRequest, name: str, given: StationIn) -> Any:
    """Prepare the next trial of the plan's schedule on a station.

    Requires an operator who has confirmed the station's cameras.
    """
    station = station_get(name=given.station)
    plan = plan_get(name=name, user=request.auth)
    handout = bench.allocate_checked_trial(user=request.auth, station=station, plan=plan)
    visibility = visibility_for_request(request)
    return Status(
        201,
        {
            "code": handout.code,
            "number": handout.number,
            "attempt": handout.trial.attempt,
            "reason": "the attempt before does not count" if handout.reason else "",
            "trial": TrialDetail.of(trials.trial_get(id=handout.trial_id), visibility),
        },
    )


@router.post(
    "/plans/{name}/give-back",
    response={200: ReleasedOut, **FAILURES},
    summary="Give trials to others",
    url_name="plan-give-back",
)
def release_slots(request: HttpRequest, name: str, given: ReleaseSlotsIn) -> Any:
    """Release the trials of a station's open blocks that have not run, so that other stations can get them.

    Requires an operator.
    """
    plan, station = plan_get(name=name, user=request.auth), station_get(name=given.station)
    return {
        "freed": allocation.release_slots(user=request.auth, plan=plan, station=station, reason=given.reason)
    }


@router.get(
    "/plans/{name}/copies",
    response={200: CopiesOut, **FAILURES},
    summary="Trials without people",
    url_name="plan-copies",
)
def copies_state(request: HttpRequest, name: str) -> Any:
    """Return how trials of the plan are carried out at copies of a simulated station."""
    return copies.copies_state(plan_get(name=name, user=request.auth), visibility_for_request(request))


@router.post(
    "/plans/{name}/copies",
    response={202: CopiesOut, **FAILURES},
    summary="Carry out trials without people",
    url_name="plan-copies",
)
def carry_out(request: HttpRequest, name: str, given: CopiesIn) -> Any:
    """Carry out the plan's trials at copies of a simulated station, until none is left. Requires an operator."""
    plan, station = plan_get(name=name, user=request.auth), station_get(name=given.station)
    copies.request_trials(user=request.auth, plan=plan, station=station, count=given.count)
    return Status(202, copies.copies_state(plan, visibility_for_request(request)))


@router.delete(
    "/plans/{name}/copies",
    response={200: CopiesOut, **FAILURES},
    summary="Pause trials without people",
    url_name="plan-copies",
)
def pause(request: HttpRequest, name: str) -> Any:
    """Begin no further trial at copies; those at work are finished. Requires an operator."""
    plan = plan_get(name=name, user=request.auth)
    copies.pause_trials(user=request.auth, plan=plan)
    return copies.copies_state(plan, visibility_for_request(request))


@router.post(
    "/plans/{name}/close", response={200: PlanOut, **FAILURES}, summary="Close it", url_name="plan-close"
)
def close(request: HttpRequest, name: str, given: Reason) -> Any:
    """Stop handing out trials of the plan. Requires its owner or an administrator."""
    plan = plan_get(name=name, user=request.auth)
    return PlanOut.of(services.close_plan(user=request.auth, plan=plan, reason=given.reason), request.auth)


@router.post("/plans/{name}/look", response={200: PlanOut, **FAILURES}, summary="Look", url_name="plan-look")
def unblind(request: HttpRequest, name: str) -> Any:
    """Show the caller the hidden checkpoints before the reveal; this is recorded.

    From then on the caller can run none of the plan's trials.
    """
    plan = plan_get(name=name, user=request.auth)
    record_unblinding(plan, request.auth)
    return PlanOut.of(plan, request.auth)


@router.post(
    "/plans/{name}/reveal", response={200: PlanOut, **FAILURES}, summary="Reveal it", url_name="plan-reveal"
)
def reveal(request: HttpRequest, name: str) -> Any:
    """Publish the checkpoint of every trial; this cannot be undone. Requires the plan's owner or an administrator."""
    plan = plan_get(name=name, user=request.auth)
    return PlanOut.of(services.reveal_plan(user=request.auth, plan=plan), request.auth)


@router.get(
    "/stations/{name}/cameras",
    response={200: CamerasOut, **FAILURES},
    summary="Confirmed cameras",
    url_name="cameras",
)
def cameras(request: HttpRequest, name: str) -> Any:
    """Return the caller's confirmation of the cameras; it is valid until the station restarts, at most half a day."""
    return CamerasOut.of(bench.current_camera_check(user=request.auth, station=station_get(name=name)))


@router.post(
    "/stations/{name}/cameras",
    response={201: CamerasOut, **FAILURES},
    summary="Confirm the cameras",
    url_name="cameras-confirm",
)
def cameras_confirm(request: HttpRequest, name: str, given: CamerasIn) -> Any:
    """Confirm that each camera shows its reference; the current pictures are stored with the confirmation.

    Requires an operator.
    """
    check = bench.confirm_cameras(user=request.auth, station=station_get(name=name), first=given.first)
    return Status(201, CamerasOut.of(check))


@router.post(
    "/stations/{name}/references",
    response={201: list[ReferenceOut], **FAILURES},
    summary="Take reference pictures",
    url_name="references",
)
def references(request: HttpRequest, name: str, given: ReferenceIn) -> Any:
    """Store the cameras' current pictures as the references of a position's layout. Requires an operator."""
    position = None
    if given.scene is not None:
        scene = trials.scene_get(name=given.scene)
        position = trials.position_get(scene=scene, number=given.position or 0)
    rows = bench.record_references(user=request.auth, station=station_get(name=name), position=position)
    return Status(201, [ReferenceOut.of(row) for row in rows])


@router.post(
    "/references/{int:id}/regions",
    response={201: ReferenceOut, **FAILURES},
    summary="Draw regions of a reference picture",
    url_name="reference-regions",
)
def regions(request: HttpRequest, id: int, given: RegionsIn) -> Any:
    """Create another reference with the same picture and these regions, in which the bench is compared.

    Requires an operator.
    """
    drawn = [region.dict() for region in given.regions]
    row = bench.save_regions(user=request.auth, reference=reference_get(id=id), drawn=drawn)
    return Status(201, ReferenceOut.of(row))


@router.get(
    "/trials/{int:id}/bench",
    response={200: list[BenchOut], **FAILURES},
    summary="How the bench lies now",
    url_name="bench",
)
def bench_match(request: HttpRequest, id: int) -> Any:
    """Return how well each camera with a reference of the trial's position matches it now; nothing is stored."""
    matches = bench.current_matches(trial=trials.trial_get(id=id))
    return [
        {
            "camera": match.camera,
            "reference": match.reference.picture,
            "match": match.match,
            "regions": match.regions,
        }
        for match in matches
        if match.reference
    ]


@router.post(
    "/trials/{int:id}/achieved",
    response={201: list[LayoutOut], **FAILURES},
    summary="Keep how the bench is laid out",
    url_name="achieved",
)
def record_layout(request: HttpRequest, id: int, given: LayoutIn) -> Any:
    """Record before the run what the cameras show, and how well it matches the position's references.

    Requires an operator.
    """
    rows = bench.record_layout(user=request.auth, trial=trials.trial_get(id=id), override=given.override)
    return Status(201, [_seen(row) for row in rows])


def _seen(row: Achieved) -> dict[str, Any]:
    reference = row.reference.picture if row.reference else ""
    return {
        "camera": row.camera,
        "picture": row.picture,
        "reference": reference,
        "match": row.match,
        "regions": row.regions,
    }
