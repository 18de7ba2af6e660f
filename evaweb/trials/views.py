"""Result pages: statistics of trials, and one trial in detail."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any
from uuid import uuid4

from django.http import HttpRequest, HttpResponse
from django.shortcuts import redirect, render
from django.utils.http import urlencode
from django.views.decorators.http import require_GET, require_POST

from evaweb.accounts.roles import Role, role_of
from evaweb.blinding.visibility import Visibility, visibility_for_request
from evaweb.core.errors import EvaError, NotAllowed
from evaweb.episodes.selectors import playback_stage
from evaweb.serving.lists import (
    DAY,
    Column,
    Filter,
    Listing,
)
from evaweb.stations.selectors import station_list
from evaweb.trials import failures, lifecycle, selectors, services, voids
from evaweb.trials.lifecycle import Transition
from evaweb.trials.models import Trial, TrialStatus
from evaweb.trials.rate_bars import scene_figures
from evaweb.trials.record import visible_labels
from evaweb.trials.selectors import TrialFilters

PER_PAGE = 50


_MOMENT = ("t", "from", "to", "loop")  # of the address: what is played, here and in Replay


@require_GET
def result(request: HttpRequest) -> HttpResponse:
    """Show success per scene and checkpoint, then the trials; filters and order are in the URL."""
    visibility = visibility_for_request(request)
    listing = Listing(request.GET, _columns(visibility), _filters(visibility))
    filters = TrialFilters(**listing.chosen)
    try:
        filters.apply(Trial.objects.all(), visibility)
    except EvaError as fault:
        listing.refuse(fault)
        filters = TrialFilters()
    rows = selectors.statistics(
        replace(filters, status=""), visibility
    )  # the status filters only the list of trials
    context = {
        "figures": scene_figures(rows),
        "page": listing.page(selectors.trial_list(filters, visibility), PER_PAGE),
        "listing": listing,
    }
    fragment = request.headers.get("HX-Request") and not request.headers.get("HX-History-Restore-Request")
    return render(request, "trials/body.html" if fragment else "trials/result.html", context)


@require_GET
def trial(request: HttpRequest, id: int) -> HttpResponse:
    """Show one trial."""
    return _trial_page(request, id)


@require_POST
def score(request: HttpRequest, id: int) -> HttpResponse:
    """Score a trial or correct its score; on an error the form keeps the typed values."""
    row = selectors.trial_get(id=id)
    ticked = set(request.POST.getlist("milestone"))
    milestones = {key: str(key) in ticked for key in row.scene.milestones.values_list("pk", flat=True)}
    values = {name: request.POST.get(name, "") for name in ("note", "reason", *failures.FIELDS)}
    try:
        services.score_trial(
            user=request.user,  # type: ignore[arg-type]
            trial=row,
            milestones=milestones,
            success={"yes": True, "no": False}.get(request.POST.get("success", "")),
            uuid=request.POST.get("uuid") or None,
            **values,
        )
    except EvaError as fault:
        typed = {**values, "milestones": milestones, "success": request.POST.get("success", "")}
        return _trial_page(request, id, fault=fault, typed=typed)
    return redirect("result-trial", id=id)


@require_POST
def void(request: HttpRequest, id: int) -> HttpResponse:
    """Void a trial."""
    reason = request.POST.get("void_reason", "")
    try:
        voids.void_trial(
            user=request.user,  # type: ignore[arg-type]
            trial=selectors.trial_get(id=id),
            reason=reason,
        )
    except EvaError as fault:
        return _trial_page(request, id, fault=fault, typed={"void_reason": reason})
    return redirect("result-trial", id=id)


@require_POST
def void_answer(request: HttpRequest, id: int) -> HttpResponse:
    """Agree to a void request, or refuse it."""
    try:
        voids.answer_void(
            user=request.user,  # type: ignore[arg-type]
            trial=selectors.trial_get(id=id),
            agree=request.POST.get("agree") == "yes",
            reason=request.POST.get("answer_reason", ""),
        )
    except EvaError as fault:
        return _trial_page(request, id, fault=fault)
    return redirect("result-trial", id=id)


def _truth(trial: Trial) -> list[tuple[str, Any]]:
    """Return (name, reached) of each milestone in the simulated bench's ground truth.

    The caller must hide them from a blind trial's operator before scoring.
    """
    return sorted((trial.truth or {}).get("milestones", {}).items())


def _trial_page(
    request: HttpRequest, id: int, fault: EvaError | None = None, typed: Mapping[str, Any] | None = None
) -> HttpResponse:
    trial = selectors.trial_get(id=id)
    hidden = visibility_for_request(request).hides(trial)
    operator = role_of(request.user) is not Role.VIEWER
    milestones = list(trial.scene.milestones.order_by("order"))
    typed = typed or _as_scored(trial)
    context = {
        "trial": trial,
        "episode": trial.episode,
        "stage": playback_stage(episode=trial.episode) if trial.episode else None,
        "scores": list(trial.scores.all()),
        "truth": () if hidden and not trial.verdict_id else _truth(trial),
        "milestones": [(milestone, _is_checked(trial, milestone.pk, typed)) for milestone in milestones],
        "implied": any(milestone.required for milestone in milestones),
        "fails": services.failing(trial),
        "may_score": operator and lifecycle.allows(trial, Transition.SCORE),
        "words_alone": _text_only_reason(trial, request.user) if trial.verdict_id else "",
        "may_void": operator
        and lifecycle.allows(trial, Transition.VOID)
        and trial.status != TrialStatus.VOID_ASKED,
        "by_two": voids.needs_two_people(trial),
        "void_requests": list(trial.void_requests.all()),
        "may_answer": operator and voids.can_answer_void(trial, request.user),
        "attempts": selectors.attempts_of(trial=trial),
        # Times of set-up and run would reveal how long a policy warms up.
        "commands": () if hidden else selectors.commands_of(trial=trial),
        "hidden": hidden,
        "laid_out": bench_images(trial),
        "moment": urlencode({key: request.GET[key] for key in _MOMENT if key in request.GET}),
        "further": visible_labels(trial, visibility_for_request(request)),
        "fault": fault,
        "typed": typed,
        "failures": failures.failure_choices(typed),
        "uuid": uuid4(),  # uuid of this page's score, so that sending it again is recognised
    }
    return render(request, "trials/trial.html", context, status=fault.status if fault else 200)


def _text_only_reason(trial: Trial, user: Any) -> str:
    """Return why this user may correct only texts of the score; "" if they may also change its outcome."""
    try:
        services.require_own(trial, user)
    except NotAllowed as refused:
        return str(refused)
    return ""


def bench_images(trial: Trial) -> list[Any]:
    """Return the newest camera images before the run, one per camera; evaweb.plans attaches them to trials."""
    newest: dict[str, Any] = {}
    for row in trial.achieved.select_related("reference", "by").order_by("pk"):
        newest[row.camera] = row
    return list(newest.values())


def _is_checked(trial: Trial, milestone: int, typed: Mapping[str, Any] | None) -> bool:
    """Return True if the milestone's box is ticked on the score form.

    The box is as the user `typed` it in a refused form; without such a form, it is as in the newest score.
    """
    if typed and "milestones" in typed:
        return bool(typed["milestones"].get(milestone))
    outcomes = trial.scores.all()[0].outcomes.all() if trial.verdict_id else ()
    return any(outcome.reached for outcome in outcomes if outcome.milestone_id == milestone)


def _as_scored(trial: Trial) -> dict[str, Any]:
    """Return the current score as initial form values of a correction."""
    verdict = trial.verdict
    if verdict is None:
        return {}
    success = "yes" if verdict.success else "no"
    return {"note": verdict.note, "success": success, **failures.score_failure(verdict)}


def _filters(visibility: Visibility) -> list[Filter]:
    """Return the filters of the list of trials; TrialFilters reports unknown values."""
    scenes = selectors.scene_list(all_of_them=True).prefetch_related(None)
    checkpoints = selectors.checkpoint_list(all_of_them=True, sight=visibility).prefetch_related(None)
    evaluations = [(str(row.pk), str(row)) for row in selectors.evaluation_list()]
    return [
        Filter("scene", "Scene", [(row.name, row.title) for row in scenes], strict=False),
        Filter("checkpoint", "Checkpoint", [(row.name, row.name) for row in checkpoints], strict=False),
        Filter(
            "station",
            "Station",
            [(row.name, str(row)) for row in station_list(all_of_them=True)],
            strict=False,
        ),
        Filter("evaluation", "Evaluation", evaluations, strict=False),
        Filter("since", "Since", kind=DAY),
        Filter("status", "Status", TrialStatus.choices, strict=False),
    ]


def _columns(visibility: Visibility) -> list[Column]:
    """Return the columns of the list of trials.

    Sorting by checkpoint is offered only if no checkpoint is hidden, because the order would reveal it.
    """
    return [
        Column("trial", "Trial", ("pk",), down=True),
        Column("prepared", "Prepared", ("prepared_at",), down=True),
        Column("scene", "Scene", ("scene__title", "position__number")),
        Column("position", "Position", ("position__number",), number=True),
        Column("checkpoint", "Checkpoint", ("checkpoint__name",) if visibility.hides_nothing else ()),
        Column("number", "No.", ("number", "attempt") if visibility.hides_nothing else (), number=True),
        Column("status", "Status", ("status",)),
        Column("success", "Success", ("verdict__success",), down=True),
        Column("score", "Score", ("verdict__score",), number=True),
        Column("time", "Time", ("duration_s",), number=True),
        Column("failure", "Failure, note", ("verdict__failure_phase", "verdict__failure")),
        Column("operator", "Operator", ("operator__username",)),
    ]
