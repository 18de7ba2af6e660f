"""Lists of the result pages: plans with their progress, trials of a plan, current activity in the lab."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, dataclass
from datetime import datetime
from typing import Any
from urllib.parse import urlencode

from django.db.models import Case, Count, Exists, IntegerField, Max, Min, OuterRef, Q, QuerySet, Value, When

from evaweb.core.errors import EvaError, NotFound
from evaweb.plans.models import Plan, PlanState, Slot
from evaweb.stations.models import Station
from evaweb.trials.failure_text import is_unspecified
from evaweb.trials.failures import FIELDS
from evaweb.trials.models import MilestoneOutcome, Trial, TrialStatus
from evaweb.trials.selectors import UNFINISHED
from runtime.core.sentences import Pattern

_NO_REVEAL_HAS_DIGEST_STANDS = Pattern(
    "results.selectors.no_reveal_has_digest_stands",
    "no reveal has the digest {digest!r:.80}: it stands under Record on the page of its plan",
)
_PLAN_HAS_NO_VERSION_THERE = Pattern(
    "results.selectors.plan_has_no_version_there",
    "plan {name!r:.80} has no version {version}; there are: {there}",
)
_PLAN_DOES_NOT_EXIST = Pattern("results.selectors.plan_does_not_exist", "plan {name!r:.80} does not exist")
_STATE_ALLOWED = Pattern("results.selectors.state_allowed", "state = {state!r:.80}; allowed: {values}")
_STATUS_ALLOWED = Pattern("results.selectors.status_allowed", "status = {status!r:.80}; allowed: {values}")
_SUCCESS_ALLOWED_YES_NO = Pattern(
    "results.selectors.success_allowed_yes_no",
    "success = {success!r:.80}; allowed: yes, no",
)
_ALLOWED_NUMBER = Pattern("results.selectors.allowed_number", "{name} = {value!r:.80}; allowed: a number")

_HOUR = 3600
_ORDER = Case(
    When(state=PlanState.FROZEN, then=Value(0)),
    When(state=PlanState.DRAFT, then=Value(2)),
    default=Value(1),
    output_field=IntegerField(),
)


@dataclass(frozen=True, slots=True)
class PlanRow:
    """Plan with its progress.

    `foreseen` are the planned trials, `counted` those that count, `attempts` all attempts; `since` and `until` are the
    period of the attempts.
    """

    plan: Plan
    foreseen: int
    counted: int
    attempts: int
    since: datetime | None
    until: datetime | None

    @property
    def share(self) -> int:
        """Share of the planned trials that count [%], rounded."""
        return round(100 * self.counted / self.foreseen) if self.foreseen else 0

    @property
    def hours_left(self) -> float | None:
        """Remaining time at the pace so far [h]; None if nothing is left or the pace is unknown."""
        left = self.foreseen - self.counted
        if (
            self.counted < 2
            or left < 1
            or self.since is None
            or self.until is None
            or self.until <= self.since
        ):
            return None  # station clocks may differ: a negative pace is invalid
        return float((self.until - self.since).total_seconds() / _HOUR / self.counted * left)


@dataclass(frozen=True, slots=True)
class StationActivity:
    """Station with its unfinished trial, if any."""

    station: Station
    trial: Trial | None


@dataclass(frozen=True, slots=True)
class TrialQuery:
    """Query for trials of a plan; "" matches all.

    `success` is yes or no, `failure` and `failure_phase` may be "not specified", `missed` and `reached` are texts of
    milestones. `status` defaults to trials that count.
    """

    checkpoint: str = ""
    scene: str = ""
    position: str = ""
    station: str = ""
    operator: str = ""
    status: str = TrialStatus.SCORED.value
    success: str = ""
    failure: str = ""
    failure_phase: str = ""
    missed: str = ""
    reached: str = ""

    @property
    def query(self) -> str:
        """Query string of the filters."""
        return urlencode({name: value for name, value in asdict(self).items() if value})


def plan_at_reveal(digest: str) -> Plan:
    """Return the plan whose reveal has this digest.

    Raises:
        NotFound: If there is none.
    """
    plan = Plan.objects.filter(at_reveal__digest=digest).first()
    if plan is None:
        raise NotFound(_NO_REVEAL_HAS_DIGEST_STANDS(digest=digest))
    return plan


def plan_get(*, name: str, version: int | None = None) -> Plan:
    """Return version `version` of the plan, or without it the newest version.

    Raises:
        NotFound: If it does not exist; the message names the versions.
    """
    rows = Plan.objects.select_related("owner", "first", "second", "evaluation", "revealed_by", "amends")
    versions = list(rows.filter(name=name).order_by("-version"))
    matches = [row for row in versions if version in (None, row.version)]
    if not matches:
        numbers = ", ".join(str(row.version) for row in versions)
        raise NotFound(
            _PLAN_HAS_NO_VERSION_THERE(name=name, version=version, there=numbers)
            if numbers
            else _PLAN_DOES_NOT_EXIST(name=name)
        )
    return matches[0]


def plan_list(state: str = "", words: str = "") -> QuerySet[Plan]:
    """Return running plans, then ended ones, then drafts, newest first.

    If given, `state` is the only state, and `words` are part of title or name.

    Raises:
        EvaError: If there is no such state.
    """
    rows = Plan.objects.select_related("owner").defer("document", "key").order_by(_ORDER, "-frozen_at", "-pk")
    if state and state not in PlanState.values:
        raise EvaError(_STATE_ALLOWED(state=state, values=", ".join(PlanState.values)))
    rows = rows.filter(state=state) if state else rows
    return rows.filter(Q(title__icontains=words) | Q(name__icontains=words)) if words else rows


def plan_rows(plans: Iterable[Plan]) -> list[PlanRow]:
    """Return the plans with their progress, in two queries.

    The progress does not depend on checkpoints, so that it reveals nothing.
    """
    listed = list(plans)
    slots = Slot.objects.filter(plan__in=listed).order_by().values_list("plan").annotate(n=Count("pk"))
    foreseen: dict[int, int] = dict(slots)
    trials = Trial.objects.filter(
        evaluation__in=[plan.evaluation_id for plan in listed if plan.evaluation_id]
    )
    counts = (
        trials.order_by()
        .values("evaluation")
        .annotate(
            attempts=Count("pk"),
            counted=Count("pk", filter=Q(status=TrialStatus.SCORED)),
            since=Min("prepared_at"),
            until=Max("ended_at"),
        )
    )
    by_evaluation = {row.pop("evaluation"): row for row in counts}
    nothing: dict[str, Any] = {"attempts": 0, "counted": 0, "since": None, "until": None}
    return [
        PlanRow(plan, foreseen.get(plan.pk, 0), **by_evaluation.get(plan.evaluation_id, nothing))
        for plan in listed
    ]


def trials_of_plan(plan: Plan, question: TrialQuery) -> QuerySet[Trial]:
    """Return the trials that match, in order of allocation.

    Raises:
        EvaError: If a value is not allowed.
    """
    named = ("checkpoint", "scene", "position", "station", "operator", "verdict", "episode", "handout")
    rows = (
        Trial.objects.filter(evaluation=plan.evaluation_id).select_related(*named).order_by("handout__number")
    )
    fields = {
        "checkpoint": "checkpoint__name",
        "scene": "scene__name",
        "station": "station__name",
        "operator": "operator__username",
    }
    for name, field in fields.items():
        if value := getattr(question, name):
            rows = rows.filter(**{field: value})
    for name in FIELDS:
        if value := getattr(question, name):
            rows = rows.filter(**{f"verdict__{name}": "" if is_unspecified(value) else value})
    if question.position:
        rows = rows.filter(position__number=_whole("position", question.position))
    if question.status:
        if question.status not in TrialStatus.values:
            raise EvaError(_STATUS_ALLOWED(status=question.status, values=", ".join(TrialStatus.values)))
        rows = rows.filter(status=question.status)
    if question.success:
        if question.success not in ("yes", "no"):
            raise EvaError(_SUCCESS_ALLOWED_YES_NO(success=question.success))
        rows = rows.filter(verdict__success=question.success == "yes")
    for name, reached in (("missed", False), ("reached", True)):
        if value := getattr(question, name):
            rows = rows.filter(
                Exists(
                    MilestoneOutcome.objects.filter(score=OuterRef("verdict"), text=value, reached=reached)
                )
            )
    return rows


def _whole(name: str, value: str) -> int:
    if not (value.isascii() and value.isdecimal() and len(value) < 7):
        raise EvaError(_ALLOWED_NUMBER(name=name, value=value))
    return int(value)


def station_activity() -> list[StationActivity]:
    """Return every active station with its unfinished trial."""
    stations = list(Station.objects.filter(active=True).order_by("name"))
    at_station = Trial.objects.filter(station__in=stations, worker=None)  # not at copies of it
    open_ones = at_station.filter(status__in=UNFINISHED).select_related(
        "scene", "position", "checkpoint", "evaluation", "operator", "handout__plan"
    )
    by_station = {trial.station_id: trial for trial in open_ones.order_by("pk")}
    return [StationActivity(station, by_station.get(station.pk)) for station in stations]


def recent_trials(limit: int = 12) -> QuerySet[Trial]:
    """Return the trials that were started most recently."""
    named = (
        "scene",
        "position",
        "checkpoint",
        "evaluation",
        "station",
        "operator",
        "verdict",
        "handout__plan",
    )
    return Trial.objects.filter(started_at__isnull=False).select_related(*named).order_by("-pk")[:limit]
