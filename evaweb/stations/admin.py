"""Admin pages of stations; leases and commands are read-only records."""

from __future__ import annotations

from typing import Any

from django import forms
from django.contrib import admin, messages
from django.db.models import QuerySet
from django.http import HttpRequest, HttpResponse, HttpResponseRedirect
from django.shortcuts import get_object_or_404, render
from django.urls import URLPattern, path, reverse

import robots
from evaweb.core.errors import EvaError
from evaweb.stations.enrolment import VALID, code_make, key_withdraw
from evaweb.stations.models import Command, Lease, LeaseRequest, Station, StationKey


class StationForm(forms.ModelForm):
    """Form of a station with a choice of the existing robots."""

    class Meta:
        model = Station
        fields = ("name", "title", "robot", "deployment", "simulated", "active", "message")

    def __init__(self, *args: Any, **named: Any) -> None:
        super().__init__(*args, **named)
        own = (self.instance.robot,) if self.instance.pk else ()  # may be the robot of a bench alone
        names = dict.fromkeys((*robots.robot_names(), *own))
        self.fields["robot"] = forms.ChoiceField(choices=[(name, name) for name in names])


@admin.register(Station)
class StationAdmin(admin.ModelAdmin):
    """Admin page of stations, which are deactivated instead of deleted, because records refer to them."""

    form = StationForm
    change_form_template = "stations/admin_station.html"
    list_display = ("name", "title", "robot", "simulated", "active", "message")
    list_filter = ("active", "simulated", "robot")
    search_fields = ("name", "title")

    def get_readonly_fields(self, request: HttpRequest, obj: Station | None = None) -> tuple[str, ...]:
        return ("name",) if obj else ()  # the station's folder has this name

    def has_delete_permission(self, request: HttpRequest, obj: Station | None = None) -> bool:
        return False

    def get_urls(self) -> list[URLPattern]:
        """Add the page that shows an enrolment code."""
        own = self.admin_site.admin_view(self.enrol_view)
        return [path("<int:object_id>/enrol/", own, name="stations_station_enrol"), *super().get_urls()]

    def enrol_view(self, request: HttpRequest, object_id: int) -> HttpResponse:
        """Explain enrolment; on POST create a code and show it once."""
        station = get_object_or_404(Station, pk=object_id)
        code = None
        if request.method == "POST":
            try:
                code = code_make(user=request.user, station=station)
            except EvaError as fault:
                messages.error(request, str(fault))
                back = reverse("admin:stations_station_change", args=[object_id])
                return HttpResponseRedirect(back)
        context = {
            **self.admin_site.each_context(request),
            "title": f"Enrol a computer as {station.name}",
            "opts": self.opts,
            "station": station,
            "key": station.keys.filter(withdrawn_at=None).first(),
            "shown": code,
            "minutes": int(VALID.total_seconds() // 60),
        }
        return render(request, "stations/admin_enrol.html", context)


class RecordAdmin(admin.ModelAdmin):
    """Base of admin pages of read-only records."""

    def has_add_permission(self, request: HttpRequest) -> bool:
        return False

    def has_change_permission(self, request: HttpRequest, obj: Any = None) -> bool:
        return False

    def has_delete_permission(self, request: HttpRequest, obj: Any = None) -> bool:
        return False


@admin.register(StationKey)
class StationKeyAdmin(RecordAdmin):
    """Admin page of the keys of computers, current and withdrawn."""

    list_display = ("station", "computer", "enrolled_at", "enrolled_by", "withdrawn_at", "withdrawn")
    list_filter = ("station",)
    list_select_related = ("station", "enrolled_by")
    actions = ("withdraw",)

    @admin.action(description="Withdraw: the computer is cut off within a second")
    def withdraw(self, request: HttpRequest, rows: QuerySet[StationKey]) -> None:
        """Withdraw the selected keys."""
        for key in rows.select_related("station"):
            key_withdraw(user=request.user, key=key)
            messages.success(request, f"The key of {key.station.name} is withdrawn.")


@admin.register(Lease)
class LeaseAdmin(RecordAdmin):
    """Admin page of leases of stations."""

    list_display = ("station", "holder", "epoch", "granted_at", "ended_at", "end_reason")
    list_filter = ("station",)
    search_fields = ("holder",)
    date_hierarchy = "granted_at"
    list_select_related = ("station",)


@admin.register(LeaseRequest)
class LeaseRequestAdmin(RecordAdmin):
    """Admin page of requests for stations."""

    list_display = ("station", "user", "asked_at", "answer", "answered_at")
    list_filter = ("station", "answer")
    list_select_related = ("station", "user")


@admin.register(Command)
class CommandAdmin(RecordAdmin):
    """Admin page of commands and their results."""

    list_display = ("issued_at", "station", "kind", "user", "status", "reason")
    list_filter = ("station", "kind", "status")
    search_fields = ("uuid", "reason", "user__username")
    date_hierarchy = "issued_at"
    list_select_related = ("station", "user")
