"""Failure gallery: clips of failed trials and their table."""

from __future__ import annotations

from collections.abc import Mapping

from django.core.paginator import Paginator
from django.http import HttpRequest, HttpResponse, StreamingHttpResponse
from django.shortcuts import render
from django.urls import reverse
from django.views.decorators.http import require_GET

from evaweb.accounts.roles import Role, role_of
from evaweb.blinding.visibility import visibility_for_request
from evaweb.core.errors import EvaError
from evaweb.core.tabular_export import iter_csv
from evaweb.episodes.selectors import playback_stage
from evaweb.serving.downloads import CSV, download
from evaweb.trials import clip_export, failures, gallery
from evaweb.trials.clips import clip_of
from evaweb.trials.gallery import FailureFilters
from evaweb.trials.selectors import TrialFilters, checkpoint_list, evaluation_list, scene_list

PER_PAGE = 24
_TRIALS = ("evaluation", "checkpoint", "scene", "station", "since")


@require_GET
def failure_gallery(request: HttpRequest) -> HttpResponse:
    """Show the clips of failed trials by group; the filters are in the URL."""
    visibility, filters, fault = visibility_for_request(request), _filters(request.GET), None
    try:
        groups = gallery.failure_groups(filters, visibility)
    except EvaError as problem:
        fault, filters = problem, FailureFilters()
        groups = gallery.failure_groups(filters, visibility)
    paginator = Paginator(gallery.failed_list(filters, visibility).values_list("pk", flat=True), PER_PAGE)
    paginator.count = sum(group.count for group in groups)  # type: ignore[misc]  # no second pass over all trials
    page = paginator.get_page(request.GET.get("page"))
    counts = {group.name: group.count for group in groups}
    context = {
        "page": page,
        "clips": [
            {
                "trial": trial,
                "group": (name := gallery.shown_group(trial, filters)),
                "count": counts.get(name, 0),
                "checkpoint": visibility.checkpoint_label(trial),
                "clip": (clip := clip_of(trial)),
                "address": clip.share if clip else reverse("result-trial", args=[trial.pk]),
                "stage": playback_stage(episode=trial.episode) if trial.episode else None,
            }
            for trial in gallery.failures_of(list(page), filters, visibility)
        ],
        "groups": groups,
        "evaluations": evaluation_list(),
        "scenes": scene_list(all_of_them=True).prefetch_related(None),
        "checkpoints": checkpoint_list(all_of_them=True, sight=visibility),
        "by": gallery.GROUPS,
        "filters": filters,
        "most_clips": clip_export.MOST,
        "levels": failures.failure_choices(),
        "may_change": role_of(request.user) is not Role.VIEWER,
        "fault": fault,
        "here": "failures",
    }
    return render(request, "trials/gallery.html", context, status=fault.status if fault else 200)


@require_GET
def failure_table(request: HttpRequest) -> StreamingHttpResponse:
    """Return all filtered failures as CSV with the URL of each clip."""
    visibility, filters = visibility_for_request(request), _filters(request.GET)
    gallery.failed_list(filters, visibility)  # reports invalid filters before the response begins
    root = request.build_absolute_uri("/").rstrip("/")
    pieces = iter_csv(gallery.COLUMNS, gallery.failure_rows(filters, visibility, root))
    return download(request, pieces, "failures.csv", CSV)


@require_GET
def failure_clips(request: HttpRequest) -> StreamingHttpResponse:
    """Return the clips and their table as a zip archive, generated while it is sent."""
    visibility, filters = visibility_for_request(request), _filters(request.GET)
    clip_export.require_few(filters, visibility)
    root = request.build_absolute_uri("/").rstrip("/")
    pieces = clip_export.clip_archive(filters, visibility, root)
    return download(request, pieces, "failures.zip", "application/zip")


def _filters(query: Mapping[str, str]) -> FailureFilters:
    values = {name: query.get(name, "").strip() for name in (*_TRIALS, "position", *failures.FIELDS)}
    return FailureFilters(
        trials=TrialFilters(**{name: values.pop(name) for name in _TRIALS}),
        group=query.get("group", "").strip() or "failure",
        **values,
    )
