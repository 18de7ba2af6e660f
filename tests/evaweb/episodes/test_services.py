"""Episodes from the first word about them to rows that say what their folders say."""

from __future__ import annotations

import uuid
from collections.abc import Callable
from datetime import timedelta
from pathlib import Path

import pytest
from django.utils import timezone

from evaweb.core.errors import EvaError
from evaweb.episodes import services
from evaweb.episodes.models import Episode, EpisodeStatus
from evaweb.episodes.selectors import playback_stage
from evaweb.jobs.models import Job
from evaweb.stations.models import Station
from runtime.recording.repair import repair
from tests.runtime.recording.samples import unended, unsealed

pytestmark = pytest.mark.django_db


def opened(station: Station, identity: str) -> Episode:
    return services.record_opened(
        station=station, uuid=identity, task="stack", checkpoint="good", operator="ann"
    )


def test_an_episode_is_known_from_the_moment_it_opens(station: Station) -> None:
    identity = str(uuid.uuid4())
    episode = opened(station, identity)
    assert (episode.status, episode.robot, episode.checkpoint) == ("recording", "agilex_piper", "good")
    assert opened(station, identity).uuid == episode.uuid
    assert Episode.objects.count() == 1


def test_closing_reads_the_folder_and_asks_for_one_preview(
    put: Callable[..., Path], station: Station
) -> None:
    folder = put()
    opened(station, folder.name)
    for _ in range(2):
        services.record_closed(station=station, data={"uuid": folder.name, "status": "finished"})
    episode = Episode.objects.get()
    assert episode.status == EpisodeStatus.FINISHED
    assert episode.reason == "stopped by the operator"
    assert (episode.frames, episode.fps, episode.cameras[0]) == (24, 30.0, "cam_high")
    assert episode.duration_s == pytest.approx(18 / 30, abs=3 / 30)
    assert episode.checkpoint == "good", "what the folder does not know stays"
    assert [job.key for job in Job.objects.all()] == [f"preview:{folder.name}"]


def test_an_episode_that_waits_for_room_says_so_until_it_is_closed(
    put: Callable[..., Path], station: Station
) -> None:
    folder = put()
    (folder / "outcome.json").rename(folder / "aside")
    told = {"uuid": folder.name, "status": "failed", "reason": "disk full while writing it", "waits": True}
    waits = services.record_closed(station=station, data=told)
    sentence = "its end waits for room on the disk: disk full while writing it"
    assert (waits.status, waits.reason, playback_stage(episode=waits).sentence) == (
        EpisodeStatus.RECORDING,
        sentence,
        sentence,
    )
    (folder / "aside").rename(folder / "outcome.json")
    closed = services.record_closed(station=station, data=told | {"status": "finished", "waits": False})
    assert (closed.status, closed.reason) == (EpisodeStatus.FINISHED, "stopped by the operator")


def test_an_episode_that_opens_after_it_was_closed_stays_closed(
    put: Callable[..., Path], station: Station
) -> None:
    folder = put()
    services.record_closed(station=station, data={"uuid": folder.name})
    assert opened(station, folder.name).status == EpisodeStatus.FINISHED


def test_a_folder_on_another_machine_leaves_the_words_of_the_event(data: Path, station: Station) -> None:
    told = {"uuid": str(uuid.uuid4()), "status": "interrupted", "reason": "e-stop", "path": "/etc/passwd"}
    episode = services.record_closed(station=station, data=told)
    assert episode.status == EpisodeStatus.INTERRUPTED
    assert episode.reason.startswith("e-stop (")
    assert "manifest.json cannot be read" in episode.reason
    assert not Job.objects.exists()


def test_a_damaged_manifest_is_named(put: Callable[..., Path], station: Station) -> None:
    folder = put()
    (folder / "manifest.json").write_text('{"format": 1, "uuid"')
    episode = services.record_closed(station=station, data={"uuid": folder.name, "status": "made up"})
    assert episode.status == EpisodeStatus.FAILED
    assert f"{folder}/manifest.json is not a whole JSON document" in episode.reason


@pytest.mark.parametrize("given", [None, "", "../../etc", 7])
def test_an_event_that_names_no_episode_is_refused(station: Station, given: object) -> None:
    with pytest.raises(EvaError, match="is no episode"):
        services.record_closed(station=station, data={"uuid": given})
    assert not Episode.objects.exists()


def test_a_repaired_recording_is_closed_without_an_event(put: Callable[..., Path], station: Station) -> None:
    folder = put()
    unended(folder)
    opened(station, folder.name)
    assert services.close_unheard_episodes() == 0
    repair(folder)
    assert services.close_unheard_episodes() == 1
    assert Episode.objects.get().status == EpisodeStatus.INTERRUPTED
    assert services.close_unheard_episodes() == 0


def test_a_recording_closed_with_an_unusable_outcome_fails_with_the_file_named(
    put: Callable[..., Path], station: Station
) -> None:
    folder = put()
    opened(station, folder.name)
    unsealed(folder, status="fine", frames=2)
    assert services.close_unheard_episodes() == 0
    episode = Episode.objects.get()
    assert episode.status == EpisodeStatus.FAILED
    assert "outcome.json: status is 'fine', must be one of finished, interrupted, failed" in episode.reason


def test_folders_that_are_gone_are_missing_but_one_just_announced_is_not(
    data: Path, station: Station, monkeypatch: pytest.MonkeyPatch
) -> None:
    old, fresh = opened(station, str(uuid.uuid4())), opened(station, str(uuid.uuid4()))
    Episode.objects.filter(uuid=old.uuid).update(created_at=timezone.now() - timedelta(hours=1))
    ahead = timezone.now() + timedelta(hours=1)
    monkeypatch.setattr(timezone, "now", lambda: ahead)  # of the worker, which is another machine
    assert services.mark_missing() == 1
    assert Episode.objects.get(uuid=old.uuid).status == EpisodeStatus.MISSING
    assert Episode.objects.get(uuid=fresh.uuid).status == EpisodeStatus.RECORDING


def test_a_station_says_nothing_of_anothers_episode(station: Station) -> None:
    """Its computer may be anybody's: it is believed of its own episodes."""
    other = Station.objects.create(name="bench-elsewhere", robot="agilex_piper")
    episode = opened(station, str(uuid.uuid4()))
    told = {"uuid": str(episode.uuid), "status": "failed", "reason": "made up"}
    for say in (
        lambda: services.record_closed(station=other, data=told),
        lambda: opened(other, str(episode.uuid)),
    ):
        with pytest.raises(EvaError, match=f"is of {station.name}: bench-elsewhere says nothing of it"):
            say()
    services.forget_unopened(station=other, uuid=episode.uuid)
    assert Episode.objects.get().status == EpisodeStatus.RECORDING
