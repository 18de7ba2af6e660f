"""Pages of datasets: the list, one dataset, and orders."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import PurePosixPath
from typing import Any

from django.contrib import messages
from django.core.paginator import Paginator
from django.http import HttpRequest, HttpResponse, QueryDict
from django.http.response import HttpResponseBase
from django.shortcuts import redirect, render
from django.views.decorators.http import require_GET, require_POST

import robots
from evaweb.accounts.hub_tokens import describe_hub_login
from evaweb.accounts.roles import Role, role_of
from evaweb.core.errors import Conflict, EvaError
from evaweb.core.printed_names import is_name
from evaweb.datasets import (
    dataset_jobs,
    dataset_orders,
    episode_list,
    listed,
)
from evaweb.datasets.overview import overview, overviews
from evaweb.serving.lists import Listing
from runtime.core.sentences import Pattern, fixed
from runtime.datasets.__main__ import MOST, is_index
from runtime.datasets.__main__ import episodes as indices_of
from runtime.datasets.card import LICENCES
from runtime.recording.files import RecordingError

_EXPECTED_NAME_VALUE_EACH_NAME = Pattern(
    "datasets.views.expected_name_value_each_name",
    "{name}: {wrong!r}; expected NAME=VALUE, each name once",
)
_NOTHING_DELETED_TYPE_NAME_DATASET = Pattern(
    "datasets.views.nothing_deleted_type_name_dataset",
    "nothing was deleted: type the name of the dataset, {name}, to confirm it",
)

_NO_BAG_CHOSEN = fixed("datasets.views.no_bag_chosen", "nothing was imported: tick at least one bag")

PER_PAGE = 100
_PAGES = {
    "propose": "bag-list",
    "import_bags": "bag-list",
    "subset": "subset-list",
}  # on which orders are made
# Fields of forms that are text in orders too.
_TEXTS = (
    *("to", "version", "repository", "robot", "state", "pictures", "licence", "revision"),
    *("bag", "mapping", "subset"),
)
_INDICES = re.compile(r"[0-9]{1,9}(,[0-9]{1,9}){0,199}")


@require_GET
def dataset_list(request: HttpRequest) -> HttpResponseBase:
    """Show all datasets in the data folder."""
    datasets = overviews()
    listing = Listing(request.GET, listed.COLUMNS, listed.filters(datasets))
    fits = listing.sorted([row for row in datasets if listed.fits(row, **listing.chosen)])
    if listing.wants_file:
        return listing.file(request, "datasets", fits)
    page = Paginator(fits, PER_PAGE).get_page(listing.number)
    rows = [(row, None if row.problem else dataset_jobs.latest_check(row.name)) for row in page]
    context = {
        "listing": listing,
        "page": page,
        "rows": rows,
        "name": "",
        **work_context(""),
        **rights_context(request),
    }
    return render(request, "datasets/list.html", context)


@require_GET
def dataset(request: HttpRequest, name: str) -> HttpResponseBase:
    """Show one dataset: its overview, episodes and operations."""
    name = dataset_orders.full_name(name)
    listing = Listing(request.GET, listed.EPISODE_COLUMNS, listed.EPISODE_FILTERS)
    row = overview(name)
    rows: list[episode_list.DatasetRow] = []
    problem = row.problem
    if not problem:
        try:
            rows = listing.sorted(episode_list.list_rows(name, **listing.chosen))
        except RecordingError as error:
            problem = str(error)
    if listing.wants_file and not problem:
        return listing.file(request, PurePosixPath(name).name, rows)
    context = {
        "dataset": row,
        "problem": problem,
        "checked": None if problem else dataset_jobs.latest_check(name),
        "page": Paginator(rows, PER_PAGE).get_page(listing.number),
        "listing": listing,
        "robots": robots.robot_names(),
        "licences": LICENCES,
        "name": name,
        "chosen": _chosen(request.GET.get("chosen", "")),
        **work_context(name),
        **rights_context(request),
    }
    return render(request, "datasets/dataset.html", context)


def _chosen(text: str) -> str:
    """Return the indices of episodes selected on another page. Raises: EvaError if malformed."""
    if text and not _INDICES.fullmatch(text):
        raise EvaError(f"chosen = {text!r:.80}; allowed: indices of episodes, separated by commas")
    return text


@require_GET
def dataset_work(request: HttpRequest) -> HttpResponse:
    """Return the newest jobs as a fragment; if no job is active, make the page reload."""
    text = request.GET.get("dataset", "")
    name = dataset_orders.full_name(text) if text else ""
    context = {"name": name, **work_context(name)}
    answer = render(request, "datasets/work.html", context)
    if not context["passing"]:
        answer["HX-Refresh"] = "true"
    return answer


@require_POST
def dataset_ask(request: HttpRequest) -> HttpResponse:
    """Submit an order from a form."""
    try:
        job = dataset_orders.submit_order(user=request.user, given=_order(request.POST))
    except EvaError as error:
        messages.error(request, str(error))
    else:
        messages.success(request, f"{dataset_jobs.summarize_job(job).title}: requested")
    if page := _PAGES.get(request.POST.get("what", "")):
        return redirect(page)
    name = request.POST.get("dataset", "")
    return redirect("dataset", name=name) if name and is_name(name) else redirect("dataset-list")


def _order(form: QueryDict) -> Mapping[str, Any]:
    """Convert a form, whose fields are text, to an order."""
    action = form.get("what", "")
    order: dict[str, Any] = {"what": action}
    if action == "merge":
        order["datasets"] = form.getlist("datasets")
    elif action == "import_bags":
        order["bags"] = form.getlist("bags")
        if not order["bags"]:
            raise EvaError(_NO_BAG_CHOSEN)
    elif action not in ("pull", "propose", "subset"):
        order["dataset"] = form.get("dataset", "")
    for key in _TEXTS:
        if form.get(key, "").strip():
            order[key] = form[key].strip()
    if action == "convert":
        order["rename"] = _pairs("rename", form.get("rename", ""))
    if action == "split":
        order["parts"] = _parts(form.get("parts", ""))
    if action == "delete":
        _require_confirmed(form)
        order["episodes"] = [int(index) for index in form.getlist("episodes") if is_index(index)]
    if action in ("convert", "merge", "split", "delete"):
        order["reencode"] = form.get("reencode") == "on"
    if action == "push":
        order["private"] = form.get("public") != "on"
    return order


def _pairs(name: str, text: str) -> dict[str, str]:
    """Parse NAME=VALUE pairs separated by white space."""
    pairs = [part.partition("=") for part in text.split()]
    wrong = [f"{key}{sign}{value}" for key, sign, value in pairs if not (key and sign and value)]
    if wrong or len({key for key, _, _ in pairs}) < len(pairs):
        raise EvaError(_EXPECTED_NAME_VALUE_EACH_NAME(name=name, wrong=" ".join(wrong) or text))
    return {key: value for key, _, value in pairs}


def _parts(text: str) -> dict[str, list[int]]:
    """Parse the episode numbers of each part in the text of a split form.

    Raises: EvaError if a part is malformed, or if all parts together have more episodes than one order may have.
    """
    parts: dict[str, list[int]] = {}
    for part, which in _pairs("parts", text).items():
        try:
            parts[part] = indices_of(which, MOST - sum(map(len, parts.values())))
        except RecordingError as fault:
            raise EvaError(str(fault)) from None
    return parts


def _require_confirmed(form: QueryDict) -> None:
    """Raise Conflict unless the form repeats the dataset's name, before deleting episodes."""
    name = form.get("dataset", "").removeprefix("datasets/")
    if form.get("confirm", "").strip() != name:
        raise Conflict(_NOTHING_DELETED_TYPE_NAME_DATASET(name=name))


def work_context(name: str) -> dict[str, Any]:
    """Return the context of templates/datasets/work.html: the newest jobs of a dataset, or of all."""
    jobs = dataset_jobs.jobs_of(name)
    return {"jobs": jobs, "passing": any(job.is_transient for job in jobs)}


def rights_context(request: HttpRequest) -> dict[str, Any]:
    """Return which orders the user may submit, and, if they may push and pull, with whose account on the hub."""
    role = role_of(request.user)
    hub = describe_hub_login(request.user) if role is Role.ADMIN else None
    return {"may_ask": role is not Role.VIEWER, "may_delete": role is Role.ADMIN, "hub": hub}
