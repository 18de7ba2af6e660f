"""Preflight on a checkpoint's admin page; preflights themselves are read-only records."""

from __future__ import annotations

from typing import Any

from django.contrib import admin, messages
from django.http import HttpRequest, HttpResponse, HttpResponseNotAllowed, HttpResponseRedirect
from django.urls import URLPattern, path, reverse

from evaweb.core.errors import EvaError
from evaweb.preflights.models import Preflight
from evaweb.preflights.selectors import preflight_newest
from evaweb.preflights.services import refresh_preflight, start_preflight
from evaweb.preflights.views import context
from evaweb.stations.selectors import station_get, station_list
from evaweb.trials.admin import CheckpointAdmin
from evaweb.trials.models import Checkpoint
from evaweb.trials.selectors import checkpoint_get

admin.site.unregister(Checkpoint)


@admin.register(Checkpoint)
class PreflightedCheckpointAdmin(CheckpointAdmin):
    """Admin page of checkpoints, with the preflight of their servers."""

    change_form_template = "preflights/checkpoint.html"

    def get_urls(self) -> list[URLPattern]:
        """Add the URL that starts a preflight."""
        own = self.admin_site.admin_view(self.preflight_view)
        return [path("<path:object_id>/preflight/", own, name="checkpoint_preflight"), *super().get_urls()]

    def preflight_view(self, request: HttpRequest, object_id: str) -> HttpResponse:
        """Start a preflight on POST, and return to the checkpoint's page, which shows its result."""
        if request.method != "POST":
            return HttpResponseNotAllowed(["POST"])
        try:
            name = request.POST.get("station", "")
            start_preflight(
                user=request.user,
                checkpoint=checkpoint_get(name=object_id),
                station=station_get(name=name) if name else None,
            )
        except EvaError as fault:
            messages.error(request, f"Preflight: {fault}")
        back = reverse("admin:trials_checkpoint_change", args=[object_id])
        return HttpResponseRedirect(f"{back}#preflight")

    def change_view(self, request: HttpRequest, object_id: str, *given: Any, **named: Any) -> HttpResponse:
        """Add the newest preflight to the page."""
        extra = named.pop("extra_context", None) or {}
        checkpoint = Checkpoint.objects.filter(pk=object_id).first() if object_id.isdecimal() else None
        row = preflight_newest(checkpoint=checkpoint) if checkpoint else None
        if row is not None:
            extra = {**extra, **context(refresh_preflight(row=row), request.user)}
        extra = {**extra, "stations": station_list(), "checkpoint": checkpoint}
        return super().change_view(request, object_id, *given, extra_context=extra, **named)


@admin.register(Preflight)
class PreflightAdmin(admin.ModelAdmin):
    """Admin page of all preflights; they may be deleted, alone or with their checkpoint."""

    list_display = ("asked_at", "checkpoint", "station", "by", "status", "verdict", "user")
    list_filter = ("status", "checkpoint", "station", "by")
    list_select_related = ("checkpoint", "station", "user")
    date_hierarchy = "asked_at"

    def has_add_permission(self, request: HttpRequest) -> bool:
        """Return False: preflights are started on the checkpoint's page."""
        return False

    def has_change_permission(self, request: HttpRequest, obj: Preflight | None = None) -> bool:
        """Return False: results are not edited."""
        return False
