"""What is left of an order that was cancelled, and who may ask for it again."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from django.contrib.auth.models import User
from django.test import Client

from evaweb.datasets import dataset_orders
from evaweb.datasets.overview import dataset_names, overview
from evaweb.episodes.models import Episode
from evaweb.jobs import services
from evaweb.jobs.models import Job, JobStatus
from runtime.datasets import operations
from tests.evaweb.conftest import person
from tests.evaweb.datasets.conftest import Foreign

pytestmark = pytest.mark.django_db


@pytest.fixture
def root(data: Path) -> User:
    return person("root", "operator", "admin")


def ordered(root: User, **given: Any) -> Job:
    job = dataset_orders.submit_order(user=root, given=given)
    services.run_queue("cpu")
    job.refresh_from_db()
    return job


def test_what_only_administrators_order_only_they_ask_for_again(
    foreign: Foreign, root: User, client: Client
) -> None:
    foreign("cups", version="v3.0")
    job = dataset_orders.submit_order(user=root, given={"what": "delete", "dataset": "cups", "episodes": [0]})
    services.cancel(user=root, job=job)
    client.force_login(person("ann", "operator"))
    client.post("/jobs/repeat", {"job": job.pk})
    assert services.run_queue("cpu") == 0
    assert overview("datasets/cups").episodes == 3


def test_a_split_that_is_cancelled_leaves_no_part_in_the_way_of_the_next(
    foreign: Foreign, root: User, monkeypatch: pytest.MonkeyPatch
) -> None:
    foreign("cups", version="v3.0")
    told = services._tell

    def tell(work: Any, words: str) -> None:
        if words.startswith("test:"):
            services.cancel(user=root, job=Job.objects.get(pk=work.pk))
        told(work, words)

    parts = {"train": [0, 2], "test": [1]}
    with monkeypatch.context() as pressed:
        pressed.setattr(services, "_tell", tell)
        job = ordered(root, what="split", dataset="cups", to="parts", parts=parts)
    assert job.status == JobStatus.FAILED
    assert list(dataset_names()) == ["datasets/cups"]
    assert ordered(root, what="split", dataset="cups", to="parts", parts=parts).result["done"] is True


def test_the_database_follows_a_dataset_that_was_changed_before_the_order_was_cancelled(
    foreign: Foreign, root: User, monkeypatch: pytest.MonkeyPatch
) -> None:
    foreign("cups", version="v3.0")
    ordered(root, what="import", dataset="cups")
    delete = operations.delete

    def pressed_at_its_end(*given: Any, **more: Any) -> Any:
        delete(*given, **more)
        services.cancel(user=root, job=Job.objects.get(status=JobStatus.RUNNING))
        more["tell"]("all of it is done")

    monkeypatch.setattr(operations, "delete", pressed_at_its_end)
    job = ordered(root, what="delete", dataset="cups", episodes=[0])
    assert (job.status, job.error) == (JobStatus.FAILED, "cancelled by root")
    assert overview("datasets/cups").episodes == 2
    assert sorted(Episode.objects.exclude(dataset_index=None).values_list("dataset_index", flat=True)) == [
        0,
        1,
    ]
