"""Bags in the data folder become episodes by a proposed, corrected and saved mapping; pages and REST."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import tomli_w
from django.test import Client
from django.urls import reverse

from evaweb.core.errors import EvaError
from evaweb.datasets import bags, dataset_orders
from evaweb.datasets.overview import dataset_names
from evaweb.jobs.models import Job
from evaweb.jobs.services import run_queue
from runtime.datasets.consistency import check
from runtime.datasets.reader import open_dataset
from runtime.interop.bag_mapping import to_toml
from tests.evaweb.conftest import person
from tests.runtime.interop.test_bag_import import mapping, named, recorded, written

pytestmark = pytest.mark.django_db
Run = Callable[[], Job]


@pytest.fixture
def shelf(data: Path) -> Path:
    """The folder of bags, with two bags and what is none."""
    folder = data / "bags"
    (folder / "monday").mkdir(parents=True)
    written(folder / "monday" / "one.bag_mcap", recorded())
    written(folder / "two.bag_mcap", recorded(seconds=0.5))
    (folder / "notes.txt").write_text("tuesday")
    (folder / ".hidden.mcap").write_bytes(b"")
    return folder


@pytest.fixture
def run(data: Path) -> Run:
    def do() -> Job:
        run_queue("cpu")
        job = Job.objects.first()
        assert job is not None
        assert job.error == ""
        return job

    return do


def test_a_proposal_is_saved_and_imports_bags(operator: Client, data: Path, shelf: Path, run: Run) -> None:
    page, ask = reverse("bag-list"), reverse("dataset-ask")
    shown = operator.get(page).content.decode()
    assert "monday/one.bag_mcap" in shown
    assert "notes.txt" not in shown
    assert ".hidden" not in shown
    assert "Save a mapping first" in shown
    written(shelf / "named.bag_mcap", named("cam_left"))
    operator.post(ask, {"what": "propose", "bag": "named.bag_mcap", "robot": "ur5e"})
    proposal = run().result
    assert any("no topic is named after" in sentence for sentence in proposal["missing"])
    shown = operator.get(page).content.decode()
    assert "Proposal for named.bag_mcap and ur5e" in shown
    assert "/ur5e/leader/joint_states" in shown
    operator.post(ask, {"what": "propose", "bag": "two.bag_mcap", "robot": "ur5e"})
    assert "no topic has joints of ur5e" in run().result["why"]

    text = to_toml(mapping())
    saved = operator.post(reverse("bag-mapping"), {"mapping": "cell-3", "text": text}, follow=True)
    assert "cell-3: saved" in saved.content.decode()
    form = {
        "what": "import_bags",
        "bags": ["two.bag_mcap", "monday/one.bag_mcap"],
        "mapping": "cell-3",
        "to": "cups",
    }
    assert operator.post(ask, form)["Location"] == page
    job = run()
    assert (job.result["done"], job.result["episodes"], job.result["problems"]) == (True, 2, [])
    assert "Proposal for" not in operator.get(page).content.decode()  # a mapping was saved since
    nothing = operator.post(ask, {**form, "bags": []}, follow=True).content.decode()
    assert "tick at least one bag" in nothing
    assert check(data / "datasets" / "cups") == []
    assert [entry.length for entry in open_dataset(data / "datasets" / "cups").episodes] == [13, 26]
    assert "Import 2 bags to cups" in operator.get(page).content.decode()

    operator.post(ask, form | {"bags": "two.bag_mcap"})
    assert run().result["episodes"] == 1
    assert len(open_dataset(data / "datasets" / "cups").episodes) == 2  # the same bag is the same episode


def test_bags_that_fail_are_named_and_the_others_imported(
    operator: Client, data: Path, shelf: Path, run: Run
) -> None:
    bags.save_mapping("cell", to_toml(mapping()))
    (shelf / "broken.mcap").write_bytes(b"\x89MCAP0\r\n")
    order = {"what": "import_bags", "bags": ["broken.mcap", "two.bag_mcap"], "mapping": "cell", "to": "cups"}
    answer = operator.post("/api/v1/datasets/jobs", order, content_type="application/json")
    assert answer.status_code in (200, 201, 202), answer.content
    result = run().result
    assert (result["episodes"], len(result["problems"])) == (1, 1)
    assert "broken.mcap: " in result["problems"][0]


def test_a_full_disk_refuses_bags_and_leaves_nothing(
    operator: Client, data: Path, shelf: Path, run: Run, settings: Any
) -> None:
    bags.save_mapping("cell", to_toml(mapping()))
    settings.EVA_RESERVE_BYTES = 10**18
    dataset_orders.submit_order(
        user=person("otto", "operator"),
        given={"what": "import_bags", "bags": ["two.bag_mcap"], "mapping": "cell", "to": "cups"},
    )
    job = run()
    assert "stay free" in job.result["problems"][0]
    assert "dataset" not in job.result
    assert dataset_names() == []


@pytest.mark.parametrize(
    ("order", "why"),
    [
        (
            {"what": "propose", "bag": "three.mcap", "robot": "ur5e"},
            "no bag 'three.mcap'; there are: monday/one",
        ),
        ({"what": "propose", "bag": "../eva.sqlite3", "robot": "ur5e"}, "no bag '../eva.sqlite3'"),
        (
            {"what": "propose", "bag": "two.bag_mcap", "robot": "/tmp/robot"},
            "robot = '/tmp/robot'; allowed: ",
        ),
        (
            {"what": "import_bags", "bags": ["two.bag_mcap"], "mapping": "none", "to": "x"},
            "no mapping 'none'",
        ),
        ({"what": "import_bags", "bags": [], "mapping": "cell", "to": "x"}, "bags: "),
        (
            {"what": "import_bags", "bags": ["two.bag_mcap"], "mapping": "cell", "to": "bags/x"},
            "names no dataset",
        ),
    ],
)
def test_orders_that_name_nothing_are_refused(shelf: Path, order: dict[str, Any], why: str) -> None:
    bags.save_mapping("cell", to_toml(mapping()))
    with pytest.raises(EvaError, match=re.escape(why)):
        dataset_orders.submit_order(user=person("otto", "operator"), given=order)


@pytest.mark.parametrize(
    ("name", "change", "why"),
    [
        ("../cell", {}, "mapping = &#x27;../cell&#x27;"),
        ("cell", {"robot": "/tmp/robot"}, "robot = &#x27;/tmp/robot&#x27;; allowed: "),
        ("cell", {"fps": 0}, "fps"),
        ("cell", {"state": [{"topic": "/a", "joints": {"nose": "nose"}}]}, "has no source"),
    ],
)
def test_a_mapping_that_is_refused_is_shown_again(
    operator: Client, shelf: Path, name: str, change: dict[str, Any], why: str
) -> None:
    tree = mapping().model_dump(exclude_none=True) | change
    text = tomli_w.dumps(tree)
    answer = operator.post(reverse("bag-mapping"), {"mapping": name, "text": text})
    assert answer.status_code == 400
    page = answer.content.decode()
    assert why in page
    assert "/ur5e/joint_states" in page or "nose" in page
    assert bags.mapping_names() == []


def test_viewers_see_bags_and_save_nothing(client: Client, shelf: Path) -> None:
    client.force_login(person("vera", "viewer"))
    page = client.get(reverse("bag-list")).content.decode()
    assert "two.bag_mcap" in page
    assert "Propose a mapping" not in page
    form = {"mapping": "cell", "text": to_toml(mapping())}
    assert client.post(reverse("bag-mapping"), form).status_code == 403
    assert bags.mapping_names() == []
