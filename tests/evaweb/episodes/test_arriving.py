"""Episodes of a station on another computer: honest while they are there, as all others once they are here."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from django.db import OperationalError

from evaweb.episodes import arriving, services, verification
from evaweb.episodes.job_kinds import look_for_arrived
from evaweb.episodes.models import Episode, EpisodeStatus
from evaweb.episodes.reconcile import reconcile
from evaweb.episodes.selectors import playback_stage, why_unrecorded
from evaweb.jobs.models import Job
from evaweb.jobs.services import run_queue
from evaweb.results.ratings.footage import may_become_watchable
from evaweb.reviews.selectors import unchecked_episodes
from evaweb.stations.models import Station, StationKey
from runtime.link.contents import contents_of
from runtime.link.incoming import Shelf
from runtime.link.wire import Offer, Piece, Want
from runtime.recording.files import read_json

pytestmark = pytest.mark.django_db


@pytest.fixture
def elsewhere(station: Station) -> Station:
    StationKey.objects.create(station=station, key="ab" * 32, computer="robot-pc")
    return station


@pytest.fixture
def away(data: Path, recorded: dict[str, Path], elsewhere: Station) -> Episode:
    """One that its station has closed on its own computer."""
    uuid = recorded["finished"].name
    told = {"uuid": uuid, "status": "finished", "reason": "stopped by the operator", "rows": 24}
    return services.record_closed(station=elsewhere, data=told)


def send(data: Path, folder: Path, pieces: int = 10**6) -> None:
    """What its link does, with so many pieces."""
    (data / "episodes").mkdir(exist_ok=True)
    shelf = Shelf(data, folder_station(folder), lambda uuid: "", reserve=0)
    wanted = list(shelf.handle(Offer(folder.name), contents_of(folder).packed()))
    while wanted and isinstance(wanted[0], Want) and pieces:
        want, pieces = wanted.pop(0), pieces - 1
        content = (folder / want.file).read_bytes()[want.offset : want.offset + want.count]
        wanted += shelf.handle(Piece(want.episode, want.file, want.offset), content)
    shelf.drop()


def folder_station(folder: Path) -> str:
    return str(read_json(folder / "manifest.json")["station"])


def test_one_that_is_away_is_what_its_station_said_and_nothing_looks_for_its_folder(away: Episode) -> None:
    assert (away.status, away.frames, away.reason) == ("finished", 24, "stopped by the operator")
    assert playback_stage(episode=away).sentence == "It is on the computer of station bench, not here yet."
    assert playback_stage(episode=away).is_transient
    away.cameras = ["cam_high"]
    assert may_become_watchable(away)
    assert not unchecked_episodes().exists()
    assert services.request_smoothness(most=9) == 0
    assert verification.request_scrub() is None
    assert reconcile().missing == 0
    assert Episode.objects.get().status == EpisodeStatus.FINISHED
    assert not Job.objects.exists()


def test_a_run_elsewhere_has_no_evidence_until_its_computer_has_told_and_is_not_called_lost(
    data: Path, elsewhere: Station
) -> None:
    told = {"uuid": "00000000-0000-4000-8000-000000000001"}
    services.record_opened(station=elsewhere, uuid=told["uuid"])
    why = why_unrecorded(episode=Episode.objects.get())
    assert why.startswith(f"the computer of {elsewhere} has not sent yet"), why
    closed = services.record_closed(station=elsewhere, data=told | {"status": "interrupted", "rows": 90})
    assert why_unrecorded(episode=closed) == ""


def test_a_recording_that_goes_on_elsewhere_is_not_missing(
    data: Path, elsewhere: Station, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(services, "APPEARS_WITHIN", services.APPEARS_WITHIN * 0)
    services.record_opened(station=elsewhere, uuid="00000000-0000-4000-8000-000000000001")
    assert reconcile().missing == 0
    StationKey.objects.all().delete()
    assert reconcile().missing == 1


def test_a_page_says_how_much_of_it_is_here_and_why_no_more(
    data: Path, away: Episode, recorded: dict[str, Path], elsewhere: Station
) -> None:
    folder = recorded["finished"]
    elsewhere.name = folder_station(folder)
    elsewhere.save()
    away = Episode.objects.get()
    send(data, folder, pieces=1)
    assert reconcile().problems == ()
    size = contents_of(folder).size
    said = playback_stage(episode=away).sentence
    assert said.startswith(f"It is on the computer of station {elsewhere.name}, not here yet: ")
    assert said.endswith(f" of {size / 1e6:.1f} MB.")
    list(Shelf(data, elsewhere.name, lambda uuid: "bench-9", reserve=0).handle(Offer(folder.name), b"[]"))
    assert "not here yet: the list of its files cannot be used" in playback_stage(episode=away).sentence


def test_one_that_has_arrived_is_played_checked_and_published_as_it_was_asked_to_be(
    data: Path, away: Episode, recorded: dict[str, Path]
) -> None:
    services.request_publish(episode=away)
    assert run_queue("cpu") == 1
    why = Job.objects.get().result["why"]
    assert why == "It is on the computer of station bench, not here yet. It is published when it is."
    send(data, recorded["finished"])
    assert look_for_arrived() == 1
    assert look_for_arrived() == 0
    row = Episode.objects.get()
    assert (row.away_since, row.status, row.frames) == (None, "finished", 24)
    assert row.seal
    assert [one.pk for one in unchecked_episodes()] == [row.pk]
    run_queue("cpu")
    row = Episode.objects.get()
    assert row.previewed_at is not None
    assert row.dataset_index == 0
    assert playback_stage(episode=row).name == "ready"


def test_one_that_was_noted_as_away_after_it_had_come_is_found(
    data: Path, away: Episode, recorded: dict[str, Path]
) -> None:
    shutil.copytree(recorded["finished"], data / "episodes" / str(away.pk))
    assert look_for_arrived() == 1
    assert Episode.objects.get().away_since is None


def test_one_of_which_nobody_had_said_anything_has_a_row_when_it_arrives(
    data: Path, recorded: dict[str, Path], db: None
) -> None:
    send(data, recorded["finished"])
    assert look_for_arrived() == 1
    assert str(Episode.objects.get().pk) == recorded["finished"].name


def test_whose_an_episode_is_the_database_says_or_that_it_cannot(
    away: Episode, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(arriving, "close_old_connections", lambda: None)
    assert arriving.owner_of(str(away.pk)) == "bench"
    assert arriving.owner_of("00000000-0000-4000-8000-000000000001") == ""

    def gone(**words: object) -> None:
        raise OperationalError("the server closed the connection")

    monkeypatch.setattr(arriving.Episode.objects, "filter", gone)
    with pytest.raises(OSError, match="server closed"):
        arriving.owner_of(str(away.pk))


def test_one_of_this_computer_whose_folder_is_lost_is_not_on_its_way(data: Path, station: Station) -> None:
    told = {"uuid": "00000000-0000-4000-8000-000000000002", "status": "finished", "rows": 3}
    episode = services.record_closed(station=station, data=told)
    assert episode.away_since is None
    assert playback_stage(episode=episode).name == "missing"
