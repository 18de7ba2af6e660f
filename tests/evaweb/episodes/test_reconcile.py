"""Reconcile: a database that was lost comes back from the disk, and a second run changes nothing."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from uuid import UUID

import pytest
from django.core.management import call_command

from evaweb.core.errors import EvaError
from evaweb.episodes import reconcile as reconciling
from evaweb.episodes import services
from evaweb.episodes.models import Episode, EpisodeStatus
from evaweb.episodes.reconcile import RestorableRun, reconcile
from evaweb.jobs import services as jobs
from evaweb.jobs.models import Job
from evaweb.stations.models import Station
from runtime.datasets.operations import convert
from tests.runtime.datasets.foreign import Plan, write
from tests.runtime.recording.samples import resealed

pytestmark = pytest.mark.django_db

_BEFORE = Path(__file__).parents[1] / "data_of_before" / "disk" / "scores"
SCORE = _BEFORE / "00000000-0000-0000-0000-000000000066.jsonl"


@pytest.fixture(autouse=True)
def _alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """No app above this one takes part."""
    monkeypatch.setattr(reconciling, "_restorers", [])


def everything() -> list[dict[str, object]]:
    rows = Episode.objects.order_by("uuid").values()
    return [{name: value for name, value in row.items() if name != "published_at"} for row in rows]


def test_a_lost_database_comes_back_with_stations_previews_and_datasets(
    closed: Callable[..., Episode], data: Path
) -> None:
    for status in ("finished", "interrupted"):
        episode = closed(status)
        scores = data / "scores" / f"{episode.uuid}.jsonl"
        scores.parent.mkdir(exist_ok=True)
        scores.write_bytes(SCORE.read_bytes())
        services.request_publish(episode=episode)
    jobs.run_queue("cpu")
    before = {row.uuid: row for row in Episode.objects.all()}
    Episode.objects.all().delete()
    Station.objects.all().delete()
    Job.objects.all().delete()
    report = reconcile()
    assert (report.episodes, report.made, report.missing, report.published) == (2, 2, 0, 2)
    assert report.problems == ()
    for row in Episode.objects.select_related("station"):
        was = before[row.uuid]
        for name in ("status", "reason", "frames", "duration_s", "task", "robot", "cameras", "dataset"):
            assert getattr(row, name) == getattr(was, name), name
        assert row.dataset_index == was.dataset_index
        assert row.previewed_at is not None
        assert row.station.name == "bench"
    assert not Job.objects.exists(), "nothing is missing, so nothing is asked for"
    found = everything()
    assert reconcile().made == 0
    assert everything() == found


def test_one_reader_has_seen_all_runs_before_the_next_one_begins(
    put: Callable[..., Path], station: Station, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A preference names two trials. What is wrong with one run keeps no other."""
    first, second = sorted((put().name, put("interrupted").name))
    seen: list[tuple[str, str]] = []

    def trials(kept: RestorableRun) -> int:
        seen.append(("trials", str(kept.uuid)))
        if str(kept.uuid) == first:
            raise OverflowError("date value out of range")
        return 1

    def preferences(kept: RestorableRun) -> int:
        seen.append(("preferences", str(kept.uuid)))
        return 1

    monkeypatch.setattr(reconciling, "_restorers", [trials, preferences])
    report = reconcile()
    assert [reader for reader, _ in seen] == ["trials", "trials", "preferences", "preferences"]
    assert {run for _, run in seen} == {first, second}
    assert (report.restored, report.problems) == (3, (f"run {first}: date value out of range",))


def test_a_folder_that_comes_back_is_not_missing_any_more(
    closed: Callable[..., Episode], data: Path, tmp_path_factory: pytest.TempPathFactory
) -> None:
    episode = closed()
    elsewhere = tmp_path_factory.mktemp("elsewhere") / "kept"
    folder = data / "episodes" / str(episode.uuid)
    shutil.move(folder, elsewhere)
    assert reconcile().missing == 1
    shutil.move(elsewhere, folder)
    assert reconcile().missing == 0
    episode.refresh_from_db()
    assert episode.status == EpisodeStatus.FINISHED


def test_what_cannot_be_read_is_told_and_keeps_no_other(
    put: Callable[..., Path], data: Path, station: Station
) -> None:
    put()
    damaged = put("interrupted")
    (damaged / "manifest.json").write_bytes(b"\0\0\0")
    nested = damaged.with_name("c86a888b-6d03-4355-9e03-66fd3445e50b")
    nested.mkdir()
    (nested / "manifest.json").write_bytes(b"[" * 200_000)
    shutil.copytree(nested, nested.with_name(f"{nested.name}.bak"))
    (data / "episodes" / "notes").mkdir()
    broken = data / "datasets" / "other" / "meta"
    broken.mkdir(parents=True)
    (broken / "info.json").write_text('{"codebase_version": "v9"}')
    shutil.copytree(broken, data / "datasets" / ".other.draft-x" / "meta")  # on its way
    report = reconcile()
    assert report.episodes == 1
    assert Episode.objects.count() == 1
    told = " ".join(report.problems)
    assert f"{damaged / 'manifest.json'} is not a whole JSON document" in told
    assert f"{nested / 'manifest.json'} is not a whole JSON document" in told
    for name in ("notes", f"{nested.name}.bak"):
        assert f"{data / 'episodes' / name} is no episode: its name is no uuid" in told
    assert "is a dataset of version 'v9'" in told
    assert ".other.draft-x" not in told


def test_a_manifest_of_another_episode_is_not_taken_for_this_one(
    put: Callable[..., Path], station: Station
) -> None:
    folder, other = put(), put("interrupted")
    shutil.copy(other / "manifest.json", folder / "manifest.json")
    report = reconcile()
    assert f"is of episode {other.name}, not of {folder.name}" in report.problems[0]
    assert [str(row.uuid) for row in Episode.objects.all()] == [other.name]


def test_half_a_character_in_a_manifest_is_left_out(put: Callable[..., Path], station: Station) -> None:
    folder = put()
    manifest = json.loads((folder / "manifest.json").read_text())
    (folder / "manifest.json").write_text(json.dumps(manifest | {"task": "put \ud800it"}))
    resealed(folder)
    assert reconcile().problems == ()
    assert Episode.objects.get().task == "put it"


def test_a_damaged_folder_leaves_the_row_that_was_read_before(
    closed: Callable[..., Episode], data: Path
) -> None:
    episode = closed()
    (data / "episodes" / str(episode.uuid) / "outcome.json").write_text(json.dumps({"status": "x"}))
    assert len(reconcile().problems) == 1
    episode.refresh_from_db()
    assert (episode.status, episode.frames) == (EpisodeStatus.FINISHED, 24)


def test_an_empty_lab_has_nothing_to_reconcile(data: Path, db: None) -> None:
    report = reconcile()
    assert (report.episodes, report.made, report.missing, report.problems) == (0, 0, 0, ())


def test_runs_go_to_who_understands_them_and_a_stranger_is_told(
    put: Callable[..., Path], data: Path, db: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    given: list[RestorableRun] = []

    def restore(kept: RestorableRun) -> int:
        given.append(kept)
        return len(kept.lines)

    monkeypatch.setattr(reconciling, "_restorers", [restore])
    recorded, alone = UUID(put().name), UUID("c86a888b-6d03-4355-9e03-66fd3445e50b")
    (data / "scores").mkdir()
    file = data / "scores" / f"{alone}.jsonl"
    lines = [json.loads(line) for line in SCORE.read_text().splitlines()]
    whole = [json.dumps(line) for line in lines]
    file.write_text("\n".join([whole[0], "[1]", "", '{"success": fal', whole[1], '{"a": 1}', ""]))
    (data / "scores" / "notes.jsonl").write_text("{}\n")
    report = reconcile()
    assert report.restored == 2
    assert [(kept.uuid, kept.recorded) for kept in given] == [(recorded, True), (alone, False)]
    assert given[0].lines == []
    assert [str(line.uuid) for line in given[1].lines] == [line["uuid"] for line in lines]
    assert report.problems[:3] == (
        f"{data / 'scores' / 'notes.jsonl'} is no file of scores: its name is no uuid in lower case with dashes",
        f"{file}: line 2 was left out: [1]: Input should be an object",
        f"{file}: line 4 is not whole and was left out: EOF while parsing a value",
    )
    assert report.problems[3].startswith(f"{file}: line 6 was left out: {{'a': 1}}: Unable to extract tag")


def test_what_cannot_be_restored_is_told_and_keeps_no_other(
    put: Callable[..., Path], data: Path, db: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    names = [put(status).name for status in ("finished", "interrupted")]
    seen = []

    def restore(kept: RestorableRun) -> int:
        seen.append(str(kept.uuid))
        if len(seen) == 1:
            raise EvaError("its scores are odd")
        return 1

    monkeypatch.setattr(reconciling, "_restorers", [restore])
    report = reconcile()
    assert sorted(seen) == sorted(names)
    assert (report.restored, report.problems) == (1, (f"run {seen[0]}: its scores are odd",))


def test_an_episode_that_was_scored_after_it_was_published_is_published_again(
    closed: Callable[..., Episode], data: Path
) -> None:
    episode = closed()
    services.request_publish(episode=episode)
    jobs.run_queue("cpu")
    Job.objects.all().delete()
    assert reconcile().published == 1
    assert not Job.objects.exists()
    scores = data / "scores" / f"{episode.uuid}.jsonl"
    scores.parent.mkdir(exist_ok=True)
    scores.write_text('{"kind": "score", "success": false}\n')
    reconcile()
    assert Job.objects.get().key == f"publish:{episode.uuid}"
    jobs.run_queue("cpu")
    Job.objects.all().delete()
    reconcile()
    assert not Job.objects.exists()


def test_a_station_that_is_gone_is_known_to_be_simulated_from_its_recordings(
    put: Callable[..., Path], data: Path, db: None
) -> None:
    folder = put()
    manifest = json.loads((folder / "manifest.json").read_text())
    manifest["configuration"]["transport"] = {"kind": "zmq", "simulated": True}
    (folder / "manifest.json").write_text(json.dumps(manifest))
    resealed(folder)
    Episode.objects.update(seal="")
    reconcile()
    assert Station.objects.get().simulated is True


def test_the_command_says_what_it_found(
    put: Callable[..., Path], db: None, data: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    put()
    (data / "episodes" / "notes").mkdir()
    call_command("reconcile")
    told = capsys.readouterr()
    assert told.out.startswith("1 episodes read, 1 of them new to the database; 0 missing on this disk")
    assert "notes is no episode" in told.err


def test_a_table_that_is_missing_is_asked_for_and_a_damaged_episode_has_none(
    closed: Callable[..., Episode], data: Path
) -> None:
    whole, broken = closed(), closed("interrupted")
    jobs.run_queue("cpu")
    Job.objects.all().delete()
    tables = {path.stem: path for path in (data / "exports").rglob("*.parquet")}
    for path in tables.values():
        path.unlink()
    (data / "episodes" / str(broken.uuid) / "manifest.json").write_text("{")
    reconcile()
    assert [job.key for job in Job.objects.all()] == [f"export:{whole.uuid}"]
    jobs.run_queue("cpu")
    assert tables[str(whole.uuid)].is_file()
    Job.objects.all().delete()
    reconcile()
    assert not Job.objects.exists()


# --- one episode in several datasets -----------------------------------------------------------------------------


@pytest.fixture
def published(closed: Callable[..., Episode], data: Path) -> Episode:
    """An episode in the dataset that it was published into."""
    episode = closed()
    services.request_publish(episode=episode)
    jobs.run_queue("cpu")
    return Episode.objects.get(uuid=episode.uuid)


def place(episode: Episode) -> tuple[str, int | None]:
    return Episode.objects.values_list("dataset", "dataset_index").get(uuid=episode.uuid)


def test_an_episode_stays_where_it_was_published_when_copies_of_that_are_made(
    published: Episode, data: Path
) -> None:
    home = data / published.dataset
    convert(home, data / "datasets" / "a-copy", "v3.0")
    convert(home, data / "datasets" / "z-copy", "v2.1")
    assert reconcile().problems == ()
    assert place(published) == (published.dataset, 0)


def test_a_lost_database_finds_the_dataset_again_that_is_no_copy(published: Episode, data: Path) -> None:
    convert(data / published.dataset, data / "datasets" / "a-copy", "v3.0")
    Episode.objects.all().delete()
    reconcile()
    assert place(published) == (published.dataset, 0)


def test_a_copy_counts_once_the_dataset_that_it_was_made_of_is_gone(published: Episode, data: Path) -> None:
    convert(data / published.dataset, data / "datasets" / "a-copy", "v3.0")
    shutil.rmtree(data / published.dataset)
    reconcile()
    assert place(published) == ("datasets/a-copy", 0)


def test_an_episode_that_is_in_no_dataset_any_more_is_not_said_to_be(published: Episode, data: Path) -> None:
    shutil.rmtree(data / published.dataset)
    reconcile()
    row = Episode.objects.get(uuid=published.uuid)
    assert (row.dataset, row.dataset_index, row.published_at) == ("", None, None)


def test_a_dataset_that_cannot_be_read_keeps_its_episodes(published: Episode, data: Path) -> None:
    convert(data / published.dataset, data / "datasets" / "a-copy", "v3.0")
    (data / published.dataset / "meta" / "eva_episodes.jsonl").write_text("{")
    assert len(reconcile().problems) == 1
    assert place(published) == (published.dataset, 0)


def test_datasets_of_others_in_any_version_are_no_problem(data: Path, db: None) -> None:
    for version in ("v2.0", "v2.1", "v3.0"):
        write(data / "datasets" / f"theirs-{version}", Plan(version, lengths=(4,), videos=()))
    assert reconcile().problems == ()
