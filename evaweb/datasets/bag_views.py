"""Page of bags: which there are, mappings of their topics, and their import."""

from __future__ import annotations

from typing import Any

from django.contrib import messages
from django.http import HttpRequest
from django.http.response import HttpResponseBase
from django.shortcuts import redirect, render
from django.urls import reverse
from django.views.decorators.http import require_GET, require_POST

import robots
from evaweb.accounts.roles import Role, require_role
from evaweb.core.errors import EvaError
from evaweb.datasets.bags import (
    bags_dir,
    list_bags,
    mapping_names,
    newest_mapping_at,
    read_mapping_text,
    save_mapping,
)
from evaweb.datasets.dataset_orders import KIND
from evaweb.datasets.overview import dataset_names
from evaweb.datasets.views import rights_context, work_context
from evaweb.episodes.models import Episode
from evaweb.jobs.models import Job, JobStatus


@require_GET
def bag_list(request: HttpRequest) -> HttpResponseBase:
    """Show the bags, a mapping to edit (`mapping` of the query, or else the newest proposal), and the import."""
    name = request.GET.get("mapping", "")
    proposal = None if name else _newest_proposal()
    text = read_mapping_text(name) if name else ""
    if proposal is not None:
        text = proposal.result["mapping"]
    return render(request, "datasets/bags.html", _context(request, name, text) | {"proposal": proposal})


@require_POST
def bag_mapping(request: HttpRequest) -> HttpResponseBase:
    """Save the mapping of the form; if it is refused, show it again with the reason."""
    require_role(request.user, Role.OPERATOR)
    name, text = request.POST.get("mapping", "").strip(), request.POST.get("text", "")
    try:
        save_mapping(name, text)
    except EvaError as error:
        messages.error(request, str(error))
        return render(request, "datasets/bags.html", _context(request, name, text), status=400)
    messages.success(request, f"{name}: saved")
    return redirect(f"{reverse('bag-list')}?mapping={name}")


def _newest_proposal() -> Job | None:
    """Return the newest proposal; None if there is none, or a mapping was saved since."""
    job = Job.objects.filter(
        kind=KIND, args__what="propose", status=JobStatus.DONE, result__done=True
    ).first()
    saved = newest_mapping_at()
    if job is None or (saved is not None and job.finished_at is not None and saved > job.finished_at):
        return None
    return job


def _context(request: HttpRequest, name: str, text: str) -> dict[str, Any]:
    newest = Episode.objects.exclude(robot="").first()
    return {
        "bags": list_bags(),
        "folder": bags_dir(),
        "robot": newest.robot if newest else "",
        "mappings": mapping_names(),
        "mapping": name,
        "text": text,
        "robots": robots.robot_names(),
        "datasets": [one.removeprefix("datasets/") for one in dataset_names()],
        "name": "",
        **work_context(""),
        **rights_context(request),
    }
