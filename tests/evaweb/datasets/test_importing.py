"""Datasets of others become episodes of this lab: replayed, checked, reviewed, annotated, converted there and back."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from django.core.management import CommandError, call_command
from django.test import Client
from django.urls import reverse

import robots
from evaweb.core.binary_frames import decode
from evaweb.datasets.importing import import_dataset
from evaweb.datasets.job_kinds import dataset as run_order
from evaweb.datasets.robot_replay import playable_episode
from evaweb.episodes.job_kinds import preview, publish_episode
from evaweb.episodes.models import Episode, EpisodeStatus
from evaweb.episodes.reconcile import reconcile
from evaweb.jobs.kinds import JobContext
from evaweb.jobs.models import Job
from evaweb.reviews.job_kinds import (
    find_outdated_sidecars,
    find_unchecked_episodes,
    quality,
    write_sidecars_job,
)
from evaweb.reviews.models import Standing
from evaweb.reviews.selectors import report_get
from evaweb.reviews.services import add_review, save_segment
from evaweb.stations.models import Station
from runtime.core.clock import VirtualClock
from runtime.core.errors import PolicyError, RecordingError
from runtime.datasets.consistency import check
from runtime.datasets.finished_episode import read_finished_episode
from runtime.datasets.operations import convert
from runtime.datasets.reader import open_dataset
from runtime.policies import replay
from runtime.recording.layout import VECTOR_STREAMS
from tests.evaweb.conftest import person
from tests.runtime.datasets.foreign import Plan, column, write
from tests.runtime.datasets.small import JOINTS, POSES

pytestmark = pytest.mark.django_db
Foreign = Callable[..., Path]
SAMPLE = os.environ.get("EVA_SAMPLE_EPISODE")


def silently(kind: Callable[[JobContext], Any], uuid: object) -> Any:
    return kind(JobContext({"uuid": str(uuid)}, lambda _: None))


def theirs(tmp_path: Path, **plan: Any) -> Path:
    folder = tmp_path / "elsewhere" / "cups"
    write(folder, Plan(**{"lengths": (6, 8), "fps": 10.0, "gop": 3, "b_frames": 0, "smooth": True, **plan}))
    return folder


@pytest.mark.some(1)
@pytest.mark.parametrize("version", ["v2.0", "v2.1", "v3.0"])
def test_episodes_of_any_version_are_those_of_the_lab_and_of_its_dataset(
    data: Path, tmp_path: Path, version: str
) -> None:
    source = theirs(tmp_path, version=version)
    done = import_dataset(source)
    assert (done.dataset, done.made, done.problems) == ("datasets/cups", 2, ())
    second = Episode.objects.get(uuid=done.episodes[1])
    assert (second.status, second.kind, second.frames, second.fps) == (
        EpisodeStatus.FINISHED,
        "imported",
        8,
        10.0,
    )
    assert (second.dataset, second.dataset_index) == ("datasets/cups", 1)
    assert second.cameras == ["cam_high", "cam_wrist"]
    assert Station.objects.filter(active=True).count() == 0
    assert check(data / "datasets" / "cups") == []
    for index in (0, 1):
        assert rows(data / "datasets" / "cups", index) == rows(source, index)

    again = import_dataset(source)
    assert (again.episodes, again.made) == (done.episodes, 0)
    assert reconcile().problems == ()


def test_it_is_replayed_with_its_own_numbers(browser: Client, tmp_path: Path) -> None:
    uuid = import_dataset(theirs(tmp_path)).episodes[1]
    silently(preview, uuid)
    page = browser.get(reverse("replay", args=[uuid]))
    told = page.context["config"]
    assert (told["frames"], told["geometry"]) == (8, "")
    assert "import it with --robot" in told["why"]
    curves = decode(browser.get(told["curves"]).content)
    plan = Plan(smooth=True)
    assert np.array_equal(curves.array("ticks", "measured").T, column(1, "observation.state", 8, plan))
    assert np.array_equal(curves.array("ticks", "executed").T, column(1, "action", 8, plan))
    assert curves.header["held"] == []
    video = browser.get(told["videos"][0]["address"])
    assert video.status_code == 200


BESIDE = {
    "observation.qvel": ("qvel", len(JOINTS)),
    "observation.effort": ("effort", len(JOINTS)),
    "observation.eef": ("eef", len(POSES)),
    "action_eef": ("eef_action", len(POSES)),
}


def wide(**widths: int) -> dict[str, int]:
    given = {name: width for name, (_, width) in BESIDE.items()}
    return {"observation.state": len(JOINTS), "action": len(JOINTS), **given, **widths}


def test_velocities_efforts_and_poses_come_along(data: Path, tmp_path: Path) -> None:
    names = {"observation.eef": POSES, "action_eef": POSES}
    source = theirs(tmp_path, widths=wide(), names=names)
    journal = read_finished_episode(data / "episodes" / str(import_dataset(source).episodes[1]))
    for name, (stream, width) in BESIDE.items():
        stored = column(1, name, 8, Plan(smooth=True, widths=wide()))
        assert np.array_equal(journal.vectors(stream), stored)
        assert stored.shape == (8, width)
    assert journal.manifest["imported"]["columns"] == {stream: name for name, (stream, _) in BESIDE.items()}
    assert journal.manifest["robot"]["eef_names"] == list(POSES)
    assert not journal.flags("eef_measured").any()  # nobody knows
    assert journal.outcome["reason"] == "imported: episode 1 of datasets/cups"


def test_what_cannot_be_told_apart_or_has_another_width_is_left_out_and_named(
    data: Path, tmp_path: Path
) -> None:
    wrong = [*POSES[:3], POSES[6], *POSES[3:6], *POSES[7:]]  # x, y, z, w last
    widths = wide(**{"observation.effort": 2})
    source = theirs(tmp_path, widths=widths, names={"observation.eef": wrong})
    journal = read_finished_episode(data / "episodes" / str(import_dataset(source).episodes[0]))
    assert [stream for stream in VECTOR_STREAMS if journal.has_stream(stream)] == ["qvel"]
    reason = journal.outcome["reason"]
    assert "observation.effort is left out: its rows have 2 numbers, expected 6" in reason
    assert "observation.eef is left out: its numbers are called left_arm.x, left_arm.y" in reason
    assert "action_eef is left out: its numbers are called nothing; allowed: ARM.x, ARM.y" in reason


def test_poses_of_others_are_sent_to_no_robot(data: Path, tmp_path: Path) -> None:
    source = theirs(tmp_path, widths=wide(), names=dict.fromkeys(("observation.eef", "action_eef"), POSES))
    done = import_dataset(source)
    for name in (str(done.episodes[0]), f"{done.dataset}:0"):
        recorded = playable_episode(name)
        assert list(recorded.poses) == list(POSES)
        assert not recorded.ours
    path = str(data / "episodes" / str(done.episodes[0]))
    policy = replay.build(
        replay.Config(path=path, space="eef"), robots.load_robot("agilex_piper"), VirtualClock(), 30.0
    )
    with pytest.raises(PolicyError, match="was imported: the frames of its poses are unknown"):
        policy.connect()


def test_pictures_in_columns_are_played_too(data: Path, tmp_path: Path) -> None:
    done = import_dataset(theirs(tmp_path, videos=("cam_high",), images=("cam_wrist",)))
    assert sorted(Episode.objects.get(uuid=done.episodes[0]).cameras) == ["cam_high", "cam_wrist"]


def test_what_is_said_of_it_travels_with_its_dataset_through_conversions(data: Path, tmp_path: Path) -> None:
    done = import_dataset(theirs(tmp_path))
    uuid = done.episodes[1]
    episode, ann = Episode.objects.get(uuid=uuid), person("ann", "operator")
    add_review(user=ann, episode=episode, verdict="fail", note="dropped")
    save_segment(user=ann, episode=episode, first=2, last=5, label="reach", milestone="cup touched")
    assert find_outdated_sidecars() == 1
    assert silently(write_sidecars_job, uuid)["attached"]
    home = data / "datasets" / "cups"
    convert(home, tmp_path / "other", "v3.0")
    convert(tmp_path / "other", tmp_path / "back", "v2.1")
    for dataset in (home, tmp_path / "other", tmp_path / "back"):
        (verdict,) = lines(dataset / "eva" / "reviews" / f"{uuid}.jsonl")
        assert (verdict["verdict"], verdict["note"], verdict["by"]) == ("fail", "dropped", "ann")
        (segment,) = lines(dataset / "eva" / "annotations" / f"{uuid}.jsonl")
        assert (segment["first"], segment["last"], segment["label"]) == (2, 5, "reach")
        assert rows(dataset, 1) == rows(home, 1)


def test_it_is_judged_as_its_dataset_has_it(data: Path, tmp_path: Path) -> None:
    done = import_dataset(theirs(tmp_path, lengths=(12,)))
    assert find_unchecked_episodes() == 1
    silently(quality, done.episodes[0])
    report = report_get(uuid=done.episodes[0])
    assert report["frames"] == 12
    assert any("limits are not checked" in sentence for sentence in report["unchecked"])
    assert Standing.objects.get(episode=done.episodes[0]).checked_at is not None
    path = next((data / "datasets" / "cups").glob("data/*/*.parquet"))
    table = pq.read_table(path)
    times = table["timestamp"].to_numpy().copy()
    times[5] += 0.01
    place = table.column_names.index("timestamp")
    pq.write_table(table.set_column(place, table.schema.field(place), [times]), path)
    silently(quality, done.episodes[0])
    assert "time_grid" in {flag["kind"] for flag in report_get(uuid=done.episodes[0])["flags"]}


def test_one_that_lies_in_the_lab_already_gets_its_uuids_in_place(data: Path, foreign: Foreign) -> None:
    folder = foreign("cups", version="v2.1")
    before = rows(folder, 2)
    out = StringIO()
    call_command("dataset", "import", "cups", stdout=out)
    assert "imported: 3 episodes, 3 of them new" in out.getvalue()
    assert rows(folder, 2) == before
    told = lines(folder / "meta" / "eva_episodes.jsonl")
    assert [line["episode_index"] for line in told] == [0, 1, 2]
    assert {line["uuid"] for line in told} == {
        str(uuid) for uuid in Episode.objects.values_list("uuid", flat=True)
    }


def test_an_import_that_was_cut_short_is_gone_on_with(
    data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from evaweb.datasets import importing

    real, calls = importing.import_episode, []

    def cut(*args: Any) -> Any:
        calls.append(args)
        if len(calls) == 2:
            raise RecordingError("the disk is full")
        return real(*args)

    monkeypatch.setattr(importing, "import_episode", cut)
    source = theirs(tmp_path)
    with pytest.raises(RecordingError, match="the disk is full"):
        import_dataset(source)
    assert Episode.objects.count() == 1
    assert (import_dataset(source).made, Episode.objects.count()) == (1, 2)


def test_a_page_has_it_done_by_the_worker(browser: Client, foreign: Foreign) -> None:
    foreign("cups", version="v3.0")
    form = {"what": "import", "dataset": "cups", "robot": "", "state": "observation.state"}
    assert browser.post(reverse("dataset-ask"), form).status_code == 302
    job = Job.objects.get(kind="dataset")
    found = run_order(JobContext(job.args, lambda _: None))
    assert found == {"done": True, "dataset": "datasets/cups", "episodes": 3, "made": 3, "problems": []}
    assert Episode.objects.filter(dataset="datasets/cups").count() == 3
    browser.post(reverse("dataset-ask"), form | {"robot": "hal"})
    assert Job.objects.filter(kind="dataset").count() == 1
    page = browser.get(reverse("dataset", args=["cups"])).content.decode()
    assert "robot = &#x27;hal&#x27;; allowed: agibot_g2" in page
    assert "Import cups" in page
    refused = run_order(JobContext(job.args | {"state": "joints"}, lambda _: None))
    assert not refused["done"]
    assert "has no column joints" in refused["why"]


def test_it_is_published_nowhere_else(data: Path, tmp_path: Path) -> None:
    done = import_dataset(theirs(tmp_path))
    told = silently(publish_episode, done.episodes[0])
    assert not told["published"]
    assert "it was imported" in told["why"]


@pytest.mark.some(4)
@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--state", "joints"], "has no column joints of measured joints: name one of observation.state"),
        (["--robot", "hal"], "robot 'hal' does not exist; there are: agibot_g2"),
        (["--to", "episodes/x"], "names no dataset"),
        (["--to", "elsewhere/x"], "what is reviewed lies there"),
        (["--rename", "a="], "expected OLD=NEW"),
        (["--to", "taken"], "holds other episodes: import"),
    ],
)
def test_what_cannot_be_imported_says_why_and_leaves_nothing(
    foreign: Foreign, data: Path, tmp_path: Path, options: list[str], said: str
) -> None:
    foreign("taken")
    with pytest.raises(CommandError, match=said.replace("(", r"\(")):
        call_command("dataset", "import", str(theirs(tmp_path)), *options)
    assert Episode.objects.count() == 0
    assert [path.name for path in (data / "datasets").iterdir()] == ["taken"]


def test_a_robot_of_as_many_joints_may_be_named(data: Path, tmp_path: Path) -> None:
    width = len(JOINTS)
    with pytest.raises(
        RecordingError, match=f"observation.state has {width} numbers, agilex_piper has 14 joints"
    ):
        import_dataset(theirs(tmp_path), robot="agilex_piper")


@pytest.mark.exhaustive
@pytest.mark.skipif(not SAMPLE, reason="EVA_SAMPLE_EPISODE does not name the real episode")
def test_the_real_episode_is_imported_reviewed_and_converted_there_and_back(
    browser: Client, data: Path, tmp_path: Path
) -> None:
    assert SAMPLE is not None
    done = import_dataset(Path(SAMPLE), to="real", robot="agilex_piper")
    (uuid,) = done.episodes
    silently(preview, uuid)
    silently(quality, uuid)
    report = report_get(uuid=uuid)
    assert report["frames"] == 398
    assert not report["unchecked"]
    told = browser.get(reverse("replay", args=[uuid])).context["config"]
    assert browser.get(told["geometry"]).status_code == 200
    journal, source = (
        read_finished_episode(data / "episodes" / str(uuid)),
        open_dataset(Path(SAMPLE)).table(0),
    )
    for stream, name in journal.manifest["imported"]["columns"].items():
        assert np.array_equal(journal.vectors(stream), np.array(source[name].to_pylist(), np.float32))
    assert [name for name in VECTOR_STREAMS if journal.has_stream(name)] == list(VECTOR_STREAMS)
    episode, ann = Episode.objects.get(uuid=uuid), person("ann", "operator")
    add_review(user=ann, episode=episode, verdict="pass")
    save_segment(user=ann, episode=episode, first=0, last=100, label="reach")
    silently(write_sidecars_job, uuid)
    home = data / "datasets" / "real"
    convert(home, tmp_path / "v3", "v3.0")
    convert(tmp_path / "v3", tmp_path / "back", "v2.1")
    for dataset in (home, tmp_path / "v3", tmp_path / "back"):
        assert rows(dataset, 0) == rows(Path(SAMPLE), 0)
        assert lines(dataset / "eva" / "reviews" / f"{uuid}.jsonl")[0]["verdict"] == "pass"
        assert lines(dataset / "eva" / "annotations" / f"{uuid}.jsonl")[0]["label"] == "reach"


def rows(dataset: Path, index: int) -> dict[str, list[Any]]:
    """Every number of an episode, by column; the task by its text."""
    opened = open_dataset(dataset)
    table = opened.table(index)
    found = {name: table[name].to_pylist() for name in table.column_names if name not in ("task_index",)}
    return found | {"task": [opened.tasks[number] for number in table["task_index"].to_pylist()]}


def lines(path: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in path.read_text().splitlines()]
