"""Page on which a plan is drafted, step by step, and frozen."""

from __future__ import annotations

import json
import math
from typing import Any

from django.http import HttpRequest, HttpResponse, QueryDict
from django.shortcuts import redirect, render
from django.urls import reverse
from django.utils import timezone
from django.views.decorators.http import require_GET, require_http_methods

from evaweb.accounts.roles import Role, role_of
from evaweb.blinding.visibility import visibility_for_request
from evaweb.core.errors import EvaError
from evaweb.plans.draft_form import read
from evaweb.plans.drafting import Values, digest_of, values_of
from evaweb.plans.models import Comparing, Plan, PlanState, PrimaryOutcome, StoppingRule
from evaweb.plans.selectors import plan_get
from evaweb.plans.services import plan_change, plan_draft, require_drafter, require_editor
from evaweb.results.analysis.planner import Question, question_of
from evaweb.results.analysis.power import figures
from evaweb.results.pages import draft
from runtime.core import bounded_documents as bounded
from runtime.core.sentences import Pattern, fixed

_STOPPING_ALLOWED = Pattern(
    "results.pages.views_draft.stopping_allowed",
    "stopping = {stopping!r:.80}; allowed: {values}",
)
_ALLOWED_WHAT_PAGE_SHOWN_BY = fixed(
    "results.pages.views_draft.allowed_what_page_shown_by",
    "was: allowed is what the page was shown, by field",
)

_SPREAD = 0.35  # default standard deviation of scores: between independent points and all or none
_LARGEST = 64 * 1024  # [bytes] limit of the values that a page was shown
_FAULTY = (  # fields for whose faults the page has a place
    *(
        "title",
        "question",
        "owner",
        "margin",
        "checkpoints",
        "positions",
        "repetitions",
        "alpha",
        "look_after",
    ),
    *("second_rater_share", "match_gate"),
    *("on_estop", "on_interruption", "on_timeout"),
)
_CARRIED = ("rate", "better", "power", "cycle_s")  # assumptions of the calculator's input, not part of a plan


@require_http_methods(["GET", "HEAD", "POST"])
def new(request: HttpRequest) -> HttpResponse:
    """Create a draft from a title and a question, or render the form for them.

    A query of the calculator presets the draft's numbers.
    """
    user: Any = request.user
    require_drafter(user)
    values = request.POST if request.method == "POST" else request.GET
    title, question, fault = values.get("title", ""), values.get("question", ""), None
    numbers = {
        name: values[name]
        for name in (*_CARRIED, "alpha", "comparing", "stopping")
        if values.get(name, "").strip()
    }
    try:
        assumed = question_of(numbers)
        design = _design(numbers, assumed)
        if request.method == "POST":
            plan = plan_draft(user=user, title=title, question=question, **design)
            query = "&".join(f"{name}={getattr(assumed, name):g}" for name in _CARRIED if name in numbers)
            return redirect(_address(plan) + (f"?{query}" if query else "") + "#arms")
    except EvaError as error:
        fault = error
    context = {"title": title, "question": question, "numbers": numbers, "fault": fault, "here": "plans"}
    return render(request, "results/draft/new.html", context, status=fault.status if fault else 200)


def _design(numbers: dict[str, str], assumed: Question) -> dict[str, Any]:
    """Return the plan's fields that follow from the calculator's numbers."""
    design: dict[str, Any] = {"alpha": assumed.alpha} if "alpha" in numbers else {}
    if "comparing" in numbers:
        design["comparing"] = Comparing(assumed.comparing)
    if "stopping" in numbers:
        if numbers["stopping"] not in StoppingRule.values:
            raise EvaError(
                _STOPPING_ALLOWED(stopping=numbers["stopping"], values=", ".join(StoppingRule.values))
            )
        design["stopping"] = numbers["stopping"]
    return design


@require_http_methods(["GET", "HEAD", "POST"])
def edit(request: HttpRequest, name: str, version: int) -> HttpResponse:
    """Render all steps of a draft; with POST save changed fields.

    Of the changed fields only valid ones are saved. The response to a POST updates the parts of the page that depend on
    them.
    """
    plan = plan_get(name=name, version=version, user=request.user)
    if request.method == "POST":
        return _saved(request, plan)
    if plan.state != PlanState.DRAFT:
        return redirect("result-plan", name=plan.name, version=plan.version)
    require_editor(plan, request.user)  # type: ignore[arg-type]
    visibility = visibility_for_request(request)
    values, assumed = values_of(plan, visibility), _assumed(request.GET)
    context = {
        **draft.choices_page(plan, visibility, values),
        **draft.state_page(plan, visibility, faults={}, agreed=True, cycle_s=assumed.cycle_s),
        **_shown(values, values, {}),
        "assumed": assumed,
        "spread": _SPREAD,
        "is_admin": role_of(request.user) is Role.ADMIN,
        "here": "plans",
    }
    return render(request, "results/draft/page.html", context)


def _saved(request: HttpRequest, plan: Plan) -> HttpResponse:
    user: Any = request.user
    visibility = visibility_for_request(request)
    before = values_of(plan, visibility)
    requested, faults = read(
        request.POST,
        hidden=visibility.checkpoints,
        unseen=plan.checkpoints.filter(pk__in=visibility.checkpoints).count(),
        owners=role_of(user) is Role.ADMIN and "owner" in request.POST,
    )
    was = _was(request)
    keep = request.POST.get("keep", "").split()
    changed = plan_change(user=user, plan=plan, was=was, wanted=requested, keep=keep)
    plan.refresh_from_db()
    last_shown = {
        name: changed.now[name] if requested.get(name) == changed.now[name] else was.get(name)
        for name in before
    }
    conflicting = [name for name, value in requested.items() if name in before and value != changed.now[name]]
    context = {
        **draft.state_page(
            plan, visibility, faults=faults, agreed=not conflicting, cycle_s=_assumed(request.POST).cycle_s
        ),
        **_shown(changed.now, last_shown, faults),
        "others": [(name, draft.value_text(name, changed.now[name], visibility)) for name in conflicting],
        "keep": " ".join(conflicting),
        "fault_rows": [
            (name, faults.get(name, ""))
            for name in _FAULTY
            if name in before and (name in requested or name in faults)
        ],
        "saved_at": timezone.localtime(),
        "fragment": True,
    }
    answer = render(request, "results/draft/saved.html", context)
    if changed.now != before:
        answer.headers["HX-Trigger"] = "draft-saved"  # the figures are recomputed
    return answer


def _was(request: HttpRequest) -> dict[str, Any]:
    try:
        values = bounded.parse_json(request.POST.get("was", "{}"), "was", _LARGEST)
    except bounded.UnreadableDocument as error:
        raise EvaError(str(error)) from None
    if not isinstance(values, dict):
        raise EvaError(_ALLOWED_WHAT_PAGE_SHOWN_BY)
    return values


def _shown(now: Values, last_shown: Values, faults: dict[str, str]) -> dict[str, Any]:
    """Return the state that the page keeps and sends with its next request.

    It consists of `last_shown`, the digest of the saved values `now`, and `faults`. A value that differs from
    `last_shown` was changed on the page; other differences were made by other people. The digest is needed to freeze
    the plan.
    """
    return {"was": json.dumps(last_shown), "seen": digest_of(now), "faults": faults}


def _assumed(query: QueryDict) -> Question:
    """Return the calculator's input of a page; the default input if a value is not allowed."""
    try:
        return question_of({name: query.get(name, "") for name in _CARRIED}, alike=True)
    except EvaError:
        return Question()


def _spread(query: QueryDict) -> float:
    """Return the assumed standard deviation of a score.

    Raises:
        EvaError: If it is not within 0.01 to 0.5.
    """
    text = query.get("spread", "").strip() or str(_SPREAD)
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0.01 <= value <= 0.5:
        raise EvaError(f"spread = {text!r:.80}; allowed: 0.01 to 0.5")
    return value


@require_GET
def power(request: HttpRequest, name: str, version: int) -> HttpResponse:
    """Render the statistical power of the saved draft at the success rates in the URL, as far as it is computed."""
    plan = plan_get(name=name, version=version, user=request.user)
    if plan.state != PlanState.DRAFT:  # frozen while its page was still polling: 204 ends the polling
        return HttpResponse(status=204)
    require_editor(plan, request.user)  # type: ignore[arg-type]
    context: dict[str, Any] = {"plan": plan, "size": draft.Size.of(plan)}
    try:
        question = question_of(request.GET, alike=plan.margin is not None)
        spread = _spread(request.GET) if plan.outcome == PrimaryOutcome.SCORE else _SPREAD
        power_request = draft.power_request(plan, draft.question_for(plan, question), spread)
        if power_request is not None:
            context |= draft.power_page(plan, power_request, figures(request.user.pk, power_request))
    except EvaError as error:
        context["fault"] = error
    return render(request, "results/draft/power.html", context)


def _address(plan: Plan) -> str:
    return reverse("result-draft", args=[plan.name, plan.version])
