"""Overview of the lab: activity of stations, progress of evaluations, recent trials; and the calculator."""

from __future__ import annotations

from typing import Any
from urllib.parse import urlencode

from django.http import HttpRequest, HttpResponse
from django.shortcuts import render
from django.views.decorators.http import require_GET

from evaweb.accounts.roles import Role, role_of
from evaweb.blinding.visibility import Visibility, visibility_for_request
from evaweb.core.errors import EvaError
from evaweb.plans.models import Comparing, PlanState
from evaweb.results import selectors
from evaweb.results.analysis.planner import Question, question_of, table_of
from evaweb.results.ratings.result_visibility import sealed_reason
from evaweb.serving import computations
from evaweb.serving.error_pages import retrying

RUNNING = 12  # plans on one page; the list has all
RECENT = 12


@require_GET
def dashboard(request: HttpRequest) -> HttpResponse:
    """Render running evaluations, stations and recent trials.

    A request by htmx (header HX-Request) gets only the part of the page that it refreshes.
    """
    fragment = bool(request.headers.get("HX-Request"))
    return render(request, "results/lab_body.html" if fragment else "results/lab.html", _lab(request))


@require_GET
def wall(request: HttpRequest) -> HttpResponse:
    """Render the overview for a big screen: large, without controls."""
    fragment = bool(request.headers.get("HX-Request"))
    return render(request, "results/wall_body.html" if fragment else "results/wall.html", _lab(request))


@require_GET
def planner(request: HttpRequest) -> HttpResponse:
    """Render the calculator.

    It computes the trials and robot hours that are needed to detect a difference, and the difference that can be
    detected in the available time.
    """
    fault = table = None
    waiting = False
    question = Question()
    try:
        question = question_of(request.GET)
        table = table_of(question, request.user.pk, soon=True)
    except computations.StillRunning:
        waiting = True
    except EvaError as error:
        fault = error
    context = {
        "question": question,
        "table": table,
        "waiting": waiting,
        "fault": fault,
        "comparing": Comparing.choices,
    }
    carried = ("rate", "better", "alpha", "power", "cycle_s", "comparing")
    context |= {
        "here": "planner",
        "may_draft": role_of(request.user) is Role.ADMIN,
        "carried": urlencode({name: getattr(question, name) for name in carried}),
    }
    answer = render(request, "results/planner.html", context, status=fault.status if fault else 200)
    return answer if fault is None else retrying(answer, fault)


def _lab(request: HttpRequest) -> dict[str, Any]:
    visibility = visibility_for_request(request)
    running = selectors.plan_rows(selectors.plan_list(PlanState.FROZEN)[:RUNNING])
    ended = selectors.plan_rows(
        selectors.plan_list().exclude(state__in=(PlanState.FROZEN, PlanState.DRAFT))[:5]
    )
    return {
        "running": running,
        "ended": [(row, sealed_reason(row.plan, request.user, visibility)) for row in ended],
        "stations": [(now, _label(visibility, now.trial)) for now in selectors.station_activity()],
        "recent": [
            (trial, visibility.checkpoint_label(trial), visibility.hides(trial))
            for trial in selectors.recent_trials(RECENT)
        ],
        "here": "lab",
    }


def _label(visibility: Visibility, trial: Any) -> str:
    return visibility.checkpoint_label(trial) if trial is not None else ""
