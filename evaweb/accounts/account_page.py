"""Page on which users see their own account, and state their ORCID iD."""

from __future__ import annotations

from typing import Any

from django.contrib import messages
from django.core.exceptions import ValidationError
from django.http import HttpRequest, HttpResponse
from django.shortcuts import redirect, render
from django.views.decorators.http import require_http_methods

from evaweb.accounts.models import Profile
from evaweb.accounts.orcid import ADDRESS, parse_orcid


@require_http_methods(["GET", "POST"])
def account(request: HttpRequest) -> HttpResponse:
    """Render the user's own account, or save the ORCID iD that they typed."""
    user: Any = request.user
    stored = Profile.objects.filter(user=user).values_list("orcid", flat=True).first() or ""
    context = {"title": "Your account", "orcid": stored, "typed": stored, "orcid_address": ADDRESS}
    if request.method == "GET":
        return render(request, "registration/account.html", context)
    typed = request.POST.get("orcid", "")
    try:
        orcid = parse_orcid(typed)
    except ValidationError as error:
        return render(
            request,
            "registration/account.html",
            context | {"typed": typed, "fault": error.message},
            status=400,
        )
    Profile.objects.update_or_create(user=user, defaults={"orcid": orcid})
    messages.success(request, "ORCID iD saved" if orcid else "ORCID iD removed")
    return redirect("account")
