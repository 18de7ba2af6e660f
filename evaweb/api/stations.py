"""Stations: states, lease holders, commands, e-stop, new trials."""

from __future__ import annotations

from collections.abc import Callable
from datetime import datetime
from typing import Annotated, Any, Literal
from uuid import UUID, uuid4

from django.http import HttpRequest
from django.utils import timezone
from ninja import Field, Router, Schema, Status
from pydantic import AfterValidator, ValidationError, field_validator

from evaweb.api.responses import FAILURES, Body, ErrorOut
from evaweb.api.trials import TrialDetail
from evaweb.blinding.visibility import Visibility, visibility_for_request
from evaweb.collect.selectors import session_get
from evaweb.collect.station_commands import session_command
from evaweb.core.errors import EvaError, StationGone, reasoned
from evaweb.datasets.robot_replay import replay_command
from evaweb.stations import commands, leases, selectors, stops
from evaweb.stations import redaction as veil
from evaweb.stations.lease_holders import holder_display_name
from evaweb.stations.models import Command, CommandStatus, LeaseRequest, Station
from evaweb.stations.runtime_client import connection_to
from evaweb.trials import selectors as trial_selectors
from evaweb.trials import services
from evaweb.trials.station_commands import checkpoint_command, trial_command
from runtime.core.sentences import Pattern

_SEVERAL_NAMED = Pattern(
    "api.stations.several_named",
    "{named}: each has its own arguments, name one of them",
)
_SESSION_OF_ANOTHER = Pattern(
    "api.stations.session_of_another",
    "session {session} is one of {station}, not of {other}",
)
_TRIAL_OF_ANOTHER = Pattern(
    "api.stations.trial_of_another", "trial {trial} is one of {station}, not of {other}"
)
_REQUEST_MISSING = Pattern(
    "api.stations.request_missing",
    "request is missing: {action} answers somebody's request, name its id",
)

router = Router(tags=["stations"])
PageId = Annotated[str, Field(pattern=r"^[A-Za-z0-9_-]{1,64}$", description="Made by the page at random")]
_NAMED = ("trial", "checkpoint", "session", "replay")  # alternatives, each with its own arguments
HTTP_OF = {
    CommandStatus.ACCEPTED: 200,
    CommandStatus.DONE: 200,
    CommandStatus.REFUSED: 409,
    CommandStatus.FAILED: 409,
    CommandStatus.PRESSED: 504,
    CommandStatus.UNKNOWN: 504,
}


class RequestOut(Schema):
    """A user's request for the station."""

    id: int
    user: str
    asked_at: datetime

    @staticmethod
    def of(asked: LeaseRequest) -> dict[str, Any]:
        """Return the request with the user's name."""
        return {"id": asked.pk, "user": asked.user.get_username(), "asked_at": asked.asked_at}


class LeaseOut(Schema):
    """Holder of a station's lease ("" for none), and the open requests for it."""

    holder: str
    user: str
    epoch: int
    granted_at: datetime | None
    requests: list[RequestOut]

    @staticmethod
    def of(station: Station) -> dict[str, Any]:
        """Return the lease as stored in the database now."""
        lease = selectors.lease_open(station=station)
        return {
            "holder": lease.holder if lease else "",
            "user": holder_display_name(lease.holder) if lease else "",
            "epoch": lease.epoch if lease else 0,
            "granted_at": lease.granted_at if lease else None,
            "requests": [RequestOut.of(request) for request in selectors.request_list(station=station)],
        }


class StationOut(Schema):
    """A robot on a bench."""

    name: str
    title: str
    robot: str
    simulated: bool
    active: bool
    message: str
    lease: LeaseOut

    @staticmethod
    def of(station: Station) -> dict[str, Any]:
        """Return the station with the holder of its lease."""
        plain = ("name", "title", "robot", "simulated", "active", "message")
        return {**{name: getattr(station, name) for name in plain}, "lease": LeaseOut.of(station)}


class StationDetail(StationOut):
    """A station with the runtime's newest snapshot, or the reason why there is none, and its unfinished trial.

    While the station runs a blind plan, everything that reveals its checkpoint is removed from the snapshot, which is
    then marked "veiled".
    """

    snapshot: dict[str, Any] | None
    gone: str
    trial: TrialDetail | None


class LeaseIn(Body):
    """Action on a lease; `request` is the id of another user's request, `reason` is an administrator's for taking it.

    `move` transfers the caller's own lease from another page to this one.
    """

    action: Literal["claim", "give_up", "request", "withdraw", "hand_over", "decline", "move", "take"]
    page: PageId
    request: int | None = None
    reason: str = ""


def _no_trial(args: dict[str, Any]) -> dict[str, Any]:
    """Return `args`.

    Raises: ValueError if `args` has a key `trial`. The command has a field of that name instead: a run with it is
    checked against the trial first, see evaweb.trials.station_commands.
    """
    if "trial" in args:
        raise ValueError("args name a trial: name it beside them, as `trial`")
    return args


class ReplayIn(Body):
    """A recorded episode, by its uuid or as DATASET:INDEX; `robot` names the robot of a dataset's values."""

    episode: Annotated[str, Field(min_length=1, max_length=220)]
    space: Literal["joint", "eef"] = "joint"
    robot: Annotated[str, Field(max_length=63)] = ""


class CommandIn(Body):
    """A discrete command; `boot` and `sequence` are those of the snapshot that the decision was based on.

    With `trial`, set-up and run get their arguments from the trial, with `session` from the collecting session.
    `checkpoint` (name or id) and `replay` are for a set-up without them. Only administrators may pass their own tables.
    """

    uuid: UUID
    kind: Annotated[str, Field(description=f"One of {', '.join(commands.KINDS)}")]
    args: Annotated[dict[str, Any], AfterValidator(_no_trial), Field(default_factory=dict)]
    page: PageId
    epoch: Annotated[int, Field(ge=0, le=2**53)] = 0
    boot: Annotated[str, Field(max_length=64)] = ""
    sequence: Annotated[int, Field(ge=0, le=2**53)] = 0
    trial: int | None = None
    checkpoint: str | int | None = None
    session: UUID | None = None
    replay: ReplayIn | None = None


class CommandOut(Schema):
    """Result of a command: 200 accepted or done, 409 refused or failed, 504 unknown.

    For a trial of a blind plan, `reason` and `data` do not contain what would reveal its checkpoint.
    """

    uuid: UUID
    status: CommandStatus
    reason: str
    id: Annotated[str, Field(description="Of the reason; empty where it has none, or was said before")] = ""
    arguments: Annotated[dict[str, Any], Field(default_factory=dict, description="Of the reason")]
    allowed: list[str]
    data: dict[str, Any]


class EStopIn(Schema):
    """Reason of a press of the e-stop.

    A request that repeats a uuid is the same press. A press is valid whatever the request contains.
    """

    uuid: UUID | None = None
    why: str = "pressed"

    @field_validator("uuid", mode="wrap")
    @classmethod
    def _any_uuid(cls, given: Any, read: Callable[[Any], UUID | None]) -> UUID | None:
        try:
            return read(given)
        except ValidationError:
            return None

    @field_validator("why", mode="before")
    @classmethod
    def _any_words(cls, given: Any) -> str:
        return stops.clean_reason(given) if isinstance(given, str) and given else "pressed"


class TrialIn(Body):
    """Trial to be prepared: scene and checkpoint by name or id, the position by its number."""

    scene: str | int
    position: int
    checkpoint: str | int
    seed: int | None = None


ANSWERS = {200: CommandOut, 504: CommandOut, frozenset({400, 401, 403, 404, 422, 503}): ErrorOut}


@router.get("", response={200: list[StationOut], **FAILURES}, summary="Stations", url_name="stations")
def stations(request: HttpRequest, inactive: bool = False) -> Any:
    """Return the stations that operators may choose; with `inactive` also those that are switched off."""
    return [StationOut.of(row) for row in selectors.station_list(all_of_them=inactive)]


@router.get("/{name}", response={200: StationDetail, **FAILURES}, summary="One station", url_name="station")
def station(request: HttpRequest, name: str) -> Any:
    """Return a station with its newest snapshot; `gone` says why there is none."""
    row = selectors.station_get(name=name)
    snapshot, gone = None, ""
    try:
        snapshot = connection_to(name).status()
    except StationGone as fault:
        gone = str(fault)
    visibility, unfinished = visibility_for_request(request), trial_selectors.trial_open(row)
    if snapshot is not None and visibility.redacts_snapshot(name, snapshot):
        snapshot = veil.redact_state(snapshot, visibility)
    trial = TrialDetail.of(trial_selectors.trial_get(id=unfinished.pk), visibility) if unfinished else None
    return {**StationOut.of(row), "snapshot": snapshot, "gone": gone, "trial": trial}


@router.post(
    "/{name}/lease", response={200: LeaseOut, **FAILURES}, summary="Take, give, ask", url_name="lease"
)
def lease(request: HttpRequest, name: str, given: LeaseIn) -> Any:
    """Claim, request, hand over, move or give up the station's lease; returns its state afterwards."""
    row, user, page = selectors.station_get(name=name), request.auth, given.page
    if given.action == "claim":
        leases.claim(user=user, station=row, page=page)
    elif given.action == "give_up":
        leases.release(user=user, station=row, page=page)
    elif given.action == "request":
        leases.request_handover(user=user, station=row, page=page)
    elif given.action == "withdraw":
        leases.withdraw_request(user=user, station=row)
    elif given.action == "move":
        leases.move(user=user, station=row, page=page)
    elif given.action == "take":
        leases.take_over(user=user, station=row, page=page, reason=given.reason)
    else:
        answer = leases.hand_over if given.action == "hand_over" else leases.decline_request
        answer(user=user, station=row, page=page, request=_request_of(given))
    return LeaseOut.of(row)


@router.post(
    "/{name}/commands",
    response={**ANSWERS, 409: CommandOut | ErrorOut},
    summary="Give a command",
    url_name="commands",
)
def command(request: HttpRequest, name: str, given: CommandIn) -> Any:
    """Send a command: set-up, run, stop, modes, strategy, motions, grippers.

    A request that repeats a uuid is not carried out again; it gets the first answer.
    """
    target, visibility = selectors.station_get(name=name), visibility_for_request(request)
    order = given.model_dump(exclude=set(_NAMED))
    named = [name for name in _NAMED if getattr(given, name) is not None]
    if len(named) > 1:
        raise EvaError(_SEVERAL_NAMED(named=" and ".join(named)))
    if given.session is not None:
        session = session_get(uuid=given.session)
        if session.station_id != target.pk:
            raise EvaError(
                _SESSION_OF_ANOTHER(session=session, station=session.station.name, other=target.name)
            )
        row = session_command(user=request.auth, session=session, **order)
    elif given.checkpoint is not None:
        checkpoint = trial_selectors.checkpoint_get(name=given.checkpoint, sight=visibility)
        row = checkpoint_command(user=request.auth, station=target, checkpoint=checkpoint, **order)
    elif given.replay is not None:
        row = replay_command(user=request.auth, station=target, **given.replay.model_dump(), **order)
    elif given.trial is None:
        row = commands.issue_command(user=request.auth, station=target, **order)
    else:
        trial = trial_selectors.trial_get(id=given.trial)
        if trial.station_id != target.pk:
            raise EvaError(_TRIAL_OF_ANOTHER(trial=trial.pk, station=trial.station.name, other=target.name))
        row = trial_command(user=request.auth, trial=trial, **order)
    return Status(HTTP_OF[CommandStatus(row.status)], _command_out(row, visibility))


@router.post(
    "/{name}/estop", response={**ANSWERS, 409: CommandOut | ErrorOut}, summary="E-stop", url_name="estop"
)
def estop(request: HttpRequest, name: str, given: EStopIn | None = None) -> Any:
    """Stop the robot now; any logged-in user may.

    The press goes to the station before it is written to the database.
    """
    # In a served lab evaweb.api.stop_gateway answers first, even if the database cannot verify the login.
    given, at = given or EStopIn(), timezone.now()
    identity, user = given.uuid or uuid4(), request.auth
    answer = stops.press_estop(
        station=name, username=user.get_username(), why=given.why, uuid=identity
    ).result()
    place = Station(name=name)
    commands.record_estop(user=user, station=place, why=given.why, uuid=identity, answer=answer, at=at)
    fields = {name: getattr(answer, name) for name in ("status", "allowed", "data")}
    return Status(HTTP_OF[answer.status], {"uuid": identity, **fields, **reasoned(answer.reason)})


@router.post(
    "/{name}/trials", response={201: TrialDetail, **FAILURES}, summary="Prepare a trial", url_name="prepare"
)
def prepare(request: HttpRequest, name: str, given: TrialIn) -> Any:
    """Prepare the next trial of a checkpoint at a position, or the repetition of one that does not count."""
    scene = trial_selectors.scene_get(name=given.scene)
    trial = services.prepare_trial(
        user=request.auth,
        station=selectors.station_get(name=name),
        scene=scene,
        position=trial_selectors.position_get(scene=scene, number=given.position),
        checkpoint=trial_selectors.checkpoint_get(
            name=given.checkpoint, sight=visibility_for_request(request)
        ),
        seed=given.seed,
    )
    return Status(
        201, TrialDetail.of(trial_selectors.trial_get(id=trial.pk), visibility_for_request(request))
    )


def _request_of(body: LeaseIn) -> int:
    if body.request is None:
        raise EvaError(_REQUEST_MISSING(action=body.action))
    return body.request


def _command_out(row: Command, visibility: Visibility) -> dict[str, Any]:
    reason, data = row.reason, row.data
    if visibility.redacts_events(row.station.name) or visibility.redacts_snapshot(row.station.name, row.args):
        reason, data = visibility.redact_text(row.reason), veil.redact_answer(row.data)
    fields = {"uuid": row.pk, "status": row.status, "allowed": row.allowed}
    return {**fields, **reasoned(reason), "data": data}
