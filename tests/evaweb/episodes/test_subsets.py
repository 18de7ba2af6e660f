"""Named subsets: what they keep, who sees them, and the datasets and checkpoints that follow from them."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from django.contrib.auth.models import User
from django.test import Client
from django.urls import reverse

from evaweb.blinding.visibility import FULL_VISIBILITY, Visibility
from evaweb.core.errors import Conflict, EvaError, NotAllowed
from evaweb.datasets import dataset_orders
from evaweb.episodes.models import Episode, Subset
from evaweb.episodes.reconcile import reconcile
from evaweb.episodes.subsets import create_subset, remove_subset, subset_list, subset_uuids
from evaweb.jobs import doorbell
from evaweb.jobs.models import Job
from evaweb.jobs.services import run_queue
from evaweb.trials.models import Checkpoint
from runtime.datasets.consistency import check
from runtime.datasets.publishing import publish
from runtime.datasets.reader import open_dataset
from tests.evaweb.conftest import person
from tests.runtime.datasets.small import record

pytestmark = pytest.mark.django_db
Keep = Callable[..., Subset]


@pytest.fixture
def data(settings: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    settings.DATA_DIR = tmp_path
    monkeypatch.setattr(doorbell, "notify_workers", lambda queue: True)
    return tmp_path


@pytest.fixture
def ann() -> User:
    return person("ann", "operator")


@pytest.fixture
def recordings(data: Path) -> list[str]:
    """Three episodes in two datasets, and one that was never published; the oldest first."""
    folders = [record(data / "episodes", frames=6 + n, started_wall=1.7e9 + n) for n in range(4)]
    for folder, name in zip(folders, ("one", "two", "one"), strict=False):
        publish(folder, data / "datasets" / name, success=True)
    reconcile()
    return [folder.name for folder in folders]


@pytest.fixture
def keep(ann: User) -> Keep:
    def do(name: str = "clean-1", *, sight: Visibility = FULL_VISIBILITY, **query: str) -> Subset:
        return create_subset(user=ann, sight=sight, name=name, query=query)

    return do


def published(user: User, name: str) -> dict[str, Any]:
    job = dataset_orders.submit_order(user=user, given={"what": "subset", "subset": name})
    run_queue("cpu")
    row = Job.objects.get(pk=job.pk)
    assert row.error == ""
    return dict(row.result)


def test_a_subset_keeps_what_was_found_and_becomes_a_dataset(
    data: Path, recordings: list[str], ann: User, keep: Keep
) -> None:
    one, two, three, unpublished = recordings
    kept = keep(words="")
    assert subset_uuids(subset=kept) == [one, two, three]
    assert kept.digest == hashlib.sha256("\n".join(sorted([one, two, three])).encode()).hexdigest()
    publish(data / "episodes" / unpublished, data / "datasets" / "two", success=True)
    reconcile()
    assert kept.episodes.count() == 3

    result = published(ann, "clean-1")
    assert (result["done"], result["dataset"], result["episodes"]) == (True, "datasets/clean-1", 3)
    folder = data / "datasets" / "clean-1"
    assert check(folder) == []
    assert sorted(entry.length for entry in open_dataset(folder).episodes) == [6, 7, 8]
    said = json.loads((folder / "meta" / "eva_subset.json").read_text())
    assert (said["name"], said["episodes"], said["digest"]) == ("clean-1", 3, kept.digest)
    assert "ann" not in json.dumps(said)
    kept.refresh_from_db()
    assert kept.dataset == "datasets/clean-1"
    homes = set(Episode.objects.filter(subsets=kept).values_list("dataset", flat=True))
    assert homes == {"datasets/one", "datasets/two"}  # a copy is nobody's home


def test_an_episode_that_left_its_dataset_is_named(
    data: Path, recordings: list[str], ann: User, keep: Keep
) -> None:
    keep()
    root = person("root", "operator", "admin")
    job = dataset_orders.submit_order(user=ann, given={"what": "subset", "subset": "clean-1"})
    Job.objects.filter(pk=job.pk).update(status="done")
    dataset_orders.submit_order(user=root, given={"what": "delete", "dataset": "one", "episodes": [0]})
    run_queue("cpu")
    Job.objects.filter(pk=job.pk).update(status="queued", attempts=0)
    run_queue("cpu")
    result = Job.objects.get(pk=job.pk).result
    assert result["done"] is False
    assert f"such as {recordings[0]}" in result["why"]
    assert not (data / "datasets" / "clean-1").exists()


def test_a_subset_is_removed_until_it_is_used(
    recordings: list[str], keep: Keep, ann: User, client: Client
) -> None:
    client.force_login(ann)
    keep("mine")
    assert "Remove mine" in client.get(reverse("subset-list")).content.decode()
    client.post(reverse("subset-remove"), {"name": "mine"})
    assert not Subset.objects.exists()
    assert Episode.objects.count() == 4
    kept = keep("mine")
    Checkpoint.objects.create(name="pi0-mine", training_set=kept)
    assert "Remove mine" not in client.get(reverse("subset-list")).content.decode()
    page = client.post(reverse("subset-remove"), {"name": "mine"}, follow=True).content.decode()
    assert "is stated at a checkpoint" in page
    Checkpoint.objects.all().delete()
    with pytest.raises(NotAllowed):
        remove_subset(user=person("vera", "viewer"), subset=kept)
    Subset.objects.update(dataset="datasets/mine")
    with pytest.raises(Conflict, match="was published"):
        remove_subset(user=ann, subset=kept)


def test_names_are_taken_once_and_empty_subsets_refused(recordings: list[str], keep: Keep, ann: User) -> None:
    keep()
    with pytest.raises(Conflict, match="already"):
        keep()
    with pytest.raises(EvaError, match="name: "):
        keep("../up")
    with pytest.raises(EvaError, match="no episode of these"):
        keep("none", words="no such words")
    Episode.objects.filter(uuid=recordings[0]).update(robot="another")
    with pytest.raises(EvaError, match="of 2 robots"):
        keep("mixed")
    with pytest.raises(NotAllowed):
        create_subset(user=person("vera", "viewer"), sight=FULL_VISIBILITY, name="v", query={})
    assert Subset.objects.count() == 1


def test_hidden_policies_are_left_out(recordings: list[str], keep: Keep, ann: User) -> None:
    hidden = Checkpoint.objects.create(name="pi0-secret")
    Episode.objects.filter(uuid=recordings[0]).update(checkpoint="pi0-secret")
    blind = Visibility(checkpoints=frozenset({hidden.pk}), names=frozenset({"pi0-secret"}), user=ann.pk)
    kept = keep("blind", sight=blind)
    assert recordings[0] not in subset_uuids(subset=kept)
    seen = keep("seen")  # by somebody from whom nothing is hidden
    named = keep("named", words="pi0-secret")
    assert subset_list(sight=blind) == [seen, kept]
    assert subset_list(sight=FULL_VISIBILITY) == [named, seen, kept]


def test_pages_and_rest_keep_show_and_publish(
    client: Client, data: Path, recordings: list[str], ann: User
) -> None:
    client.force_login(ann)
    listed = client.get(reverse("replay-list") + "?status=finished").content.decode()
    assert "Save as a subset" in listed
    form = {"name": "mine", "description": "for pi0", "status": "finished"}
    page = client.post(reverse("subset-save"), form, follow=True).content.decode()
    assert "mine: 3 episodes saved" in page
    assert "status: finished" in page
    ticked = form | {"name": "ticked", "chosen": [recordings[1], recordings[3]]}
    page = client.post(reverse("subset-save"), ticked, follow=True).content.decode()
    assert "ticked: 1 episodes saved" in page  # the other was never published
    assert "chosen: 2" in page
    Subset.objects.get(name="ticked").delete()
    odd = client.post(reverse("subset-save"), ticked | {"chosen": "x"}, follow=True)
    assert "allowed: UUIDs of episodes" in odd.content.decode()
    refused = client.post(reverse("subset-save"), form, follow=True)
    assert "already" in refused.content.decode()
    assert refused.redirect_chain[-1][0].endswith("?status=finished")

    given = {"name": "by-script", "query": {"status": "finished"}}
    answer = client.post("/api/v1/subsets", given, content_type="application/json")
    assert (answer.status_code, answer.json()["episodes"]) == (201, 3)
    wrong = client.post(
        "/api/v1/subsets", given | {"query": {"colour": "red"}}, content_type="application/json"
    )
    assert "colour" in wrong.json()["error"]

    client.post(reverse("dataset-ask"), {"what": "subset", "subset": "mine"})
    run_queue("cpu")
    Checkpoint.objects.create(name="pi0-mine", training_set=Subset.objects.get(name="mine"))
    page = client.get(reverse("subset-list")).content.decode()
    assert reverse("dataset", args=["datasets/mine"]) in page
    assert "pi0-mine" in page
    (_, shown) = sorted(client.get("/api/v1/subsets").json(), key=lambda row: str(row["name"]))
    assert (shown["dataset"], shown["checkpoints"]) == ("datasets/mine", ["pi0-mine"])
    only = client.get(reverse("replay-list") + "?subset=mine").content.decode()
    assert recordings[0] in only
    assert recordings[3] not in only
