"""A push or pull runs with the Hugging Face token of the person who ordered it, and with no other."""

from __future__ import annotations

import logging
import zipfile
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import huggingface_hub
import pytest
from django.apps import apps
from django.contrib.auth.models import User
from django.test import Client
from django.urls import reverse

from evaweb.accounts.hub_tokens import remove_hub_token, store_hub_token
from evaweb.blinding.visibility import FULL_VISIBILITY
from evaweb.core.environment import HUB_KEY
from evaweb.core.errors import Conflict, NotAllowed
from evaweb.datasets import dataset_jobs, dataset_orders
from evaweb.jobs.models import Job, JobStatus
from evaweb.jobs.services import retry_job, run_queue
from evaweb.lab.backups.file_copies import FileCopies
from evaweb.lab.diagnosis import bundle
from tests.evaweb.conftest import person
from tests.runtime.datasets.hub_server import Hub, served_hub

pytestmark = pytest.mark.django_db
Foreign = Callable[..., Path]
LABS, ALMAS, BEAS = "hf_LabLabLabLabLabLab0000", "hf_AlmaAlmaAlmaAlma1111", "hf_BeaBeaBeaBeaBea2222"
PUSH = {"what": "push", "dataset": "cups", "repository": "lab/cups"}
PULL = {"what": "pull", "repository": "lab/cups"}


@pytest.fixture
def hub(monkeypatch: pytest.MonkeyPatch) -> Iterator[Hub]:
    """The hub's own client, which talks to a stand-in; the lab's login is in the environment."""
    monkeypatch.setenv("HF_TOKEN", LABS)
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_DISABLE_XET", True)
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_DISABLE_TELEMETRY", True)
    with served_hub() as served:
        for name in ("HfApi", "snapshot_download"):
            ours = partial(getattr(huggingface_hub, name), endpoint=served.url)
            monkeypatch.setattr(huggingface_hub, name, ours)
        yield served


@pytest.fixture
def alma(data: Path) -> User:
    user = person("alma", "operator", "admin")
    store_hub_token(user=user, text=ALMAS)
    return user


@pytest.fixture
def bea(data: Path) -> User:
    user = person("bea", "operator", "admin")
    store_hub_token(user=user, text=BEAS)
    return user


def order(user: User, **given: Any) -> Job:
    return dataset_orders.submit_order(user=user, given=given)


def results(*jobs: Job) -> list[dict[str, Any]]:
    run_queue("cpu")
    for job in jobs:
        job.refresh_from_db()
        assert job.error == ""
    return [dict(job.result) for job in jobs]


def test_each_order_has_the_token_of_its_person_and_nothing_keeps_it(
    hub: Hub,
    foreign: Foreign,
    alma: User,
    bea: User,
    data: Path,
    client: Client,
    caplog: pytest.LogCaptureFixture,
) -> None:
    foreign("cups")
    caplog.set_level(logging.DEBUG)
    (pushed,) = results(order(alma, **PUSH))
    assert pushed["account"] == "alma", pushed
    assert set(hub.tokens) == {ALMAS}
    hub.tokens.clear()
    (pulled,) = results(order(bea, **PULL, to="back"))
    assert pulled["account"] == "bea", pulled
    assert set(hub.tokens) == {BEAS}
    hub.tokens.clear()
    root = person("root", "operator", "admin")
    (lent,) = results(order(root, **PUSH))
    assert lent["account"] == ""
    assert set(hub.tokens) == {LABS}

    hub.tokens.clear()
    hub.refused |= {ALMAS}
    (refused,) = results(order(alma, **PUSH))
    assert set(hub.tokens) == {ALMAS}, "no other account is tried"
    assert "is not pushed to lab/cups" in refused["why"]
    client.force_login(alma)
    pages = [
        client.get(reverse(name)).content.decode() for name in ("dataset-list", "jobs", "api:jobs", "account")
    ]
    assert "with the token of bea" in pages[0]
    assert "…1111" in pages[0]
    (data / "logs").mkdir()
    (data / "logs" / "worker.log").write_text(caplog.text + f"planted {ALMAS}\n")
    bundle.write(data / "bundle.zip", FULL_VISIBILITY, lambda part: None)
    with zipfile.ZipFile(data / "bundle.zip") as packed:
        packed_texts = [packed.read(name).decode() for name in packed.namelist()]
    tables = repr([list(model.objects.values()) for model in apps.get_models()])
    texts = [caplog.text, tables, *pages, *packed_texts]
    assert [text for text in texts if ALMAS in text or BEAS in text] == []
    copied = [listed.path for listed in FileCopies(data, data.with_name("copy"), None, ()).copy()]
    assert HUB_KEY not in copied
    assert "datasets/cups/meta/info.json" in copied


def test_a_token_that_was_removed_meanwhile_is_not_replaced_by_another(
    hub: Hub, foreign: Foreign, alma: User, bea: User
) -> None:
    foreign("cups")
    jobs = [order(alma, **PUSH), order(bea, **PUSH), order(alma, **PULL, to="back")]
    assert jobs[0].pk != jobs[1].pk  # one job of each person
    remove_hub_token(user=alma)
    User.objects.filter(pk=bea.pk).update(is_active=False)
    removed, switched_off, pull = results(*jobs)
    assert "removed meanwhile: enter one under Your account" in removed["why"]
    assert removed["why"] == pull["why"]
    assert "bea ordered this, and that account is switched off" in switched_off["why"]
    assert hub.tokens == []


def test_nobody_has_an_order_tried_again_with_the_token_of_another(
    hub: Hub, foreign: Foreign, alma: User, bea: User, client: Client
) -> None:
    foreign("cups")
    job = order(alma, **PUSH)
    Job.objects.update(status=JobStatus.FAILED)
    job.refresh_from_db()
    with pytest.raises(NotAllowed, match="uses an account of the person who ordered it"):
        retry_job(user=bea, job=job)
    client.force_login(bea)
    client.post(reverse("admin:jobs_job_changelist"), {"action": "try_again", "_selected_action": [job.pk]})
    assert not Job.objects.filter(status=JobStatus.QUEUED).exists()
    (pushed,) = results(retry_job(user=alma, job=job))
    assert pushed["account"] == "alma"


def test_without_any_login_an_order_says_where_to_enter_a_token(
    hub: Hub, foreign: Foreign, data: Path, client: Client, settings: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    foreign("cups")
    root = person("root", "operator", "admin")
    monkeypatch.setattr(huggingface_hub, "get_token", lambda: None)
    (refused,) = results(order(root, **PUSH))
    assert "the worker has no login at the Hugging Face hub: enter your own token" in refused["why"]
    old = Job.objects.create(kind="dataset", key="dataset:push:old", args={**PUSH, "private": True})
    settings.EVA_HUB_LAB_ACCOUNT = False
    with pytest.raises(Conflict, match="enter yours under Your account"):
        order(root, **PUSH)
    (refused,) = results(old)
    assert "EVA_HUB_LAB_ACCOUNT" in refused["why"]
    assert hub.tokens == []
    client.force_login(root)
    assert "It will be refused" in client.get(reverse("dataset-list")).content.decode()
    assert dataset_jobs.jobs_of()[0].state == "refused"
