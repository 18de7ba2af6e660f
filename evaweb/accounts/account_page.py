"""Page on which users see their own account, and state their ORCID iD and their Hugging Face token."""

from __future__ import annotations

from typing import Any

from django.contrib import messages
from django.core.exceptions import ValidationError
from django.http import HttpRequest, HttpResponse
from django.shortcuts import redirect, render
from django.views.decorators.debug import sensitive_post_parameters
from django.views.decorators.http import require_http_methods

from evaweb.accounts.hub_tokens import describe_hub_login, remove_hub_token, store_hub_token
from evaweb.accounts.models import Profile
from evaweb.accounts.orcid import ADDRESS, parse_orcid
from evaweb.core.errors import EvaError


@sensitive_post_parameters("token")
@require_http_methods(["GET", "POST"])
def account(request: HttpRequest) -> HttpResponse:
    """Render the user's own account, or save what they entered in one of its forms; no answer contains a token."""
    if request.method == "GET":
        return _render(request)
    save = {"token": _save_token, "remove-token": _remove_token}.get(
        request.POST.get("what", ""), _save_orcid
    )
    return save(request)


def _save_orcid(request: HttpRequest) -> HttpResponse:
    typed = request.POST.get("orcid", "")
    try:
        orcid = parse_orcid(typed)
    except ValidationError as error:
        return _render(request, status=400, typed=typed, fault=error.message)
    user: Any = request.user
    Profile.objects.update_or_create(user=user, defaults={"orcid": orcid})
    messages.success(request, "ORCID iD saved" if orcid else "ORCID iD removed")
    return redirect("account")


def _save_token(request: HttpRequest) -> HttpResponse:
    try:
        store_hub_token(user=request.user, text=request.POST.get("token", ""))
    except EvaError as error:
        return _render(request, status=error.status, token_fault=str(error))
    messages.success(request, "Hugging Face token saved")
    return redirect("account")


def _remove_token(request: HttpRequest) -> HttpResponse:
    removed = remove_hub_token(user=request.user)
    messages.success(request, "Hugging Face token removed" if removed else "there was no Hugging Face token")
    return redirect("account")


def _render(request: HttpRequest, status: int = 200, **more: Any) -> HttpResponse:
    user: Any = request.user
    stored = Profile.objects.filter(user=user).values_list("orcid", flat=True).first() or ""
    context = {
        "title": "Your account",
        "orcid": stored,
        "typed": stored,
        "orcid_address": ADDRESS,
        "hub": describe_hub_login(user),
        **more,
    }
    return render(request, "registration/account.html", context, status=status)
