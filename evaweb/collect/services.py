"""Services for sessions: open, close, resume, publish. The line on disk is written before the row."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from django.db import IntegrityError, transaction
from django.utils import timezone

from evaweb.accounts.roles import Role, require_role
from evaweb.collect import selectors
from evaweb.collect.models import CollectSession, Result, SessionEvent, SessionEventKind
from evaweb.collect.record import SESSIONS, EventLine
from evaweb.collect.setups import require_same_setup, setup_from_snapshot
from evaweb.core.errors import Conflict, EvaError
from evaweb.episodes.publishing import DATASET_NAME
from evaweb.episodes.services import request_publish
from evaweb.jobs.models import Job
from evaweb.records.journal import clean_text
from evaweb.stations.lease_holders import holder_display_name
from evaweb.stations.models import Station
from evaweb.stations.runtime_client import connection_to
from runtime.core.sentences import Pattern, fixed

_TASK_EMPTY_SAY_WHAT_DEMONSTRATED = fixed(
    "collect.services.task_empty_say_what_demonstrated",
    "task is empty: say what is to be demonstrated",
)
_STATION_SWITCHED_OFF_CHOOSE_ANOTHER = Pattern(
    "collect.services.station_switched_off_choose_another",
    "station {name} is switched off: choose another, or ask an administrator",
)
_SOMEONE_ELSE_OPENED_SESSION_AT = Pattern(
    "collect.services.someone_else_opened_session_at",
    "someone else opened a session at {name} at the same moment: look at it",
)
_EPISODE_BEING_RECORDED_STOP_FIRST = fixed(
    "collect.services.episode_being_recorded_stop_first",
    "an episode of it is being recorded: stop it first",
)
_SESSION_CLOSED_ALREADY = Pattern(
    "collect.services.session_closed_already", "session {session} is closed already"
)
_RESULTS_ALLOWED_SOME = Pattern(
    "collect.services.results_allowed_some",
    "results = {results}; allowed: some of {allowed}",
)
_VERSION_ALLOWED = Pattern(
    "collect.services.version_allowed",
    "version = {version!r:.20}; allowed: {versions}{why}",
)
_NOTHING_PUBLISH_EPISODES_WHOLE_NOT = Pattern(
    "collect.services.nothing_publish_episodes_whole_not",
    "nothing to publish: episodes that are whole, not discarded, failed by no review, labelled "
    "{results} and in no dataset yet",
)
_SESSION_OPEN_AT_CLOSE_FIRST = Pattern(
    "collect.services.session_open_at_close_first",
    "a session is open at {name} ({other}): close it first",
)
_COMMANDS_ASK_FOR_FIRST = Pattern(
    "collect.services.commands_ask_for_first",
    "{holder} commands {name}: ask for it first",
)
_DATASET_ALLOWED_1_100_LETTERS = Pattern(
    "collect.services.dataset_allowed_1_100_letters",
    "dataset = {name!r:.110}; allowed: 1 to 100 letters, digits, '.', '_' and '-', the first a letter "
    "or digit",
)
_DATASET_NAMES_WITH_THOSE_POLICIES = Pattern(
    "collect.services.dataset_names_with_those_policies",
    "dataset = {name!r}: names with {rollouts} are those of policies' runs; choose another",
)
_TARGET_ALLOWED_1_NONE = Pattern(
    "collect.services.target_allowed_1_none",
    "target = {target}; allowed: 1 to {highest_target}, or none",
)

LONGEST_TASK = 2000  # characters; the limit of a station
HIGHEST_TARGET = 100_000
_ROLLOUTS = "rollouts"  # reserved prefix of datasets with policies' runs


def open_session(
    *, user: Any, station: Station, task: str, dataset: str = "", target: int | None = None
) -> CollectSession:
    """Open a session with the station's present set-up.

    The user must be an operator, and no other user may command the station. If `dataset` is "", the session uses the
    deployment's dataset.

    Raises:
        Conflict: A session is open at the station.
        SetupChanged: The dataset was collected with another set-up; the message lists every difference.
    """
    require_role(user, Role.OPERATOR)
    task = clean_text("task", task, LONGEST_TASK)
    if not task:
        raise EvaError(_TASK_EMPTY_SAY_WHAT_DEMONSTRATED)
    _check_target(target)
    if not station.active:
        raise Conflict(_STATION_SWITCHED_OFF_CHOOSE_ANOTHER(name=station.name))
    snapshot = _commanded_snapshot(user, station)
    setup = setup_from_snapshot(snapshot, station.name)
    dataset = _dataset(dataset or snapshot["collect"]["dataset"])
    before = selectors.session_list(dataset=dataset).filter(station__simulated=station.simulated).first()
    if before is not None:
        require_same_setup(setup, before.setup, f"the dataset {dataset}")
    _require_none_open(station)
    session = CollectSession(
        station=station, dataset=dataset, task=task, operator=user, target=target, setup=setup
    )
    try:
        with transaction.atomic():
            session.save(force_insert=True)
            _record_event(session, user, SessionEventKind.OPENED)
    except IntegrityError:
        raise Conflict(_SOMEONE_ELSE_OPENED_SESSION_AT(name=station.name)) from None
    return session


def close_session(*, user: Any, session: CollectSession) -> CollectSession:
    """Close a session; it can be resumed. Raises: Conflict while one of its episodes is being recorded."""
    require_role(user, Role.OPERATOR)
    snapshot = _commanded_snapshot(user, session.station, needed=False)
    running = (snapshot.get("collect") or {}).get("episode")
    if running and session.demonstrations.filter(pk=running).exists():
        raise Conflict(_EPISODE_BEING_RECORDED_STOP_FIRST)
    with transaction.atomic():
        locked = _lock_session(session)
        if locked.closed_at is not None:
            raise Conflict(_SESSION_CLOSED_ALREADY(session=locked.pk))
        locked.closed_at = timezone.now()
        _record_event(locked, user, SessionEventKind.CLOSED)
        locked.save(update_fields=["closed_at"])
    return locked


def resume_session(*, user: Any, session: CollectSession) -> CollectSession:
    """Resume a closed session, of any age. Raises: SetupChanged if the station's set-up has changed."""
    require_role(user, Role.OPERATOR)
    station = session.station
    require_same_setup(
        setup_from_snapshot(_commanded_snapshot(user, station), station.name),
        session.setup,
        f"session {session}",
    )
    _require_none_open(station)
    try:
        with transaction.atomic():
            locked = _lock_session(session)
            locked.closed_at = None
            locked.save(update_fields=["closed_at"])
            _record_event(locked, user, SessionEventKind.RESUMED)
    except IntegrityError:
        raise Conflict(_SOMEONE_ELSE_OPENED_SESSION_AT(name=station.name)) from None
    return locked


@transaction.atomic
def set_session_target(*, user: Any, session: CollectSession, target: int | None) -> CollectSession:
    """Set the desired number of episodes, None for no target."""
    require_role(user, Role.OPERATOR)
    _check_target(target)
    locked = _lock_session(session)
    locked.target = target
    _record_event(locked, user, SessionEventKind.TARGET, f"{target or 'none'}")
    locked.save(update_fields=["target"])
    return locked


def publish_session(
    *,
    user: Any,
    session: CollectSession,
    results: Sequence[str] = selectors.PUBLISHED_RESULTS,
    version: str = "",
) -> list[Job]:
    """Queue the publication of the session's accepted episodes that are in no dataset yet, and return the jobs.

    Only episodes with one of the `results` are published. `version` is the version of a new dataset; "" selects the
    version of the existing dataset or, for a new one, the default.

    Raises: Conflict if there is nothing to publish, or the dataset has another version.
    """
    require_role(user, Role.OPERATOR)
    allowed = [result.value for result in Result if result.value]
    if not results or set(results) - set(allowed):
        raise EvaError(
            _RESULTS_ALLOWED_SOME(results=", ".join(results) or "none", allowed=", ".join(allowed))
        )
    dataset = selectors.dataset_of(session=session)
    if dataset.problem:
        raise Conflict(dataset.problem)
    if version and version not in dataset.versions:
        suffix = f": {dataset.name} is of that version already, convert it" if dataset.version else ""
        raise Conflict(_VERSION_ALLOWED(version=version, versions=", ".join(dataset.versions), why=suffix))
    waiting = list(selectors.unpublished_demonstrations(session=session, results=tuple(results)))
    if not waiting:
        raise Conflict(_NOTHING_PUBLISH_EPISODES_WHOLE_NOT(results=" or ".join(results)))
    chosen = version or dataset.versions[0]
    with transaction.atomic():
        _record_event(
            _lock_session(session),
            user,
            SessionEventKind.PUBLISHED,
            f"{len(waiting)} episodes into {dataset.name}",
        )
        jobs = [request_publish(episode=demonstration.episode, version=chosen) for demonstration in waiting]
    return [job for job in jobs if job is not None]


def _record_event(session: CollectSession, user: Any, kind: SessionEventKind, text: str = "") -> None:
    """Write an event to disk and database; the caller holds a lock on the session's row."""
    event = SessionEvent(session=session, kind=kind, text=text, by=user, at=timezone.now())
    SESSIONS.append(session.pk, EventLine.written(event))
    event.save(force_insert=True)


def _lock_session(session: CollectSession) -> CollectSession:
    rows = CollectSession.objects.select_for_update(of=("self",)).select_related("station", "operator")
    return rows.get(pk=session.pk)


def _require_none_open(station: Station) -> None:
    open_one = selectors.session_open(station=station)
    if open_one is not None:
        raise Conflict(_SESSION_OPEN_AT_CLOSE_FIRST(name=station.name, other=open_one))


def _commanded_snapshot(user: Any, station: Station, *, needed: bool = True) -> dict[str, Any]:
    """Return the station's snapshot; {} if the station does not respond and the snapshot is not `needed`.

    Raises: Conflict while another user commands the station.
    """
    try:
        snapshot = connection_to(station.name).status()
    except EvaError:
        if needed:
            raise
        return {}
    holder = holder_display_name((snapshot.get("lease") or {}).get("holder") or "")
    if holder and holder != user.get_username():
        raise Conflict(_COMMANDS_ASK_FOR_FIRST(holder=holder, name=station.name))
    return dict(snapshot)


def _dataset(name: str) -> str:
    if not DATASET_NAME.fullmatch(name):
        raise EvaError(_DATASET_ALLOWED_1_100_LETTERS(name=name))
    if name.lower().startswith(_ROLLOUTS):
        raise EvaError(_DATASET_NAMES_WITH_THOSE_POLICIES(name=name, rollouts=_ROLLOUTS))
    return name


def _check_target(target: int | None) -> None:
    if target is not None and not 1 <= target <= HIGHEST_TARGET:
        raise EvaError(_TARGET_ALLOWED_1_NONE(target=target, highest_target=HIGHEST_TARGET))
