"""Recorded videos in the lab's store: moved and brought back without a change, whatever happens in between."""

from __future__ import annotations

import errno
import io
import json
import os
import shutil
import time
from collections.abc import Callable
from datetime import timedelta
from pathlib import Path
from typing import Any
from uuid import uuid4

import pytest
from django.contrib.auth.models import User
from django.core.exceptions import ImproperlyConfigured
from django.core.management import CommandError, call_command
from django.test import Client
from django.utils import timezone

from evaweb.core import environment
from evaweb.core.object_stores import FolderStore, StoreError
from evaweb.datasets.robot_replay import playable_episode
from evaweb.episodes import archive, services, verification
from evaweb.episodes.archive import NotArchived, bring_back, put_away, remove_unused
from evaweb.episodes.arriving import read_back
from evaweb.episodes.bench import bench_course
from evaweb.episodes.curves import curve_message
from evaweb.episodes.folders import archive_folder, journal_folder
from evaweb.episodes.job_kinds import find_archivable
from evaweb.episodes.models import Episode, EpisodeStatus
from evaweb.episodes.poses import pose_message
from evaweb.episodes.reconcile import reconcile
from evaweb.episodes.smoothness import smoothness_in
from evaweb.jobs.models import Hold, Job, JobStatus
from evaweb.jobs.services import enqueue, run_queue
from evaweb.reviews.record import report_file
from evaweb.reviews.services import request_quality_check
from runtime.recording.__main__ import main
from runtime.recording.archive_index import write_index
from runtime.recording.files import RecordingError
from runtime.recording.quarantine import marked_damage
from runtime.recording.reader import open_episode
from runtime.recording.scrub import files_here, require_intact, verify_episode

pytestmark = pytest.mark.django_db

WEEK = timedelta(days=7)


@pytest.fixture
def store(settings: Any, tmp_path_factory: pytest.TempPathFactory) -> FolderStore:
    settings.EVA_STORE = tmp_path_factory.mktemp("store")
    settings.EVA_RESERVE_BYTES = 0
    return FolderStore(settings.EVA_STORE)


@pytest.fixture
def old(closed: Callable[..., Episode]) -> Episode:
    """A sound recording of a week ago, verified and previewed; its worker has nothing else to do."""
    episode = closed()
    run_queue("cpu")
    verification.record_verification(verify_episode(episode_folder(episode)))
    Episode.objects.update(created_at=timezone.now() - WEEK)
    episode.refresh_from_db()
    return episode


def episode_folder(episode: Episode) -> Path:
    return journal_folder(episode.uuid)


def content(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def videos(episode: Episode) -> list[Path]:
    return sorted(episode_folder(episode).glob("*.mp4"))


def index(episode: Episode) -> Path:
    return archive_folder() / f"{episode.uuid}.json"


def performed(job: Job | None) -> Job:
    assert job is not None
    run_queue("cpu")
    job.refresh_from_db()
    return job


def test_what_was_moved_comes_back_as_it_was(old: Episode, store: FolderStore) -> None:
    folder = episode_folder(old)
    before = content(folder)
    assert put_away(old.uuid) == 3
    assert content(folder) == {name: data for name, data in before.items() if not name.endswith(".mp4")}
    assert put_away(old.uuid) == 0
    old.refresh_from_db()
    assert old.archived_at is not None
    assert [bring_back(old.uuid) for _ in range(2)] == [3, 0]
    assert content(folder) == before
    assert verify_episode(folder).state == "sound"
    assert {oct(path.stat().st_mode & 0o777) for path in videos(old)} == {"0o644"}


def test_numbers_are_read_without_the_videos_and_a_video_says_where_it_is(
    old: Episode, store: FolderStore, data: Path
) -> None:
    folder = episode_folder(old)

    def numbers() -> list[Any]:
        read = [curve_message(folder), pose_message(folder, 0), bench_course(folder), smoothness_in(folder)]
        return [*read, playable_episode(str(old.uuid))]

    before = numbers()
    put_away(old.uuid)
    assert numbers() == before
    for reader in (open_episode, verify_episode):
        with pytest.raises(RecordingError, match=rf"store.*manage\.py archive --back {old.uuid}"):
            reader(folder)
    assert main(["scrub", str(folder)]) == 2
    assert require_intact(folder, files_here(folder)).state == "sound"
    Episode.objects.update(archived_at=None)
    assert reconcile().problems == ()
    old.refresh_from_db()
    assert (old.status, old.damage, marked_damage(data, str(old.uuid))) == ("finished", [], [])
    assert old.archived_at is not None, "the disk is the authority"


def test_its_page_and_rest_say_that_its_videos_are_in_the_store(
    old: Episode, store: FolderStore, client: Client, vera: User
) -> None:
    client.force_login(vera)

    def told() -> tuple[bool, Any]:
        page = client.get(f"/replay/{old.uuid}/").content.decode()
        fields = client.get(f"/api/v1/episodes/{old.uuid}").json()
        return "recorded videos in the store" in page, fields["archived_at"]

    assert told() == (False, None)
    put_away(old.uuid)
    assert told()[0]
    assert told()[1]


class KilledError(BaseException):
    """What a kill -9 is here."""


def kill(*args: object, **named: object) -> None:
    raise KilledError


@pytest.mark.parametrize("point", ["before the index", "after the index", "half removed"])
def test_a_move_that_was_killed_runs_again_to_the_same_end(
    old: Episode, store: FolderStore, monkeypatch: pytest.MonkeyPatch, point: str
) -> None:
    before = content(episode_folder(old))
    with monkeypatch.context() as patch:
        if point == "before the index":
            patch.setattr(archive, "write_index", kill)
        elif point == "after the index":
            patch.setattr(archive, "_remove", kill)
        else:
            real = Path.unlink
            seen: list[Path] = []

            def once(path: Path, missing_ok: bool = False) -> None:
                if seen:
                    raise KilledError
                seen.append(path)
                real(path, missing_ok)

            patch.setattr(Path, "unlink", once)
        with pytest.raises(KilledError):
            put_away(old.uuid)
    assert len(videos(old)) == (2 if point == "half removed" else 3)
    put_away(old.uuid)
    assert (videos(old), len(json.loads(index(old).read_bytes())["files"])) == ([], 3)
    bring_back(old.uuid)
    assert content(episode_folder(old)) == before


def test_another_file_than_the_index_names_is_refused_and_nothing_of_it_can_be_seen(
    old: Episode, store: FolderStore
) -> None:
    put_away(old.uuid)
    for digest in archive.archived_files(old.uuid).values():
        path = store.file(digest)
        assert path is not None
        path.write_bytes(b"another")
    with pytest.raises(StoreError, match="is not what its name says"):
        bring_back(old.uuid)
    assert {path.suffix for path in episode_folder(old).iterdir()} <= {".arrow", ".json", ".jsonl"}


def test_what_a_station_offers_again_is_read_back_from_the_store(old: Episode, store: FolderStore) -> None:
    put_away(old.uuid)
    digest = archive.archived_files(old.uuid)["cam_high.mp4"]
    read_back(digest)
    store.delete(digest)
    with pytest.raises(OSError, match="does not give"):
        read_back(digest)


def test_a_store_that_took_something_else_leaves_every_file_here(
    old: Episode, store: FolderStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(FolderStore, "read", lambda self, digest: iter([b"another"]))
    with pytest.raises(StoreError, match="is not what its name says"):
        put_away(old.uuid)
    assert (len(videos(old)), index(old).exists()) == (3, False)


def test_publication_quality_and_scrub_of_an_archived_recording_are_those_of_a_local_one(
    old: Episode, store: FolderStore, data: Path
) -> None:
    def made() -> tuple[Any, ...]:
        job = performed(services.request_publish(episode=old))
        assert job.result["published"], job.error or job.result
        checked = performed(request_quality_check(episode=old))
        assert checked.status == JobStatus.DONE, checked.error
        root = data / "datasets"
        files = {path.relative_to(root): path.read_bytes() for path in root.rglob("*.mp4")}
        figures = {path.relative_to(root): path.read_bytes() for path in root.rglob("*.parquet")}
        shutil.rmtree(root)
        Episode.objects.update(dataset="", dataset_index=None)
        return files, figures, json.loads(report_file(old.uuid).read_bytes())

    local = made()
    put_away(old.uuid)
    assert made() == local
    put_away(old.uuid)
    Episode.objects.update(verified_at=None)
    job = performed(verification.request_scrub())
    assert (job.result["sound"], job.result["problems"]) == (1, [])


def test_a_store_that_is_away_fails_the_job_with_its_sentence_and_marks_nothing(
    old: Episode, store: FolderStore, data: Path
) -> None:
    put_away(old.uuid)
    store.folder.rename(store.folder.with_name(f"{store.folder.name}-away"))
    Episode.objects.update(verified_at=None)
    for job in (
        services.request_publish(episode=old),
        request_quality_check(episode=old),
        services.request_preview(episode=old),
        verification.request_scrub() or enqueue(kind="scrub", key="scrub", args={}),
    ):
        performed(job)
        assert (job.status, job.attempts) == (JobStatus.QUEUED, 1)
        assert "the store" in job.error
        assert "does not give" in job.error
    reconcile()
    old.refresh_from_db()
    assert (old.status, old.damage, marked_damage(data, str(old.uuid))) == ("finished", [], [])
    Job.objects.filter(kind="scrub").update(status=JobStatus.FAILED, finished_at=timezone.now())
    Job.objects.exclude(kind="scrub").delete()
    assert verification.request_scrub() is None, "for an hour the others are verified"


def test_what_was_brought_back_is_removed_after_an_hour_without_use(
    old: Episode, store: FolderStore, settings: Any
) -> None:
    put_away(old.uuid)
    bring_back(old.uuid)
    used = (archive_folder() / "here" / str(old.uuid)).stat().st_mtime
    assert remove_unused(used + 3599) == 0
    hidden = store.folder.with_name(f"{store.folder.name}-away")
    store.folder.rename(hidden)
    assert remove_unused(used + 3601) == 0
    assert len(videos(old)) == 3, "the store does not have them"
    hidden.rename(store.folder)
    assert remove_unused(used + 3602) == 0, "an hour later"
    assert remove_unused(used + 2 * 3601) == 1
    assert videos(old) == []
    bring_back(old.uuid)
    settings.EVA_CACHE_BYTES = 1
    used = (archive_folder() / "here" / str(old.uuid)).stat().st_mtime
    assert [remove_unused(used + age) for age in (599, 601)] == [0, 1]
    assert remove_unused(used + 10**6) == 0


def test_old_recordings_are_moved_when_the_workers_are_idle(
    old: Episode, store: FolderStore, settings: Any
) -> None:
    settings.EVA_ARCHIVE_DAYS = None
    assert find_archivable() == 0
    settings.EVA_ARCHIVE_DAYS = 7.0
    Episode.objects.update(started_at=timezone.now() - timedelta(days=6))
    assert find_archivable() == 0
    settings.EVA_ARCHIVE_DAYS = 0.0
    other = services.request_export(episode=old)
    assert find_archivable() == 0
    performed(other)
    assert find_archivable() == 1
    run_queue("cpu")
    assert Job.objects.get(kind="archive").result == {"archived": True, "removed": 3}
    assert find_archivable() == 0


@pytest.mark.parametrize(
    "fields",
    [
        {"status": EpisodeStatus.RECORDING},
        {"status": EpisodeStatus.MISSING},
        {"damage": [{"text": "rows.arrow is changed"}]},
        {"away_since": timezone.now()},
        {"kind": "imported"},
    ],
)
def test_open_damaged_and_distant_recordings_are_never_moved(
    old: Episode, store: FolderStore, settings: Any, fields: dict[str, Any]
) -> None:
    settings.EVA_ARCHIVE_DAYS = 0.0
    Episode.objects.update(**fields)
    assert find_archivable() == 0
    with pytest.raises(NotArchived, match="stays as it is"):
        put_away(old.uuid)
    assert len(videos(old)) == 3


def test_damage_that_nobody_knows_yet_is_found_and_nothing_is_moved(old: Episode, store: FolderStore) -> None:
    path = episode_folder(old) / "cam_high.mp4"
    path.write_bytes(path.read_bytes()[:-1])
    job = performed(services.request_archive(uuid=old.uuid))
    assert job.result["archived"] is False
    assert "cam_high.mp4 has" in job.result["why"]
    old.refresh_from_db()
    assert ([entry["file"] for entry in old.damage], len(videos(old))) == (["cam_high.mp4"], 3)


def test_a_scrub_finds_the_damage_of_an_archived_recording(old: Episode, store: FolderStore) -> None:
    put_away(old.uuid)
    path = episode_folder(old) / "outcome.json"
    path.write_bytes(path.read_bytes()[:-1])
    Episode.objects.update(verified_at=None)
    job = performed(verification.request_scrub())
    assert job.result["damaged"] == 1, job.error
    old.refresh_from_db()
    assert [entry["file"] for entry in old.damage] == ["outcome.json"]


@pytest.mark.parametrize("kind", ["scrub", "publish"])
def test_a_copy_that_changed_after_it_was_brought_back_is_no_damage(
    old: Episode, store: FolderStore, kind: str
) -> None:
    put_away(old.uuid)
    bring_back(old.uuid)
    videos(old)[0].write_bytes(b"another")
    Episode.objects.update(verified_at=None)
    job = performed(
        verification.request_scrub() if kind == "scrub" else services.request_publish(episode=old)
    )
    assert job.result.get("found", []) == []
    old.refresh_from_db()
    assert (old.damage, verify_episode(episode_folder(old)).state) == ([], "sound")


def test_nothing_is_removed_by_an_index_of_other_files(old: Episode, store: FolderStore) -> None:
    put_away(old.uuid)
    bring_back(old.uuid)
    earlier = store.folder / "earlier.mp4"
    earlier.write_bytes(b"another")
    named = {"cam_high.mp4": store.put(earlier, "video/mp4")}
    index(old).write_text(json.dumps({"files": named}))
    with pytest.raises(RecordingError, match=r"cam_high\.mp4 is in the store with another SHA-256"):
        put_away(old.uuid)
    assert remove_unused(time.time() + 3700) == 0
    assert len(videos(old)) == 3


def test_an_unrepaired_recording_is_not_moved(old: Episode, store: FolderStore) -> None:
    for name in ("outcome.json", "sealed.json"):
        os.unlink(episode_folder(old) / name)
    with pytest.raises(NotArchived, match="it has no outcome"):
        put_away(old.uuid)
    assert len(videos(old)) == 3


def test_the_command_moves_and_brings_back_with_a_line_for_each(old: Episode, store: FolderStore) -> None:
    def said(*args: str) -> str:
        out = io.StringIO()
        call_command("archive", str(old.uuid), *args, stdout=out)
        return out.getvalue().removeprefix(f"{old.uuid}: ").strip()

    assert said("--back") == "is not in the store: nothing to bring back"
    assert [said(), said()] == ["in the store, 3 files removed here", "in the store already"]
    assert [said("--back"), said("--back")] == ["3 files brought back", "is here already"]
    Episode.objects.update(status=EpisodeStatus.RECORDING)
    with pytest.raises(CommandError, match="1 of 1 could not be moved"):
        call_command("archive", str(old.uuid), stderr=io.StringIO())


def test_a_fetch_that_was_killed_leaves_no_file_that_a_reader_sees(
    old: Episode, store: FolderStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = content(episode_folder(old))
    put_away(old.uuid)
    with monkeypatch.context() as patch:
        patch.setattr(os, "replace", kill)
        patch.setattr(Path, "unlink", lambda path, missing_ok=False: None)  # a kill tidies nothing up
        with pytest.raises(KilledError):
            bring_back(old.uuid)
    assert [path for path in episode_folder(old).iterdir() if path.name.startswith(".draft")]
    assert videos(old) == []
    assert bring_back(old.uuid) == 3
    put_away(old.uuid)
    bring_back(old.uuid)
    assert content(episode_folder(old)) == before


def test_days_without_a_store_end_the_start_with_a_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    assert environment.archive_days("EVA_ARCHIVE_DAYS", False) is None
    monkeypatch.setenv("EVA_ARCHIVE_DAYS", "90")
    assert environment.archive_days("EVA_ARCHIVE_DAYS", True) == 90.0
    with pytest.raises(ImproperlyConfigured, match="EVA_STORE names no store"):
        environment.archive_days("EVA_ARCHIVE_DAYS", False)
    monkeypatch.setenv("EVA_ARCHIVE_DAYS", "-1")
    with pytest.raises(ImproperlyConfigured, match="days from 0"):
        environment.archive_days("EVA_ARCHIVE_DAYS", True)


def test_a_recording_whose_folder_is_gone_does_not_keep_the_others_from_coming_back(
    old: Episode, store: FolderStore
) -> None:
    put_away(old.uuid)
    gone = archive_folder() / "here" / str(uuid4())
    gone.touch()
    os.utime(gone, (1.0, 1.0))
    assert bring_back(old.uuid) == 3
    assert not gone.exists()


def test_a_disk_that_keeps_the_files_of_one_recording_is_asked_again_after_an_hour(
    old: Episode, store: FolderStore, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    put_away(old.uuid)
    bring_back(old.uuid)

    def refuse(path: Path, missing_ok: bool = False) -> None:
        raise PermissionError(errno.EACCES, "Permission denied")

    later = time.time() + 3700
    with monkeypatch.context() as patch:
        patch.setattr(Path, "unlink", refuse)
        assert remove_unused(later) == 0
    assert "Permission denied" in caplog.text
    assert [remove_unused(later + age) for age in (3599, 3601)] == [0, 1]


def test_files_stay_if_the_store_has_another_content_or_a_job_begins_meanwhile(
    old: Episode, store: FolderStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    put_away(old.uuid)
    bring_back(old.uuid)
    later = time.time() + 3700
    path = store.file(next(iter(archive.archived_files(old.uuid).values())))
    assert path is not None
    whole = path.read_bytes()
    path.write_bytes(b"")
    assert (remove_unused(later), len(videos(old))) == (0, 3)
    path.write_bytes(whole)

    def begin(*given: object) -> None:
        bring_back(old.uuid)

    with monkeypatch.context() as patch:
        patch.setattr(archive, "compared", begin)
        assert (remove_unused(later + 3601), len(videos(old))) == (0, 3)
    assert remove_unused(later + 2 * 3601) == 1


def test_the_command_leaves_files_that_a_job_has_begun_to_read(
    old: Episode, store: FolderStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    def begin(*given: Any) -> None:
        job = Job.objects.create(kind="quality", key="quality", status=JobStatus.RUNNING, owner=uuid4())
        Hold.objects.create(what=f"episodes/{old.uuid}", job=job, owner=job.owner)
        write_index(*given)

    monkeypatch.setattr(archive, "write_index", begin)
    out = io.StringIO()
    call_command("archive", str(old.uuid), stdout=out)
    assert (len(videos(old)), index(old).exists()) == (3, True)
    Job.objects.filter(kind="quality").delete()
    assert remove_unused(time.time() + 3700) == 1
    assert videos(old) == []


def test_a_move_that_failed_is_asked_for_again_after_a_day_and_hides_no_other(
    old: Episode, store: FolderStore, settings: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings.EVA_ARCHIVE_DAYS = 0.0
    job = services.request_archive(uuid=old.uuid)
    failed = Job.objects.filter(pk=job.pk)
    failed.update(status=JobStatus.FAILED, finished_at=timezone.now() - timedelta(hours=2))
    assert find_archivable() == 0
    monkeypatch.setattr(verification, "MOST_EPISODES", 1)
    other = uuid4()
    fields = Episode.objects.filter(pk=old.pk).values().get()
    Episode.objects.create(**{**fields, "uuid": other, "started_at": timezone.now() - WEEK})
    Episode.objects.filter(pk=old.pk).update(started_at=timezone.now() - 2 * WEEK)
    monkeypatch.setattr(verification, "_closed_before", lambda uuid, limit: True)
    assert [job.key for job in verification.request_archives()] == [f"archive:{other}"]
    Job.objects.exclude(pk=job.pk).delete()
    failed.update(finished_at=timezone.now() - timedelta(hours=25))
    assert [job.key for job in verification.request_archives()] == [f"archive:{old.uuid}"]
    Job.objects.exclude(pk=job.pk).delete()
    failed.update(status=JobStatus.DONE, result={"archived": False})
    assert [job.key for job in verification.request_archives()] == [f"archive:{other}"]


@pytest.mark.parametrize("lost", ["an object", "its index"])
def test_a_scrub_goes_on_behind_a_recording_that_does_not_come_back(
    old: Episode, store: FolderStore, closed: Callable[..., Episode], lost: str
) -> None:
    other = closed("interrupted")
    run_queue("cpu")
    for episode in (old, other):
        put_away(episode.uuid)
    named = json.dumps({"files": {"cam_high.mp4": "0" * 64}})
    index(old).write_text("{" if lost == "its index" else named)
    Episode.objects.update(created_at=timezone.now() - WEEK, verified_at=timezone.now() - 9 * WEEK)
    Episode.objects.filter(pk=old.pk).update(verified_at=timezone.now() - 10 * WEEK)
    job = performed(verification.request_scrub())
    assert (job.status, bool(job.error)) == (JobStatus.QUEUED, True)
    other.refresh_from_db()
    assert other.verified_at is not None
    assert other.verified_at > timezone.now() - WEEK
    old.refresh_from_db()
    assert (old.damage, old.verified_at is not None) == ([], True)
