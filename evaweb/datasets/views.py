"""Pages of datasets: the list, one of them, and what is asked for about them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from django.contrib import messages
from django.core.paginator import Paginator
from django.http import HttpRequest, HttpResponse, QueryDict
from django.shortcuts import redirect, render
from django.views.decorators.http import require_GET, require_POST

import robots
from evaweb.datasets import dataset_jobs, listing, orders
from evaweb.datasets.finding import overview, overviews
from evaweb.errors import Conflict, EvaError
from evaweb.roles import Role, role_of
from runtime.datasets.__main__ import episodes as indices_of
from runtime.recording.files import RecordingError

PER_PAGE = 100
FILTERS = ("words", "success", "verdict")


@require_GET
def dataset_list(request: HttpRequest) -> HttpResponse:
    """All datasets of the data folder."""
    rows = [(one, None if one.problem else dataset_jobs.checked(one.name)) for one in overviews()]
    context = {"rows": rows, "name": "", **_work(""), **_rights(request)}
    return render(request, "datasets/list.html", context)


@require_GET
def dataset(request: HttpRequest, name: str) -> HttpResponse:
    """One dataset: its figures, its episodes, what can be done with it."""
    name = orders.full_name(name)
    chosen = {key: request.GET.get(key, "").strip() for key in FILTERS}
    found = overview(name)
    rows: list[listing.Row] = []
    problem = found.problem
    if not problem:
        try:
            rows = listing.rows(name, **chosen)
        except RecordingError as error:
            problem = str(error)
    context = {
        "dataset": found,
        "problem": problem,
        "checked": None if problem else dataset_jobs.checked(name),
        "page": Paginator(rows, PER_PAGE).get_page(request.GET.get("page")),
        "chosen": chosen,
        "narrowed": any(chosen.values()),
        "successes": listing.SUCCESSES,
        "verdicts": listing.VERDICTS,
        "robots": robots.names(),
        "name": name,
        **_work(name),
        **_rights(request),
    }
    return render(request, "datasets/dataset.html", context)


@require_GET
def dataset_work(request: HttpRequest) -> HttpResponse:
    """The newest jobs, to be put into a page; a page is told to load again when one has ended."""
    given = request.GET.get("dataset", "")
    name = orders.full_name(given) if given else ""
    context = {"name": name, **_work(name)}
    answer = render(request, "datasets/work.html", context)
    if not context["passing"]:
        answer["HX-Refresh"] = "true"
    return answer


@require_POST
def dataset_ask(request: HttpRequest) -> HttpResponse:
    """Have something done, as the forms of the pages say it."""
    try:
        job = orders.asked(user=request.user, given=_order(request.POST))
    except EvaError as error:
        messages.error(request, str(error))
    else:
        messages.success(request, f"{dataset_jobs.told(job).title}: asked for")
    name = request.POST.get("dataset", "")
    return redirect("dataset", name=name) if name else redirect("dataset-list")


def _order(form: QueryDict) -> Mapping[str, Any]:
    """The order that a form means; its fields are text."""
    what = form.get("what", "")
    order: dict[str, Any] = {"what": what}
    if what == "merge":
        order["datasets"] = form.getlist("datasets")
    else:
        order["dataset"] = form.get("dataset", "")
    for key in ("to", "version", "repository", "robot", "state"):
        if form.get(key, "").strip():
            order[key] = form[key].strip()
    if what == "convert":
        order["rename"] = _pairs("rename", form.get("rename", ""))
    if what == "split":
        order["parts"] = {
            part: _indices(which) for part, which in _pairs("parts", form.get("parts", "")).items()
        }
    if what == "delete":
        _require_confirmed(form)
        order["episodes"] = [int(index) for index in form.getlist("episodes") if index.isdecimal()]
    if what in ("convert", "merge", "split", "delete"):
        order["reencode"] = form.get("reencode") == "on"
    if what == "push":
        order["private"] = form.get("public") != "on"
    return order


def _pairs(name: str, text: str) -> dict[str, str]:
    """NAME=VALUE, separated by blanks or lines."""
    pairs = [part.partition("=") for part in text.split()]
    wrong = [f"{key}{sign}{value}" for key, sign, value in pairs if not (key and sign and value)]
    if wrong or len({key for key, _, _ in pairs}) < len(pairs):
        raise EvaError(f"{name}: {' '.join(wrong) or text!r}; expected NAME=VALUE, each name once")
    return {key: value for key, _, value in pairs}


def _indices(text: str) -> list[int]:
    try:
        return indices_of(text)
    except RecordingError as fault:
        raise EvaError(str(fault)) from None


def _require_confirmed(form: QueryDict) -> None:
    """Refuse to delete episodes unless the form names their dataset."""
    name = form.get("dataset", "").removeprefix("datasets/")
    if form.get("confirm", "").strip() != name:
        raise Conflict(f"nothing was deleted: write the name of the dataset, {name}, to confirm it")


def _work(name: str) -> dict[str, Any]:
    jobs = dataset_jobs.jobs_of(name)
    return {"jobs": jobs, "passing": any(job.passing for job in jobs)}


def _rights(request: HttpRequest) -> dict[str, Any]:
    role = role_of(request.user)
    return {"may_ask": role is not Role.VIEWER, "may_delete": role is Role.ADMIN}
