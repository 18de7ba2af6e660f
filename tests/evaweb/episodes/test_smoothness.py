"""Smoothness of recordings: of the hand's speed, without pauses and without arms that stand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pyarrow as pa
import pytest

import robots
from evaweb.episodes import services
from evaweb.episodes.job_kinds import find_unmeasured_episodes
from evaweb.episodes.manifest_robot import robot_for
from evaweb.episodes.models import Episode
from evaweb.episodes.smoothness import smoothness_in, smoothness_of
from evaweb.jobs.models import Job
from evaweb.jobs.services import run_queue
from evaweb.statistics.smoothness import sparc
from runtime.recording.reader import open_episode
from tests.runtime.lockstep_station import STANDS

RATE = 30.0


@pytest.fixture(scope="module")
def real(recorded):
    return open_episode(recorded["finished"])


def moving(real, angles, *, commanded=None, sources=None, seen=None, captured=None, **manifest):
    """The episode with these angles of the left arm's first joint, tick by tick; the other arm stands.

    `seen`: the number of the observation of each tick; `captured`: when that was taken [s].
    """
    n = len(angles)
    number = np.arange(n) if seen is None else seen

    def joints(values):
        q = np.tile(STANDS.astype(np.float32), (n, 1))
        q[:, 0] += values
        return pa.FixedSizeListArray.from_arrays(pa.array(q.ravel()), real.layout.dim)

    plain = {
        "step": pa.array(np.arange(n)),
        "sequence": pa.array(number),
        "control_source": pa.array(sources or ["policy"] * n),
        "qpos": joints(np.asarray(angles)),
    }
    times = pa.array(number / RATE if captured is None else captured)
    rows = pa.table(plain | {"tick_time": pa.array(np.arange(n) / RATE), "capture_time.joints": times})
    ticks = pa.table(plain | {"executed": joints(np.asarray(angles if commanded is None else commanded))})
    return replace(real, rows=rows, ticks=ticks, manifest={**real.manifest, "control_rate": RATE, **manifest})


def bell(seconds=4.0):
    """A turn whose speed is a bell, and that speed."""
    t = np.arange(0, seconds, 1 / RATE) - seconds / 2
    speed = np.exp(-5 * t**2)
    return np.cumsum(speed) / RATE, speed


def test_it_is_the_sparc_of_the_hands_speed(real):
    angles, speed = bell()
    found = smoothness_of(moving(real, angles))
    assert found.measured == pytest.approx(sparc(speed[1:], RATE), abs=1e-4)  # a turn: the way is the angle
    assert found.commanded == found.measured
    assert set(found.arms) == {"left_arm"}
    arm = robot_for(real.manifest).arms[0]
    here, there = (arm.pose(STANDS + np.eye(len(STANDS))[0] * angle)[:3] for angle in (angles[0], angles[-1]))
    assert found.arms["left_arm"]["measured_m"] > np.linalg.norm(there - here)
    assert found.why == ""


def test_what_was_sent_is_beside_it(real):
    angles, _ = bell()
    rough = angles + 0.01 * np.sin(2 * np.pi * 4 * np.arange(len(angles)) / RATE)
    found = smoothness_of(moving(real, rough, commanded=angles))
    assert found.measured < found.commanded


def test_a_pause_of_the_operators_is_no_jerk(real):
    angles, _ = bell()
    half = len(angles) // 2
    paused = np.concatenate([angles[:half], np.full(90, angles[half - 1]), angles[half - 1 :]])
    sources = ["policy"] * half + ["hold"] * 90 + ["policy"] * (len(angles) - half + 1)
    whole = smoothness_of(moving(real, angles)).measured
    assert smoothness_of(moving(real, paused, sources=sources)).measured == pytest.approx(whole, abs=0.02)
    assert smoothness_of(moving(real, paused)).measured < whole - 0.2


def test_an_observation_that_is_old_when_it_is_seen_is_no_jerk(real):
    """Each tick sees the newest one, now one and now three ticks old, some twice: the motion was as smooth."""
    angles, _ = bell()
    ages = np.random.default_rng(2).integers(0, 3, len(angles))
    seen = np.maximum.accumulate(np.clip(np.arange(len(angles)) - ages, 0, None))
    whole = smoothness_of(moving(real, angles)).measured
    late = smoothness_of(moving(real, angles[seen], commanded=angles, seen=seen))
    assert late.measured == pytest.approx(whole, abs=0.03)
    unstamped = np.full(len(angles), np.nan)
    guessed = smoothness_of(moving(real, angles[seen], commanded=angles, seen=seen, captured=unstamped))
    assert guessed.measured < whole - 0.2, "without the times of capture it would look rough"


def test_too_few_observations_say_nothing_of_how_it_moved(real):
    angles, _ = bell()
    seen = np.arange(len(angles)) // 3 * 3
    found = smoothness_of(moving(real, angles[seen], commanded=angles, seen=seen))
    assert found.measured is None
    assert found.commanded == smoothness_of(moving(real, angles)).commanded
    assert found.why.startswith("10 observations a second")


def test_who_did_not_move_has_none(real):
    trembling = 1e-4 * np.random.default_rng(1).standard_normal(200)
    found = smoothness_of(moving(real, trembling))
    assert (found.measured, found.commanded, found.arms) == (None, None, {})
    assert found.why == "no arm moved farther than 20 mm while it was asked to"


def test_who_cannot_be_measured_says_why(real):
    angles, _ = bell()
    assert "takes twice the rate" in smoothness_of(moving(real, angles, control_rate=15)).why
    unknown = {**real.manifest["robot"], "name": "nobody"}
    assert "robot 'nobody' does not exist" in smoothness_of(moving(real, angles, robot=unknown)).why
    other = {**real.manifest["robot"], "dim": 3}
    assert "3 joints" in smoothness_of(moving(real, angles, robot=other)).why
    hand = robots.load_robot("metaworld")
    groups = [{"name": group.name} for group in hand.groups]
    armless = {"name": hand.name, "groups": groups, "dim": hand.dim, "joint_names": list(hand.joint_names)}
    assert "metaworld has no arm" in smoothness_of(moving(real, angles, robot=armless)).why


@pytest.mark.django_db
def test_it_is_asked_for_once_and_kept_with_the_episode(closed, monkeypatch):
    episode = closed()
    assert find_unmeasured_episodes() == 1
    assert find_unmeasured_episodes() == 0
    job = Job.objects.get(kind="smoothness")
    Job.objects.exclude(pk=job.pk).delete()
    assert run_queue("cpu") == 1
    episode = Episode.objects.get(pk=episode.pk)
    found = smoothness_in(services.journal_folder(episode.uuid))
    assert (episode.smoothness, episode.smoothness_commanded) == (found.measured, found.commanded)
    assert episode.smoothness_detail["arms"] == dict(found.arms)


@pytest.mark.django_db
def test_what_could_not_be_measured_is_tried_again_when_its_folder_is_read_anew(closed):
    episode = closed()
    manifest = services.journal_folder(episode.uuid) / "manifest.json"
    kept = manifest.read_bytes()
    manifest.unlink()
    find_unmeasured_episodes()
    Job.objects.exclude(kind="smoothness").delete()
    run_queue("cpu")
    episode.refresh_from_db()
    assert episode.smoothness is None
    assert "manifest.json" in episode.smoothness_detail["why"]
    manifest.write_bytes(kept)
    services.sync_episode(uuid=episode.uuid)
    assert find_unmeasured_episodes() == 1


@pytest.mark.django_db
@pytest.mark.parametrize("facts", [{"kind": "demonstration"}, {"status": "missing"}, {"frames": 0}])
def test_nobody_asks_for_that_of_what_is_no_run(closed, facts):
    Episode.objects.filter(pk=closed().pk).update(**facts)
    assert find_unmeasured_episodes() == 0
