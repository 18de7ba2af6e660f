"""What is asked for about datasets, from pages, REST and terminal: who may, what is refused, what is then done."""

from __future__ import annotations

import io
import json
import re
import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from uuid import UUID, uuid4

import pytest
from django.contrib.auth.models import User
from django.core.management import CommandError, call_command
from django.test import Client
from django.urls import reverse

from evaweb.core.errors import (
    Conflict,
    EvaError,
    NotAllowed,
    NotFound,
)
from evaweb.datasets import dataset_orders
from evaweb.datasets.overview import dataset_names
from evaweb.episodes import exports
from evaweb.episodes.models import Episode
from evaweb.episodes.reconcile import reconcile
from evaweb.jobs.models import Job
from evaweb.jobs.services import run_queue
from evaweb.stations.models import Station
from runtime.datasets.consistency import check
from runtime.datasets.publishing import publish
from runtime.datasets.reader import open_dataset
from tests.evaweb.conftest import person
from tests.evaweb.trials import builders

pytestmark = pytest.mark.django_db
Foreign = Callable[..., Path]


Done = Callable[..., dict[str, Any]]


@pytest.fixture
def root(data: Path) -> User:
    """An administrator."""
    return person("root", "operator", "admin")


@pytest.fixture
def done(root: User) -> Done:
    """Have something done at once; returns what came of it."""

    def do(**order: Any) -> dict[str, Any]:
        job = dataset_orders.submit_order(user=root, given=order)
        run_queue("cpu")
        job.refresh_from_db()
        assert job.error == ""
        return dict(job.result)

    return do


def test_a_dataset_is_converted_split_and_merged_by_the_worker(
    foreign: Foreign, data: Path, done: Done
) -> None:
    foreign("cups", version="v2.1")
    made = done(what="convert", dataset="cups", to="cups-30", version="v3.0")
    assert (made["done"], made["dataset"], made["version"], made["episodes"]) == (
        True,
        "datasets/cups-30",
        "v3.0",
        3,
    )
    parts = done(what="split", dataset="cups-30", to="parts", parts={"train": [0, 2], "test": [1]})
    assert parts["datasets"] == ["datasets/parts/train", "datasets/parts/test"]
    merged = done(what="merge", datasets=["datasets/parts/train", "datasets/parts/test"], to="again")
    assert (merged["episodes"], merged["frames"]) == (3, 21)
    assert check(data / "datasets" / "again") == []
    assert dataset_names() == [
        f"datasets/{name}" for name in ("again", "cups", "cups-30", "parts/test", "parts/train")
    ]


def test_what_the_runtime_refuses_is_a_result_with_its_reason(foreign: Foreign, done: Done) -> None:
    foreign("cups")
    foreign("fast", fps=20.0)
    refused = done(what="merge", datasets=["cups", "fast"], to="both")
    assert refused["done"] is False
    assert "fps is 10.0, there 20.0" in refused["why"]
    assert "datasets/both" not in dataset_names()


def test_a_check_stays_true_until_the_dataset_changes(
    browser: Client, foreign: Foreign, data: Path, done: Done
) -> None:
    foreign("cups", version="v2.1")
    assert done(what="check", dataset="cups")["problems"] == []
    (row,) = browser.get("/api/v1/datasets").json()
    assert (row["check"]["problems"], row["check"]["fresh"]) == ([], True)
    (data / "datasets/cups/data/chunk-000/episode_000000.parquet").unlink()
    (problem, *_) = done(what="check", dataset="cups")["problems"]
    assert "episode_000000.parquet" in problem
    assert b"problem" in browser.get(reverse("dataset", args=["cups"])).content
    assert done(what="delete", dataset="cups", episodes=[1])["done"] is False


def test_episodes_are_deleted_once_however_often_the_job_is_done(
    foreign: Foreign, data: Path, root: User
) -> None:
    foreign("cups", version="v2.1")
    job = dataset_orders.submit_order(
        user=root, given={"what": "delete", "dataset": "cups", "episodes": [0, 0]}
    )
    with pytest.raises(Conflict, match="are being deleted"):
        dataset_orders.submit_order(user=root, given={"what": "delete", "dataset": "cups", "episodes": [1]})
    run_queue("cpu")
    Job.objects.filter(pk=job.pk).update(status="queued", attempts=0)  # its worker died after the last step
    run_queue("cpu")
    job.refresh_from_db()
    assert "nothing was deleted" in job.result["why"]
    assert [entry.length for entry in open_dataset(data / "datasets" / "cups").episodes] == [8, 7]


def test_every_episode_that_was_recorded_here_becomes_an_mcap_file(
    browser: Client, data: Path, journal: Callable[..., Path], done: Done
) -> None:
    folders = [journal(frames=6) for _ in range(4)]
    for folder in folders:
        publish(folder, data / "datasets" / "home", success=True)
    reconcile()
    known, damaged, unknown, _ = folders
    (damaged / "raw.arrow").write_bytes(b"")
    Episode.objects.filter(uuid=unknown.name).delete()
    form = {"dataset": "datasets/home", "what": "mcap", "pictures": "jpeg"}
    assert browser.post(reverse("dataset-ask"), form).status_code == 302
    assert Job.objects.get(args__what="mcap").args["pictures"] == "jpeg"
    made = done(what="mcap", dataset="home")
    assert (made["done"], made["files"], made["episodes"]) == (True, 2, 4)
    first, second = made["problems"]
    assert "episode 1: " in first
    assert second == "episode 2 was not recorded by this lab"
    files = [exports.MCAP["video"].find(UUID(folder.name)) for folder in folders]
    assert [file is not None for file in files] == [True, False, False, True]
    assert files[0] is not None
    before = files[0].stat().st_mtime_ns
    assert done(what="mcap", dataset="home")["files"] == 2
    assert files[0].stat().st_mtime_ns == before  # it is current
    page = browser.get(reverse("dataset", args=["home"])).content.decode()
    assert "2 of 4 episodes as MCAP, for a day; 2 problems: episode 1: " in page
    answer = browser.get(f"/api/v1/episodes/{known.name}/mcap")
    assert (answer.status_code, int(answer["Content-Length"])) == (200, files[0].stat().st_size)


@pytest.mark.parametrize(
    ("order", "why"),
    [
        ({"what": "burn", "dataset": "cups"}, "burn"),
        ({"what": "convert", "dataset": "cups", "to": "new"}, "version"),
        ({"what": "convert", "dataset": "cups", "to": "new", "version": "v2.0"}, "v2.1"),
        ({"what": "convert", "dataset": "cups", "to": "../out", "version": "v3.0"}, "names no dataset"),
        ({"what": "convert", "dataset": "cups", "to": "episodes/x", "version": "v3.0"}, "names no dataset"),
        ({"what": "convert", "dataset": "cups", "to": "a\nb", "version": "v3.0"}, "names no dataset"),
        ({"what": "convert", "dataset": "cups", "to": "cups/-", "version": "v3.0"}, "names no dataset"),
        ({"what": "merge", "datasets": ["cups"], "to": "new"}, "datasets"),
        ({"what": "split", "dataset": "cups", "to": "new", "parts": {"../a": [0]}}, "names no dataset"),
        ({"what": "delete", "dataset": "cups", "episodes": []}, "episodes"),
        ({"what": "check", "dataset": "cups", "more": 1}, "more"),
        (
            {"what": "push", "dataset": "cups", "repository": "lab/cups", "private": "no"},
            "private: .* boolean",
        ),
    ],
)
def test_an_order_that_is_none_is_refused_by_name(
    foreign: Foreign, order: dict[str, Any], why: str, root: User
) -> None:
    foreign("cups")
    with pytest.raises(EvaError, match=why):
        dataset_orders.submit_order(user=root, given=order)
    assert not Job.objects.exists()


def test_nothing_is_written_over(foreign: Foreign, root: User) -> None:
    foreign("cups")
    with pytest.raises(Conflict, match="is there already"):
        dataset_orders.submit_order(
            user=root, given={"what": "convert", "dataset": "cups", "to": "cups", "version": "v3.0"}
        )
    with pytest.raises(NotFound, match="there is no dataset 'datasets/plates'"):
        dataset_orders.submit_order(user=root, given={"what": "check", "dataset": "plates"})


def test_only_administrators_take_data_away_or_out_of_the_house(foreign: Foreign) -> None:
    foreign("cups")
    ann, vera = person("ann", "operator"), person("vera", "viewer")
    for order in (
        {"what": "delete", "dataset": "cups", "episodes": [0]},
        {"what": "push", "dataset": "cups", "repository": "lab/cups"},
        {"what": "pull", "repository": "lab/cups", "to": "new"},
    ):
        with pytest.raises(NotAllowed):
            dataset_orders.submit_order(user=ann, given=order)
    with pytest.raises(NotAllowed):
        dataset_orders.submit_order(user=vera, given={"what": "check", "dataset": "cups"})
    assert dataset_orders.submit_order(user=ann, given={"what": "check", "dataset": "cups"}).kind == "dataset"


def test_a_push_or_pull_without_the_client_says_so(
    foreign: Foreign, monkeypatch: pytest.MonkeyPatch, done: Done
) -> None:
    monkeypatch.setitem(sys.modules, "huggingface_hub", None)
    foreign("cups")
    for order in ({"what": "push", "dataset": "cups", "licence": "mit"}, {"what": "pull", "to": "new"}):
        assert "huggingface_hub is not installed" in done(**order, repository="lab/cups")["why"]
    assert dataset_names() == ["datasets/cups"]


def test_a_dataset_of_the_hub_is_pulled_under_a_new_name(
    browser: Client, foreign: Foreign, data: Path, monkeypatch: pytest.MonkeyPatch, done: Done
) -> None:
    source = foreign("cups")

    def download(repository: str, *, local_dir: Path, **given: Any) -> None:
        shutil.copytree(source, local_dir, dirs_exist_ok=True)

    about = SimpleNamespace(sha="abc", siblings=[])
    api = SimpleNamespace(dataset_info=lambda *given, **more: about)
    client = SimpleNamespace(HfApi=lambda token: api, snapshot_download=download)
    monkeypatch.setitem(sys.modules, "huggingface_hub", client)
    pulled = done(what="pull", repository="lab/cups", to="theirs")
    assert (pulled["dataset"], pulled["episodes"], pulled["frames"]) == ("datasets/theirs", 3, 21)
    page = browser.get(reverse("dataset-list")).content.decode()
    assert "Pull lab/cups to theirs" in page
    assert "3 episodes, 21 rows" in page
    form = {"what": "pull", "repository": "lab/cups", "to": "theirs", "revision": ""}
    browser.post(reverse("dataset-ask"), form)
    assert "is there already and not empty" in browser.get(reverse("dataset-list")).content.decode()


# --- pages -----------------------------------------------------------------------------------------------------


def test_episodes_that_another_page_hands_over_stand_in_the_form_that_makes_a_dataset_of_them(
    browser: Client, foreign: Foreign
) -> None:
    foreign("cups", version="v2.1")
    address = reverse("dataset", args=["cups"])
    page = browser.get(address, {"chosen": "0,2"}).content.decode()
    assert '<details class="card dataset-order" id="split" open>' in page
    assert 'value="chosen=0,2"' in page
    assert 'id="split" open' not in browser.get(address).content.decode()
    refused = browser.get(address, {"chosen": "0;2"}, headers={"Accept": "text/html"})
    assert refused.status_code == 400
    assert "allowed: indices of episodes, separated by commas" in refused.content.decode()


def test_forms_of_the_page_ask_and_a_deletion_wants_the_name(
    browser: Client, foreign: Foreign, data: Path
) -> None:
    foreign("cups", version="v2.1")
    ask = reverse("dataset-ask")
    form = {"what": "delete", "dataset": "datasets/cups", "episodes": ["0", "2"]}
    answer = browser.post(ask, form | {"confirm": "plates"}, follow=True)
    assert "nothing was deleted: type the name" in answer.content.decode()
    assert not Job.objects.exists()
    answer = browser.post(ask, form | {"confirm": "cups"}, follow=True)
    assert "Delete 2 episodes of cups" in answer.content.decode()
    run_queue("cpu")
    assert len(open_dataset(data / "datasets" / "cups").episodes) == 1
    answer = browser.post(
        ask,
        {"what": "split", "dataset": "datasets/cups", "to": "one", "parts": "first=0 again=0"},
        follow=True,
    )
    run_queue("cpu")
    page = browser.get(reverse("dataset", args=["cups"])).content.decode()
    assert "one/first" in page
    assert browser.get(reverse("dataset-work"))["HX-Refresh"] == "true"
    assert browser.get(reverse("dataset-list")).status_code == 200


def test_a_viewer_sees_everything_and_is_offered_nothing(client: Client, foreign: Foreign) -> None:
    foreign("cups")
    client.force_login(person("vera", "viewer"))
    page = client.get(reverse("dataset", args=["cups"])).content.decode()
    assert "Convert" not in page
    assert "Delete" not in page
    assert "task 0" in page


def test_datasets_and_their_episodes_are_sorted_filtered_and_saved(browser: Client, foreign: Foreign) -> None:
    foreign("cups")
    foreign("plates", lengths=(3,), version="v2.1")
    listed = reverse("dataset-list")
    names = re.findall(
        r'data-dataset="datasets/(\w+)"', browser.get(listed, {"sort": "rows"}).content.decode()
    )
    assert names == ["plates", "cups"]
    narrowed = browser.get(listed, {"version": "v2.1"}).content.decode()
    assert re.findall(r'data-dataset="datasets/(\w+)"', narrowed) == ["plates"]
    assert "No datasets match" in browser.get(listed, {"words": "saucers"}).content.decode()
    file = b"".join(browser.get(listed, {"format": "csv", "words": "cups"}).streaming_content).decode()
    assert file.splitlines()[1].startswith("cups,")
    one = reverse("dataset", args=["cups"])
    rows = re.findall(r'data-index="(\d)"', browser.get(one, {"sort": "-rows"}).content.decode())
    assert rows == ["1", "2", "0"]
    file = b"".join(browser.get(one, {"format": "csv", "sort": "-index"}).streaming_content).decode()
    assert [line.split(",")[0] for line in file.splitlines()] == ["index", "2", "1", "0"]
    for sort in ("index", "task", "result", "recording", "review", "rows", "lasts"):
        assert "aria-sort" in browser.get(one, {"sort": sort}).content.decode()


# --- REST and terminal -----------------------------------------------------------------------------------------


def test_programs_list_and_ask_too(browser: Client, foreign: Foreign) -> None:
    foreign("cups")
    (row,) = browser.get("/api/v1/datasets").json()
    assert (row["name"], row["version"], row["episodes"], row["cameras"]) == (
        "datasets/cups", "v3.0", 3, ["cam_high", "cam_wrist"],
    )  # fmt: skip
    assert browser.get("/api/v1/datasets/one?name=cups").json()["check"] is None
    listed = browser.get("/api/v1/datasets/episodes?name=cups&words=task+1").json()
    assert [(one["index"], one["rows"], one["uuid"]) for one in listed] == [(1, 8, None)]
    answer = browser.post(
        "/api/v1/datasets/jobs",
        json.dumps({"what": "convert", "dataset": "cups", "to": "new", "version": "v2.1"}),
        content_type="application/json",
    )
    assert (answer.status_code, answer.json()["kind"]) == (202, "dataset")
    assert browser.get("/api/v1/datasets/one?name=none").status_code == 404


def test_the_terminal_does_the_same_and_the_database_follows(foreign: Foreign, data: Path) -> None:
    foreign("cups", version="v2.1")
    call_command("dataset", "convert", "cups", "--to", "new", "--version", "v3.0")
    call_command("dataset", "delete", "new", "0:2")
    out = io.StringIO()
    call_command("dataset", "list", stdout=out)
    assert "datasets/new: v3.0, small, 1 episodes, 7 rows" in out.getvalue()
    with pytest.raises(CommandError, match="no episode 9"):
        call_command("dataset", "delete", "cups", "9")
    with pytest.raises(CommandError, match="names no dataset"):
        call_command("dataset", "convert", "cups", "--to", "episodes/x", "--version", "v3.0")


# --- on the robot ------------------------------------------------------------------------------------------------


def test_a_station_of_another_robot_is_refused_with_the_differences(
    browser: Client, foreign: Foreign, journal: Callable[..., Path]
) -> None:
    foreign("cups")
    Station.objects.create(name="bench", robot="ur5e", title="Bench")
    page = browser.get(reverse("on-robot"), {"show": "cups:1"}).content.decode()
    assert "choose its robot on its page in Replay" in page
    page = browser.get(reverse("on-robot"), {"show": "cups:1", "robot": "agilex_piper"}).content.decode()
    assert "the episode is of the robot agilex_piper, the station has ur5e" in page
    assert 'aria-disabled="true"' in page
    assert browser.get(reverse("on-robot"), {"show": "cups:9"}).status_code == 404
    assert browser.get(reverse("on-robot"), {"show": "cups:1", "space": "torque"}).status_code == 400


def test_the_stations_page_sets_up_what_the_address_names(
    browser: Client, foreign: Foreign, data: Path
) -> None:
    foreign("cups", widths={"observation.state": 7, "action": 7})
    Station.objects.create(name="bench", robot="ur5e", title="Bench")
    page = browser.get(reverse("station-debug", args=["bench"]), {"replay": "cups:1", "robot": "ur5e"})
    offer = page.context["replay"]
    assert offer.differences == ()
    args = offer.set_up
    assert json.loads(offer.asked) == {"episode": "datasets/cups:1", "space": "joint", "robot": "ur5e"}
    assert args["policy"] == {
        "kind": "replay",
        "path": str(data / "datasets" / "cups"),
        "episode": 1,
        "space": "joint",
        "horizon": 10,
        "mapping": {"action": "action"},
    }
    assert args["task"] == "task 1"
    assert json.loads(offer.run) == {"duration_s": 1.8}
    poses = browser.get(
        reverse("station-debug", args=["bench"]), {"replay": "cups:1", "robot": "ur5e", "space": "eef"}
    ).context["replay"]
    assert len(poses.differences) == 1
    assert "replay_problem" in browser.get(reverse("station-debug", args=["bench"]), {"replay": "x"}).context


@pytest.mark.parametrize(
    ("more", "sentence"),
    [
        ({"dataset": "a\r\nb"}, "names no dataset"),
        ({"what": "split", "to": "x", "parts": "a=0:60000 b=0:60000"}, "too many episodes"),
        ({"what": "delete", "confirm": "cups", "episodes": "9" * 5000}, "episodes"),
    ],
)
def test_what_a_form_never_sends_is_refused_with_a_sentence(
    foreign: Foreign, root: User, more: dict[str, str], sentence: str
) -> None:
    foreign("cups")
    browser = Client()
    browser.force_login(root)
    form = {"what": "check", "dataset": "cups", **more}
    assert sentence in browser.post(reverse("dataset-ask"), form, follow=True).content.decode()
    assert not Job.objects.exists()


def test_a_folder_that_no_address_can_name_hides_no_other_dataset(
    foreign: Foreign, data: Path, root: User
) -> None:
    plain = foreign("plain")
    for name in ("cups", "a\nb", "c\udcffd"):
        shutil.copytree(plain, data / "datasets" / name)
    browser = Client()
    browser.force_login(root)
    assert dataset_names() == ["datasets/cups", "datasets/plain"]
    assert "cups" in browser.get(reverse("dataset-list")).content.decode()
    assert browser.get("/api/v1/find", {"q": "cups"}).json()["groups"][0]["items"][0]["title"] == "cups"


def own_folders() -> list[str]:
    """The folders of the lab, as administrators are told of them."""
    page = (Path(__file__).parents[3] / "docs" / "administrator.md").read_text("utf-8")
    table = page.partition("## The data folder")[2].partition("\n\nA trial's")[0]
    rows = [line.split("|")[1] for line in table.splitlines() if line.startswith("| `")]
    return sorted({name for row in rows for name in re.findall(r"`([a-z_]+)/`", row)} - {"datasets"})


@pytest.mark.some(8)
@pytest.mark.parametrize("folder", own_folders())
def test_no_dataset_is_written_into_a_folder_of_the_lab(foreign: Foreign, root: User, folder: str) -> None:
    foreign("cups")
    for to in (f"{folder}/bench", f"{folder}/bench/ssh", f"./{folder}/x", f"{folder}//x"):
        with pytest.raises(EvaError, match="names no dataset"):
            dataset_orders.submit_order(
                user=root, given={"what": "convert", "dataset": "cups", "to": to, "version": "v3.0"}
            )
    assert not Job.objects.exists()


def test_the_folders_of_the_lab_were_found() -> None:
    assert {"stations", "jobs", "episodes", "unwritten", "pictures"} <= set(own_folders())


@pytest.mark.parametrize("to", ["datasets/", "datasets/cups/data", "datasets/cups/more", "./datasets"])
def test_no_dataset_is_written_around_or_into_others(foreign: Foreign, root: User, to: str) -> None:
    foreign("cups")
    with pytest.raises(EvaError):
        dataset_orders.submit_order(
            user=root, given={"what": "convert", "dataset": "cups", "to": to, "version": "v3.0"}
        )
    assert not Job.objects.exists()


def test_an_operator_sets_up_an_episode_by_its_name_and_no_path_of_theirs(
    operator: Client, foreign: Foreign, data: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    foreign("cups", widths={"observation.state": 7, "action": 7})
    Station.objects.create(name="bench", robot="ur5e", title="Bench")
    wire = builders.FakeConnection()
    monkeypatch.setattr("evaweb.stations.commands.connection_to", lambda name: wire)

    def asked(**given: Any) -> Any:
        body = {"uuid": str(uuid4()), "kind": "setup", "page": "p1", **given}
        return operator.post("/api/v1/stations/bench/commands", body, content_type="application/json")

    named = {"episode": "cups:1", "robot": "ur5e"}
    assert asked(replay=named, args={"policy": {"path": "/etc"}}).status_code == 400
    assert asked(replay=named, kind="run").status_code == 400
    assert asked(replay=named | {"robot": "agilex_piper"}).status_code == 409
    assert not wire.heard
    assert asked(replay=named).status_code == 200
    (heard,) = wire.heard
    assert (heard.args["policy"]["path"], heard.args["task"]) == (str(data / "datasets" / "cups"), "task 1")
    assert (heard.role, heard.vouched) == ("operator", ["policy"])


@pytest.mark.some(4)
@pytest.mark.parametrize("uuid", ["../stations", "../episodes", ".", "", "/tmp", 7, None])
def test_an_import_of_episodes_that_are_called_like_folders_touches_none(
    foreign: Foreign, data: Path, done: Done, uuid: object
) -> None:
    latch = data / "stations" / "bench" / "latch.json"
    latch.parent.mkdir(parents=True)
    latch.write_text("{}", "utf-8")
    told = foreign("cups") / "meta" / "eva_episodes.jsonl"
    told.write_text(json.dumps({"episode_index": 0, "uuid": uuid}) + "\n", "utf-8")
    refused = done(what="import", dataset="cups")
    assert (refused["done"], "eva_episodes.jsonl has a line of no episode" in refused["why"]) == (False, True)
    assert latch.is_file()
