"""Pages of named subsets."""

from __future__ import annotations

from django.contrib import messages
from django.http import HttpRequest
from django.http.response import HttpResponseBase
from django.shortcuts import redirect, render
from django.urls import reverse
from django.utils.http import urlencode
from django.views.decorators.http import require_GET, require_POST

from evaweb.blinding.visibility import visibility_for_request
from evaweb.core.errors import EvaError
from evaweb.datasets.views import rights_context, work_context
from evaweb.episodes import listed
from evaweb.episodes.subsets import create_subset, remove_subset, subset_get, subset_list
from evaweb.serving.lists import Listing


@require_GET
def subsets(request: HttpRequest) -> HttpResponseBase:
    """Show all subsets, with what found them, their datasets, and the checkpoints that were trained on them."""
    visibility = visibility_for_request(request)
    rows = [
        (subset, visibility.filter_visible(subset.checkpoints.all(), "pk"))
        for subset in subset_list(sight=visibility)
    ]
    context = {"rows": rows, "name": "", **work_context(""), **rights_context(request)}
    return render(request, "datasets/subsets.html", context)


@require_POST
def remove(request: HttpRequest) -> HttpResponseBase:
    """Remove the subset that the form names."""
    try:
        subset = subset_get(name=request.POST.get("name", ""))
        remove_subset(user=request.user, subset=subset)
        messages.success(request, f"{subset.name}: removed")
    except EvaError as error:
        messages.error(request, str(error))
    return redirect("subset-list")


@require_POST
def save_subset(request: HttpRequest) -> HttpResponseBase:
    """Save the episodes that the filters of the form find, or those of them that are `chosen`, under its name."""
    visibility = visibility_for_request(request)
    listing = Listing(request.POST, (), listed.filters(visibility))
    try:
        if listing.fault:
            raise EvaError(listing.fault)
        subset = create_subset(
            user=request.user,
            sight=visibility,
            name=request.POST.get("name", "").strip(),
            description=request.POST.get("description", "").strip(),
            query=listing.chosen,
            chosen=request.POST.getlist("chosen"),
        )
    except EvaError as error:
        messages.error(request, str(error))
        chosen = {key: value for key, value in listing.chosen.items() if value}
        return redirect(f"{reverse('replay-list')}?{urlencode(chosen)}")
    messages.success(request, f"{subset.name}: {subset.episodes.count()} episodes saved")
    return redirect("subset-list")
