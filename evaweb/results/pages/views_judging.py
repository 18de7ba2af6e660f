"""Pages of blind raters: rating a trial again, and preferring one of two trials."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from django.http import HttpRequest, HttpResponse, QueryDict
from django.shortcuts import redirect, render
from django.views.decorators.http import require_http_methods

from evaweb.accounts.roles import Role, role_of
from evaweb.core.errors import EvaError
from evaweb.episodes.models import Episode
from evaweb.episodes.selectors import playback_stage
from evaweb.plans.models import Handout
from evaweb.results.models import Preference
from evaweb.results.ratings import rating_queue
from evaweb.results.ratings.footage import is_watchable
from evaweb.results.selectors import plan_get
from evaweb.trials import failures
from evaweb.trials.services import failing
from runtime.core.sentences import Pattern

_VERSION_ALLOWED_NUMBER = Pattern(
    "results.pages.views_judging.version_allowed_number",
    "version = {given!r:.20}; allowed: a number",
)

_ANSWERS = {"yes": True, "no": False}


@require_http_methods(["GET", "POST"])
def rate(request: HttpRequest) -> HttpResponse:
    """Render the next trial to be rated, identified only by its code, or save a rating."""
    fault = None
    if request.method == "POST":
        try:
            _rated(request)
        except EvaError as error:
            fault = error
        else:
            return redirect("rate")
    user: Any = request.user
    offer = rating_queue.next_to_rate(user)
    handout = offer.found
    milestones = list(handout.trial.scene.milestones.order_by("order")) if handout else []
    typed = request.POST if handout and request.POST.get("code") == handout.code else QueryDict()
    ticked = typed.getlist("milestone")
    view = _view(handout)
    context = {
        "handout": handout,
        "left": offer.left,
        "passed": offer.passed,
        "view": view,
        "milestones": [(milestone, str(milestone.pk) in ticked) for milestone in milestones],
        "implied": any(milestone.required for milestone in milestones),
        "fails": failing(handout.trial) if handout else "",
        "failures": failures.failure_choices(typed),
        "unable": _unable(user, [view]),
        "fault": fault,
        "typed": typed,
        "here": "rate",
    }
    return render(request, "results/rate.html", context, status=fault.status if fault else 200)


@require_http_methods(["GET", "POST"])
def prefer(request: HttpRequest) -> HttpResponse:
    """Render the next two trials of one initial condition for a preference, or save one."""
    fault = None
    if request.method == "POST":
        try:
            _preferred(request)
        except EvaError as error:
            fault = error
        else:
            return redirect("prefer")
    user: Any = request.user
    offer = rating_queue.next_to_compare(user)
    pair = offer.found
    codes = (pair.first.code, pair.second.code) if pair else ()
    views = [_view(pair.first), _view(pair.second)] if pair else []
    context = {
        "pair": pair,
        "left": offer.left,
        "passed": offer.passed,
        "views": views,
        "outcomes": Preference.Outcome.choices,
        "unable": _unable(user, views),
        "fault": fault,
        "typed": request.POST if (request.POST.get("first"), request.POST.get("second")) == codes else {},
        "here": "prefer",
    }
    return render(request, "results/prefer.html", context, status=fault.status if fault else 200)


def _rated(request: HttpRequest) -> None:
    plan = plan_get(name=request.POST.get("plan", ""), version=_version(request))
    code = request.POST.get("code", "")
    handout = plan.handouts.filter(code=code).select_related("trial__scene").first()
    ticked = set(request.POST.getlist("milestone"))
    keys = handout.trial.scene.milestones.values_list("pk", flat=True) if handout else ()
    user: Any = request.user
    rating_queue.save_rating(
        user=user,
        plan=plan,
        code=code,
        milestones={key: str(key) in ticked for key in keys},
        success=_ANSWERS.get(request.POST.get("success", "")),
        **{name: request.POST.get(name, "") for name in (*failures.FIELDS, "note")},
    )


def _preferred(request: HttpRequest) -> None:
    user: Any = request.user
    rating_queue.save_preference(
        user=user,
        plan=plan_get(name=request.POST.get("plan", ""), version=_version(request)),
        **{name: request.POST.get(name, "") for name in ("first", "second", "outcome", "why")},
    )


def _version(request: HttpRequest) -> int:
    text = request.POST.get("version", "")
    if not (text.isascii() and text.isdecimal() and len(text) < 7):
        raise EvaError(_VERSION_ALLOWED_NUMBER(given=text))
    return int(text)


def _view(handout: Handout | None) -> dict[str, Any] | None:
    """Return a recording as shown to a blind rater."""
    episode: Episode | None = handout.trial.episode if handout else None
    if handout is None or episode is None:
        return None
    stage = playback_stage(episode=episode)
    return {"code": handout.code, "episode": episode, "stage": stage, "seen": is_watchable(episode)}


def _unable(user: Any, views: Sequence[dict[str, Any] | None]) -> str:
    """Return the reason for which nothing can be saved now, "" if it can."""
    if role_of(user) is Role.VIEWER:
        return "operators judge: you may look"
    unseen = [view["code"] for view in views if view is not None and not view["seen"]]
    return f"pictures are needed to judge {' and '.join(unseen)}" if unseen else ""
