"""Previews and datasets: made once whatever happens to the worker, and honest about what cannot be made."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from datetime import timedelta
from pathlib import Path

import av
import numpy as np
import pyarrow.parquet as pq
import pytest
from django.utils import timezone

from evaweb.episodes import services
from evaweb.episodes.models import Episode
from evaweb.jobs import services as jobs
from evaweb.jobs.models import Job, JobStatus
from evaweb.stations.models import Station
from runtime.datasets.consistency import check
from runtime.datasets.staging import FOLDER, Staging
from tests.runtime.recording.samples import decoded, numbers, resealed, unsealed

pytestmark = pytest.mark.django_db

Closed = Callable[..., Episode]


def score(data: Path, episode: Episode, success: bool, **more: object) -> None:
    path = data / "scores" / f"{episode.uuid}.jsonl"
    path.parent.mkdir(exist_ok=True)
    with path.open("a") as file:
        file.write(json.dumps({"kind": "score", "success": success, **more}) + "\n")


def publish(episode: Episode) -> Job:
    """Ask for the dataset and let the worker do all that waits."""
    job = services.request_publish(episode=episode)
    jobs.run_queue("cpu")
    job.refresh_from_db()
    return job


def successes(data: Path, name: str) -> list[bool]:
    """What the dataset says of its episodes, from their last rows."""
    files = sorted((data / "datasets" / name / "data").rglob("*.parquet"))
    return [pq.read_table(file)["next.success"].to_pylist()[-1] for file in files]


def test_a_preview_has_the_same_coded_pictures_with_the_index_at_the_front(
    previewed: Episode, data: Path
) -> None:
    folder = data / "previews" / str(previewed.uuid)
    journal = data / "episodes" / str(previewed.uuid)
    assert sorted(path.name for path in folder.iterdir()) == [
        *("cam_high.mp4", "cam_high.sheet.jpg"),
        *("cam_left_wrist.mp4", "cam_left_wrist.sheet.jpg"),
        *("cam_right_wrist.mp4", "cam_right_wrist.sheet.jpg"),
        "thumbnail.jpg",
    ]
    for camera in previewed.cameras:
        video = folder / f"{camera}.mp4"
        content = video.read_bytes()
        assert content.index(b"moov") < content.index(b"mdat"), "a browser could not begin before the end"
        assert b"moof" not in content
        assert numbers(video) == numbers(journal / f"{camera}.mp4")
        with av.open(str(video)) as container:
            times = [float(frame.time) for frame in container.decode(video=0)]
        assert np.allclose(times, np.arange(previewed.frames) / 30, atol=1e-6)
    assert (folder / "thumbnail.jpg").read_bytes()[:2] == b"\xff\xd8"
    assert decoded(folder / "thumbnail.jpg")[0].shape == (240, 320, 3)
    assert previewed.previewed_at is not None
    assert sorted(path.name for path in folder.parent.iterdir()) == [folder.name]


def test_a_preview_that_was_cut_off_leaves_nothing_and_is_made_anew(closed: Closed, data: Path) -> None:
    episode = closed()
    left = data / "previews" / f".{episode.uuid}.abandoned"
    left.mkdir(parents=True)
    (left / "cam_high.mp4").write_bytes(b"half")
    jobs.run_queue("cpu")
    services.request_preview(episode=episode)
    jobs.run_queue("cpu")
    assert [path.name for path in (data / "previews").iterdir()] == [str(episode.uuid)]
    assert [job.status for job in Job.objects.all()] == [JobStatus.DONE] * 2


@pytest.mark.parametrize(
    ("name", "sentence"),
    [("cam_high.mp4", "cam_high.mp4"), ("rows.arrow", "rows.arrow is damaged: 0 rows readable")],
)
def test_a_damaged_episode_fails_its_job_with_the_file_named(
    closed: Closed, data: Path, name: str, sentence: str
) -> None:
    episode = closed()
    file = data / "episodes" / str(episode.uuid) / name
    file.write_bytes(b"\0" * 64)
    job = Job.objects.get()
    for _ in range(jobs.MOST_ATTEMPTS):
        Job.objects.update(not_before=None)
        jobs.run_queue("cpu")
    job.refresh_from_db()
    assert job.status == JobStatus.FAILED
    assert str(file) in job.error
    assert sentence in job.error
    assert not list(data.glob("previews/*"))


def test_a_scored_episode_is_published_with_its_success(closed: Closed, data: Path) -> None:
    episode = closed()
    score(data, episode, True)
    job = publish(episode)
    assert job.status == JobStatus.DONE, job.error
    episode.refresh_from_db()
    assert (episode.dataset, episode.dataset_index) == ("datasets/rollouts-agilex_piper", 0)
    assert job.result["success"] is True
    assert check(data / episode.dataset) == []
    assert successes(data, "rollouts-agilex_piper") == [True]


def test_a_corrected_score_rewrites_the_same_place(closed: Closed, data: Path) -> None:
    first, second = closed(), closed("interrupted")
    score(data, first, True)
    score(data, second, True)
    publish(first)
    assert publish(second).result["index"] == 1
    score(data, first, False, reason="it fell off afterwards")
    job = publish(first)
    assert (job.result["index"], job.result["created"]) == (0, False)
    assert successes(data, "rollouts-agilex_piper") == [False, True]
    assert check(data / "datasets/rollouts-agilex_piper") == []


def test_to_void_a_trial_changes_no_success_and_a_torn_line_counts_for_nothing(
    closed: Closed, data: Path
) -> None:
    episode = closed()
    score(data, episode, True)
    with (data / "scores" / f"{episode.uuid}.jsonl").open("a") as file:
        file.write('{"kind": "void", "reason": "wrong block"}\n{"kind": "score", "success": fal')
    publish(episode)
    assert successes(data, "rollouts-agilex_piper") == [True]


def test_what_nobody_scored_goes_to_a_dataset_that_claims_no_success(closed: Closed, data: Path) -> None:
    episode = closed()
    assert publish(episode).result["dataset"] == "datasets/rollouts-agilex_piper-unscored"
    score(data, episode, False)
    assert publish(episode).result["dataset"] == "datasets/rollouts-agilex_piper"
    episode.refresh_from_db()
    assert episode.dataset == "datasets/rollouts-agilex_piper"


def test_simulated_benches_have_a_dataset_of_their_own(closed: Closed, data: Path) -> None:
    episode = closed()
    episode.station.simulated = True
    episode.station.save()
    score(data, episode, True)
    assert publish(episode).result["dataset"] == "datasets/rollouts-agilex_piper-simulated"


def test_an_interrupted_episode_is_published_only_where_it_was_scored(closed: Closed, data: Path) -> None:
    episode = closed("interrupted")
    job = publish(episode)
    assert job.status == JobStatus.DONE
    assert job.result == {"published": False, "why": "it is interrupted and has no score"}
    assert not (data / "datasets").exists()
    score(data, episode, False)
    assert publish(episode).result["published"] is True


def test_an_episode_without_rows_is_no_failure_and_in_no_dataset(closed: Closed, data: Path) -> None:
    episode = closed()
    unsealed(data / "episodes" / str(episode.uuid), frames=0)
    Episode.objects.update(seal="")
    score(data, episode, False)
    job = publish(episode)
    assert job.status == JobStatus.DONE
    assert job.result == {"published": False, "why": "it has no rows: its run ended before the first"}
    assert not (data / "datasets").exists()


def test_an_episode_without_a_folder_is_not_published_and_that_is_no_failure(
    data: Path, station: Station
) -> None:
    job = publish(Episode.objects.create(station=station, status="recording"))
    assert job.status == JobStatus.DONE
    assert job.result == {
        "published": False,
        "why": "there is no folder of it: nothing of its run is on this disk",
    }


def test_an_episode_that_is_still_being_written_is_tried_again(closed: Closed, data: Path) -> None:
    episode = closed()
    score(data, episode, True)
    outcome = data / "episodes" / str(episode.uuid) / "outcome.json"
    content = outcome.read_bytes()
    outcome.unlink()
    Episode.objects.update(status="recording")
    job = publish(episode)
    assert job.status == JobStatus.QUEUED
    assert "has no outcome.json" in job.error
    outcome.write_bytes(content)
    Job.objects.update(not_before=None)
    jobs.run_queue("cpu")
    job.refresh_from_db()
    assert job.result["published"] is True


def test_a_robot_whose_name_leads_out_of_the_folder_is_refused(closed: Closed, data: Path) -> None:
    episode = closed()
    path = data / "episodes" / str(episode.uuid) / "manifest.json"
    manifest = json.loads(path.read_text())
    manifest["robot"]["name"] = "../../outside"
    path.write_text(json.dumps(manifest))
    resealed(path.parent)
    Episode.objects.update(seal="")
    assert "robot.name is '../../outside'" in publish(episode).error


class Killed(BaseException):
    """As if the worker were killed: nothing of ours runs afterwards."""


@pytest.mark.some(1)
@pytest.mark.parametrize("at", ["first", "second", "last"])
def test_a_worker_killed_while_publishing_leaves_a_dataset_that_the_next_one_completes(
    closed: Closed, data: Path, monkeypatch: pytest.MonkeyPatch, at: str
) -> None:
    before, episode = closed("interrupted"), closed()
    score(data, before, False)
    score(data, episode, True)
    assert publish(before).result["index"] == 0
    root = data / "datasets/rollouts-agilex_piper"

    renames = []

    def die(self: Staging, order: list[Path]) -> None:
        """Rename as many files as the case says, then be gone."""
        renames.append(order)
        if at == "first" or (at == "last" and len(renames) == 2):
            raise Killed
        rename(self, order[: len(order) // 2] if at == "second" else order)
        if at == "second":
            raise Killed

    rename = Staging._rename
    with monkeypatch.context() as killed:
        killed.setattr(Staging, "_rename", die)
        killed.setattr(Staging, "__exit__", lambda *_: None)  # a kill runs no cleaning up
        with pytest.raises(Killed):
            publish(episode)
    assert (root / FOLDER).is_dir()
    job = Job.objects.get(key=f"publish:{episode.uuid}")
    assert job.status == JobStatus.RUNNING
    Job.objects.filter(pk=job.pk).update(seen_at=timezone.now() - timedelta(hours=1))
    assert jobs.reclaim_stale_jobs() == 1
    assert jobs.run_queue("cpu") == 1
    job.refresh_from_db()
    assert (job.status, job.attempts, job.result["index"]) == (JobStatus.DONE, 0, 1)
    assert check(root) == []
    assert successes(data, "rollouts-agilex_piper") == [False, True]
    assert not (root / FOLDER).exists()


def test_the_job_reconcile_tells_what_it_found(closed: Closed, data: Path) -> None:
    episode = closed()
    Episode.objects.all().delete()
    job = jobs.enqueue(kind="reconcile", key="reconcile", args={})
    jobs.run_queue("cpu")
    job.refresh_from_db()
    assert job.result == {
        "episodes": 1,
        "made": 1,
        "missing": 0,
        "published": 0,
        "restored": 0,
        "problems": [],
    }
    shutil.rmtree(data / "episodes" / str(episode.uuid))
    again = jobs.enqueue(kind="reconcile", key="reconcile", args={})
    jobs.run_queue("cpu")
    again.refresh_from_db()
    assert again.result["missing"] == 1


def test_the_table_is_made_once_and_stays(closed: Closed, data: Path) -> None:
    episode = closed()
    (path,) = (data / "exports").rglob("*.parquet")
    before = path.stat()
    for _ in range(2):
        job = services.request_export(episode=episode)
        jobs.run_queue("cpu")
        job.refresh_from_db()
        assert job.status == JobStatus.DONE, job.error
        assert job.result == {"file": str(path.relative_to(data)), "bytes": before.st_size}
    assert path.stat().st_mtime_ns == before.st_mtime_ns
    path.unlink()
    services.request_export(episode=episode)
    jobs.run_queue("cpu")
    assert path.stat().st_size == before.st_size


def sim_manifest(data: Path, episode: Episode) -> None:
    path = data / "episodes" / str(episode.uuid) / "manifest.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"mode": "sim"}))
    resealed(path.parent)
    Episode.objects.update(seal="")


def test_a_run_with_a_simulated_robot_is_not_even_queued(closed: Closed, data: Path) -> None:
    episode = closed()
    sim_manifest(data, episode)
    episode = services.sync_episode(uuid=episode.uuid)
    score(data, episode, True)
    before = Job.objects.count()
    assert services.request_publish(episode=episode) is None
    assert Job.objects.count() == before


def test_a_worker_that_is_asked_all_the_same_publishes_no_simulated_robot(closed: Closed, data: Path) -> None:
    episode = closed()
    sim_manifest(data, episode)  # the row does not know it yet
    score(data, episode, True)
    job = publish(episode)
    assert job.status == JobStatus.DONE, job.error
    assert job.result["published"] is False
    assert "it is a run of mode sim" in job.result["why"]
    assert not (data / "datasets").exists()
