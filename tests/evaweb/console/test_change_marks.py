"""Every change that a page shows has another mark."""

from __future__ import annotations

import asyncio

import pytest
from django.db import OperationalError
from django.utils import timezone

from evaweb.console.change_marks import change_marks, changed_names, read_marks
from evaweb.episodes.models import Episode, EpisodeStatus
from evaweb.jobs.models import Job, JobStatus
from evaweb.stations.models import Lease, LeaseRequest, Station


@pytest.fixture
def station(db):
    return Station.objects.create(name="changing", robot="agilex_piper")


def changed(work):
    before = change_marks("changing")
    work()
    return changed_names(before, change_marks("changing"))


def test_nothing_changes_by_itself(station):
    assert changed(lambda: None) == []


def test_leases_and_requests_are_seen_from_start_to_end(station, ann):
    assert changed(lambda: Lease.objects.create(station=station, holder="a", epoch=1)) == ["lease"]
    assert changed(lambda: Lease.objects.update(ended_at=timezone.now())) == ["lease"]
    assert changed(lambda: LeaseRequest.objects.create(station=station, user=ann, holder="b")) == ["lease"]
    assert changed(lambda: LeaseRequest.objects.update(answered_at=timezone.now())) == ["lease"]


def test_episodes_and_jobs_are_seen_from_start_to_end(station):
    assert changed(lambda: Episode.objects.create(station=station)) == ["episode"]
    assert changed(lambda: Episode.objects.update(status=EpisodeStatus.FINISHED)) == ["episode"]
    assert changed(lambda: Episode.objects.update(previewed_at=timezone.now())) == ["episode"]
    assert changed(lambda: Job.objects.create(kind="preview", key="preview:1")) == ["job"]
    assert changed(lambda: Job.objects.update(status=JobStatus.RUNNING)) == ["job"]
    assert changed(lambda: Job.objects.update(status=JobStatus.DONE, finished_at=timezone.now())) == ["job"]


def test_another_stations_lease_is_none_of_its_business(station):
    other = Station.objects.create(name="other", robot="agilex_piper")
    assert changed(lambda: Lease.objects.create(station=other, holder="a", epoch=1)) == []


@pytest.mark.django_db(transaction=True)
def test_a_database_that_does_not_answer_says_nothing(monkeypatch, caplog):
    def locked(station):
        raise OperationalError("database is locked")

    monkeypatch.setattr("evaweb.console.change_marks.change_marks", locked)
    assert asyncio.run(read_marks("changing")) is None
    assert "database is locked" in caplog.text
