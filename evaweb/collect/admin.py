"""Read-only admin pages of sessions.

Only services write the rows, after they have written the same content to the disk.
"""

from __future__ import annotations

from django.contrib import admin
from django.db.models import Count, QuerySet
from django.http import HttpRequest

from evaweb.collect.models import CollectSession, Demonstration, SessionEvent


class _ReadOnlyAdmin(admin.ModelAdmin):
    """Base of admin pages of read-only records."""

    def has_add_permission(self, request: HttpRequest) -> bool:
        return False

    def has_change_permission(self, request: HttpRequest, obj: object = None) -> bool:
        return False

    def has_delete_permission(self, request: HttpRequest, obj: object = None) -> bool:
        return False


class _Events(admin.TabularInline):
    model = SessionEvent
    fields = ("at", "kind", "text", "by")
    extra = 0
    can_delete = False

    def has_add_permission(self, request: HttpRequest, obj: object = None) -> bool:
        return False

    def has_change_permission(self, request: HttpRequest, obj: object = None) -> bool:
        return False


@admin.register(CollectSession)
class CollectSessionAdmin(_ReadOnlyAdmin):
    """Admin page of sessions, which are opened, closed and resumed on the station's Collect page."""

    list_display = ("task", "dataset", "station", "operator", "target", "episodes", "opened_at", "closed_at")
    list_filter = ("station", "dataset", "operator")
    search_fields = ("uuid", "task", "dataset")
    list_select_related = ("station", "operator")
    inlines = (_Events,)

    def get_queryset(self, request: HttpRequest) -> QuerySet[CollectSession]:
        return super().get_queryset(request).annotate(episode_count=Count("demonstrations"))

    @admin.display(description="episodes", ordering="episode_count")
    def episodes(self, session: CollectSession) -> int:
        """Return the number of episodes, including discarded ones."""
        return int(session.episode_count)  # type: ignore[attr-defined]


@admin.register(Demonstration)
class DemonstrationAdmin(_ReadOnlyAdmin):
    """Admin page of demonstrations with their labels."""

    list_display = ("episode", "session", "result", "discarded", "labelled_by", "labelled_at")
    list_filter = ("result", "discarded", "session__dataset")
    search_fields = ("episode__uuid", "session__uuid", "note")
    list_select_related = ("episode", "session")
