"""Read-only admin pages of episodes, with an action that renews previews."""

from __future__ import annotations

from django.contrib import admin, messages
from django.db.models import QuerySet
from django.http import HttpRequest

from evaweb.episodes import services
from evaweb.episodes.models import Episode


@admin.register(Episode)
class EpisodeAdmin(admin.ModelAdmin):
    """Admin page of episodes; the folders are authoritative, and only services write the rows."""

    list_display = (
        "uuid",
        "status",
        "station",
        "kind",
        "mode",
        "checkpoint",
        "started_at",
        "frames",
        "dataset",
        "verified_at",
    )
    list_filter = ("status", "kind", "mode", "station", "checkpoint")
    search_fields = ("uuid", "task", "checkpoint", "operator")
    list_select_related = ("station",)
    actions = ("preview_again",)

    @admin.action(description="Make the previews anew", permissions=("view",))
    def preview_again(self, request: HttpRequest, episodes: QuerySet) -> None:
        for episode in episodes:
            services.request_preview(episode=episode)
        self.message_user(request, f"{len(episodes)} asked for", messages.SUCCESS)

    def has_add_permission(self, request: HttpRequest) -> bool:
        return False

    def has_change_permission(self, request: HttpRequest, obj: Episode | None = None) -> bool:
        return False

    def has_delete_permission(self, request: HttpRequest, obj: Episode | None = None) -> bool:
        return False
