"""Pages of a plan: results, comparison, evidence, trials, and its owner's actions."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from django.http import HttpRequest, HttpResponse
from django.http.response import HttpResponseBase
from django.shortcuts import redirect, render
from django.urls import reverse
from django.views.decorators.http import require_GET, require_POST

from evaweb.accounts.profiles import orcids_of
from evaweb.accounts.roles import Role, role_of
from evaweb.blinding.visibility import visibility_for_request
from evaweb.core.errors import EvaError
from evaweb.plans import copies, services
from evaweb.plans.blinding_rules import can_unblind, record_unblinding
from evaweb.plans.counting import declared_failures
from evaweb.plans.design import compared
from evaweb.plans.models import Plan, PlanState
from evaweb.results import selectors
from evaweb.results.analysis.simulated import compare_with_real, is_simulated, simulated_plans
from evaweb.results.crates.download import MOST_PICTURES, crate_response
from evaweb.results.crates.facts import crate_facts
from evaweb.results.crates.licenses import LICENSES
from evaweb.results.crates.options import LONGEST, CrateOptions
from evaweb.results.pages import pages
from evaweb.results.pages.draft import planned_facts
from evaweb.results.presentation import listings
from evaweb.results.presentation.citation import HEAD, Citation, citation
from evaweb.results.presentation.integrity import delays_banner, integrity_document, too_few_text
from evaweb.results.presentation.plan_result import PlanResult
from evaweb.results.ratings.automatic import judges_ready, request_judging
from evaweb.results.ratings.result_visibility import (
    has_results,
    require_visible_results,
    sealed_reason,
    sealing_plans,
)
from evaweb.results.reports.reporting import write_report
from evaweb.serving.lists import Listing
from evaweb.stations.selectors import station_get
from evaweb.trials.models import Trial
from evaweb.trials.voids import open_void_requests

PER_PAGE = 50
PLANS_PER_PAGE = 25
MOST_LINES = 200  # lines per list on the integrity page; REST and the report have all
_FORMS = {"txt": "text/plain", "tex": "application/x-tex", "svg": "image/svg+xml"}


@require_GET
def plans(request: HttpRequest) -> HttpResponseBase:
    """Render all plans with their progress."""
    listing = Listing(request.GET, listings.PLAN_COLUMNS, listings.PLAN_FILTERS)
    rows = selectors.plan_list(**listing.chosen)
    if listing.wants_file:
        return listing.file(request, "evaluations", selectors.plan_rows(listing.ordered(rows)))
    page = listing.page(rows, PLANS_PER_PAGE)
    context = {
        "listing": listing,
        "page": page,
        "rows": selectors.plan_rows(page),
        "may_draft": role_of(request.user) is Role.ADMIN,
        "here": "plans",
    }
    return render(request, "results/plans.html", context)


@require_GET
def plan(request: HttpRequest, name: str, version: int | None = None) -> HttpResponse:
    """Render the plan's results, or its progress if they are sealed or do not exist yet."""
    return _plan_page(request, _get_plan(name, version))


@require_GET
def compare(request: HttpRequest, name: str, version: int) -> HttpResponse:
    """Render the comparison of two checkpoints."""
    plan = _get_plan(name, version)
    sealed = _sealed_page(request, plan)
    if sealed:
        return sealed
    try:
        result = PlanResult(plan).select(request.GET)
        context = pages.comparison_page(result, request.GET.get("first", ""), request.GET.get("second", ""))
        context |= pages.pairs_shown(context, pages.pair_view(request.GET))
    except EvaError as fault:
        return _plan_page(request, plan, fault)
    return render(request, "results/compare.html", {**context, **_common(request, plan)})


@require_GET
def evidence(request: HttpRequest, name: str, version: int) -> HttpResponse:
    """Render the page of the evidence so far, for users who may see it.

    A request by htmx (header HX-Request) gets only the part of the page that it refreshes.
    """
    plan = _get_plan(name, version)
    sealed = _sealed_page(request, plan)
    if sealed:
        return sealed
    context = {**pages.evidence_page(PlanResult(plan)), **_common(request, plan)}
    fragment = bool(request.headers.get("HX-Request"))
    return render(request, "results/meter.html" if fragment else "results/evidence.html", context)


@require_GET
def trials(request: HttpRequest, name: str, version: int) -> HttpResponseBase:
    """Render the list of the plan's trials that the filters in the address select."""
    plan = _get_plan(name, version)
    sealed = _sealed_page(request, plan)
    if sealed:
        return sealed
    listing = Listing(
        request.GET, listings.TRIAL_COLUMNS, listings.trial_filters(PlanResult(plan).runs.outcomes)
    )
    try:
        rows = selectors.trials_of_plan(plan, listings.question_of(listing.chosen))
    except EvaError as fault:
        return _plan_page(request, plan, fault)
    rows = rows.prefetch_related("verdict__outcomes")
    if listing.wants_file:
        return listing.file(request, f"{plan.name}-v{plan.version}-trials", rows)
    page = listing.page(rows, PER_PAGE)
    context = {
        "listing": listing,
        "page": page,
        "rows": [listings.trial_row(trial) for trial in page],
        "declared": declared_failures(plan),
        **_common(request, plan),
    }
    return render(request, "results/trials.html", context)


@require_GET
def report(request: HttpRequest, name: str, version: int) -> HttpResponse:
    """Return the offline report as a zip archive."""
    plan = _get_plan(name, version)
    require_visible_results(plan, request.user)
    title = f"{plan.name}-v{plan.version}"
    with TemporaryDirectory() as folder:
        write_report(plan, Path(folder) / title, most_pictures=MOST_PICTURES)
        packed = shutil.make_archive(f"{folder}/packed", "zip", folder, title)
        content = Path(packed).read_bytes()
    return HttpResponse(
        content,
        content_type="application/zip",
        headers={"Content-Disposition": f'attachment; filename="{title}.zip"'},
    )


@require_GET
def crate(request: HttpRequest, name: str, version: int) -> HttpResponseBase:
    """Render the choices of a crate of the results; with a licence among the query's parameters, return the crate."""
    plan = _get_plan(name, version)
    sealed = _sealed_page(request, plan)
    if sealed:
        return sealed
    typed = {field: request.GET.get(field, "") for field in ("license", "date", *LONGEST)}
    videos, fault = request.GET.get("videos") == "true", None
    if typed["license"]:
        try:
            return crate_response(request, request.user, plan, CrateOptions(**typed, videos=videos))
        except EvaError as refused:
            fault = refused
    facts = crate_facts(plan)
    people = sorted({facts.owner, *facts.operators, *facts.raters})
    orcids = orcids_of(people)
    context = {
        **_common(request, plan),
        "typed": typed | {"videos": videos},
        "longest": LONGEST,
        "licenses": LICENSES,
        "day": f"{facts.recorded_at:%Y-%m-%d}",
        "people": [(person, orcids.get(person, "")) for person in people],
        "fault": fault,
    }
    return render(request, "results/crate.html", context, status=fault.status if fault else 200)


@require_GET
def integrity(request: HttpRequest, name: str, version: int) -> HttpResponse:
    """Render the record of how the trials were made, and what would be concluded without part of them."""
    plan = _get_plan(name, version)
    sealed = _sealed_page(request, plan)
    if sealed:
        return sealed
    record = integrity_document(plan)
    context = {
        "record": record,
        "banner": delays_banner(record),
        "too_few": too_few_text(record),
        "most": MOST_LINES,
        **_common(request, plan),
    }
    return render(request, "results/conduct.html", context)


@require_GET
def simulated(request: HttpRequest, name: str, version: int) -> HttpResponse:
    """Render related evaluations on simulated benches next to this plan."""
    plan = _get_plan(name, version)
    sealed = _sealed_page(request, plan)
    if sealed:
        return sealed
    visible = [row for row in simulated_plans(plan) if not sealed_reason(row, request.user)]
    context = {
        "beside": [compare_with_real(plan, row) for row in visible],
        "real": is_simulated(plan),
        **_common(request, plan),
    }
    return render(request, "results/simulated.html", context)


@require_GET
def cite(request: HttpRequest, name: str, version: int) -> HttpResponse:
    """Render the citation of a plan; redirect to the permanent address of its result if it is revealed."""
    plan = _get_plan(name, version)
    sealed = _sealed_page(request, plan)
    if sealed:
        return sealed
    if plan.at_reveal and compared(plan.document or {}):
        return redirect("result-frozen", digest=plan.at_reveal["digest"])
    try:
        return _citation_page(request, citation(plan))
    except EvaError as fault:
        return _plan_page(request, plan, fault)


@require_GET
def frozen(request: HttpRequest, digest: str) -> HttpResponse:
    """Render the result as recorded at its reveal; later corrections do not change it."""
    plan = selectors.plan_at_reveal(digest)
    sealed = _sealed_page(request, plan)
    return sealed or _citation_page(request, citation(plan))


@require_GET
def frozen_file(request: HttpRequest, digest: str, form: str) -> HttpResponse:
    """Return the recorded result as a file: "txt", "tex" or "svg"."""
    plan = selectors.plan_at_reveal(digest)
    require_visible_results(plan, request.user)
    title = f"{plan.name}-v{plan.version}-{digest[:8]}.{form}"
    return HttpResponse(
        citation(plan).render(form),
        content_type=f"{_FORMS[form]}; charset=utf-8",
        headers={"Content-Disposition": f'attachment; filename="{title}"'},
    )


@require_POST
def plan_action(request: HttpRequest, name: str, version: int, what: str) -> HttpResponse:
    """Freeze, amend, close, reveal or unblind a plan, or have it judged; `what` names the action."""
    plan = _get_plan(name, version)
    user: Any = request.user
    reason = request.POST.get("reason", "")
    acts: Mapping[str, Callable[[], object]] = {
        "freeze": lambda: services.freeze_plan(user=user, plan=plan, seen=request.POST.get("seen", "")),
        "amend": lambda: services.amend_plan(user=user, plan=plan, reason=reason),
        "close": lambda: services.close_plan(user=user, plan=plan, reason=reason),
        "reveal": lambda: services.reveal_plan(user=user, plan=plan),
        "look": lambda: record_unblinding(plan, user),
        "carry-out": lambda: _carry_out(request, plan),
        "pause": lambda: copies.pause_trials(user=user, plan=plan),
        "judge": lambda: request_judging(user=user, plan=plan, name=request.POST.get("judge", "")),
    }
    try:
        result = acts[what]()
    except EvaError as fault:
        return _plan_page(request, plan, fault, typed=reason)
    target = result if isinstance(result, Plan) else plan
    return redirect("result-plan", name=target.name, version=target.version)


def _carry_out(request: HttpRequest, plan: Plan) -> object:
    """Start the trials of a plan at copies of a simulated station."""
    typed = request.POST.get("count", "")
    if not (
        typed.isascii() and typed.isdecimal() and len(typed) <= 4 and 1 <= int(typed) <= copies.MOST_COPIES
    ):
        raise EvaError(f"copies = {typed!r:.40}; allowed: 1 to {copies.MOST_COPIES}")
    station = station_get(name=request.POST.get("station", ""))
    user: Any = request.user
    return copies.request_trials(user=user, plan=plan, station=station, count=int(typed))


def _copies(request: HttpRequest, plan: Plan) -> dict[str, Any] | None:
    """Return the state of trials at copies of a station; None if none can be carried out by this user."""
    stations = copies.stations_with_copies(plan) if plan.state == PlanState.FROZEN else []
    if not stations or role_of(request.user) is Role.VIEWER:
        return None
    return {"stations": stations, "state": copies.copies_state(plan, visibility_for_request(request))}


def _citation_page(request: HttpRequest, cited: Citation) -> HttpResponse:
    parts = [
        (
            title,
            {
                "text": cited.text[part],
                "LaTeX": cited.latex[part],
                **({"SVG": cited.svg} if part == "figure" else {}),
            },
        )
        for part, title in (("sentence", "Sentence"), ("table", "Table"), ("figure", "Figure"))
    ]
    context = {
        **_common(request, cited.plan),
        "cited": cited,
        "head": HEAD,
        "parts": parts,
        "forms": _FORMS,
    }
    return render(request, "results/cite.html", context)


def _get_plan(name: str, version: int | None) -> Plan:
    return selectors.plan_get(name=name, version=version)


def _plan_page(
    request: HttpRequest, plan: Plan, fault: EvaError | None = None, typed: str = ""
) -> HttpResponse:
    sealed = _sealed_page(request, plan, fault, typed)
    if sealed:
        return sealed
    result = PlanResult(plan)
    try:
        result = result.select(request.GET)
    except EvaError as problem:
        fault = fault or problem
    context = {
        **pages.summary_page(result),
        "banner": delays_banner(result.conduct),
        "remarks": result.conduct["remarks"],
        "agreement": result.agreement,
        "judges": result.judges,
        "preferences": result.preferences,
        **_common(request, plan),
        "fault": fault,
        "typed": typed,
    }
    return render(request, "results/plan.html", context, status=fault.status if fault else 200)


def _sealed_page(
    request: HttpRequest, plan: Plan, fault: EvaError | None = None, typed: str = ""
) -> HttpResponse | None:
    """Return the page that replaces the results if they are sealed for this user or do not exist yet; else None."""
    reason = sealed_reason(plan, request.user, visibility_for_request(request)) if has_results(plan) else ""
    if has_results(plan) and not reason:
        return None
    context = {
        **_common(request, plan),
        "why": reason,
        "others": [
            (sealing, can_unblind(sealing, request.user))
            for sealing in sealing_plans(plan, request.user, visibility_for_request(request))
        ],
        "may_look": plan.sealed and can_unblind(plan, request.user),
        "fault": fault,
        "typed": typed,
    }
    return render(request, "results/sealed.html", context, status=fault.status if fault else 200)


def _common(request: HttpRequest, plan: Plan) -> dict[str, Any]:
    role = role_of(request.user)
    managed = role is Role.ADMIN or (plan.owner_id == request.user.pk and role is not Role.VIEWER)
    return {
        "plan": plan,
        "row": selectors.plan_rows([plan])[0],
        "events": plan.events.select_related("by"),
        "key": bytes(plan.key or b"").hex() if plan.state == PlanState.REVEALED else "",
        "may_manage": managed,
        "voids": open_void_requests(Trial.objects.filter(handout__plan=plan)),
        "judges_ready": judges_ready() if managed and has_results(plan) else [],
        "planned": planned_facts(plan),
        "copies": _copies(request, plan),
        "here": "plans",
        "home": reverse("result-plan", args=[plan.name, plan.version]),
    }
