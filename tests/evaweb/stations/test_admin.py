"""The admin pages of stations and their records."""

from __future__ import annotations

import pytest
from django.contrib.auth.models import User
from django.urls import reverse

from evaweb.stations.models import Command, Lease, LeaseRequest, Station

pytestmark = pytest.mark.django_db


@pytest.fixture
def admin(client, ann):
    station = Station.objects.create(name="bench-9", robot="agilex_piper")
    Lease.objects.create(station=station, user=ann, holder="web:ann:p1", epoch=1)
    LeaseRequest.objects.create(station=station, user=ann, holder="web:ann:p2")
    Command.objects.create(station=station, user=ann, kind="run")
    client.force_login(User.objects.create_superuser("root"))
    return client


def test_a_station_is_added_with_a_robot_that_there_is(admin):
    page = reverse("admin:stations_station_add")
    given = {"name": "bench-10", "robot": "agilex_piper", "active": "on"}
    assert admin.post(page, {**given, "robot": "nobody"}).status_code == 200
    assert not Station.objects.filter(name="bench-10").exists()
    assert admin.post(page, {**given, "name": "no/name"}).status_code == 200
    assert admin.post(page, given).status_code == 302
    assert Station.objects.get(name="bench-10").active


def test_a_stations_name_stays_and_it_is_not_deleted(admin):
    station = Station.objects.get(name="bench-9")
    page = reverse("admin:stations_station_change", args=[station.pk])
    admin.post(page, {"name": "other", "robot": "agilex_piper", "message": "being repaired"})
    station.refresh_from_db()
    assert (station.name, station.message, station.active) == ("bench-9", "being repaired", False)
    assert admin.get(reverse("admin:stations_station_delete", args=[station.pk])).status_code == 403


@pytest.mark.parametrize("model", [Lease, LeaseRequest, Command])
def test_records_are_read_and_not_edited(admin, model):
    name = model._meta.model_name
    assert admin.get(reverse(f"admin:stations_{name}_changelist")).status_code == 200
    page = reverse(f"admin:stations_{name}_change", args=[model.objects.get().pk])
    assert admin.get(page).status_code == 200
    assert admin.post(page, {}).status_code == 403
    assert admin.get(reverse(f"admin:stations_{name}_add")).status_code == 403
