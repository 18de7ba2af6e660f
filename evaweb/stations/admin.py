"""Stations in the admin pages; leases and commands are records and only read there."""

from __future__ import annotations

from typing import Any

from django import forms
from django.contrib import admin
from django.http import HttpRequest

import robots
from evaweb.stations.models import Command, Lease, LeaseRequest, Station


class StationForm(forms.ModelForm):
    """A station, its robot chosen from those there are."""

    class Meta:
        model = Station
        fields = ("name", "title", "robot", "deployment", "simulated", "active", "message")

    def __init__(self, *args: Any, **named: Any) -> None:
        super().__init__(*args, **named)
        self.fields["robot"] = forms.ChoiceField(choices=[(name, name) for name in robots.names()])


@admin.register(Station)
class StationAdmin(admin.ModelAdmin):
    """A station is switched off rather than removed: its records refer to it."""

    form = StationForm
    list_display = ("name", "title", "robot", "simulated", "active", "message")
    list_filter = ("active", "simulated", "robot")
    search_fields = ("name", "title")

    def get_readonly_fields(self, request: HttpRequest, obj: Station | None = None) -> tuple[str, ...]:
        return ("name",) if obj else ()  # the station's folder has this name

    def has_delete_permission(self, request: HttpRequest, obj: Station | None = None) -> bool:
        return False


class RecordAdmin(admin.ModelAdmin):
    """Records of what happened, which are not edited."""

    def has_add_permission(self, request: HttpRequest) -> bool:
        return False

    def has_change_permission(self, request: HttpRequest, obj: Any = None) -> bool:
        return False

    def has_delete_permission(self, request: HttpRequest, obj: Any = None) -> bool:
        return False


@admin.register(Lease)
class LeaseAdmin(RecordAdmin):
    """Leases of stations."""

    list_display = ("station", "holder", "epoch", "granted_at", "ended_at", "end_reason")
    list_filter = ("station",)
    search_fields = ("holder",)
    date_hierarchy = "granted_at"
    list_select_related = ("station",)


@admin.register(LeaseRequest)
class LeaseRequestAdmin(RecordAdmin):
    """Requests for stations."""

    list_display = ("station", "user", "asked_at", "answer", "answered_at")
    list_filter = ("station", "answer")
    list_select_related = ("station", "user")


@admin.register(Command)
class CommandAdmin(RecordAdmin):
    """Commands and their results."""

    list_display = ("issued_at", "station", "kind", "user", "status", "reason")
    list_filter = ("station", "kind", "status")
    search_fields = ("uuid", "reason", "user__username")
    date_hierarchy = "issued_at"
    list_select_related = ("station", "user")
