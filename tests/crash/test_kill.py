"""kill -9 of each process of the family and of the supervisor, in idle, running and recording."""

import subprocess
import sys
import time

import pytest

from runtime.recording.reader import open_episode
from tests.crash.lab import ROOT, seen_since
from tests.processes import PATIENCE_S, alive, eventually

pytestmark = pytest.mark.slow
FAMILY = ("control", "coordinator", "reception", "media", "guard")


def readable_to_the_last_second(lab, killed_at, name="*"):
    """The episode opens, is marked interrupted, and reaches to within a second of the kill."""
    outcome = lab.outcome(name)
    assert outcome["status"] == "interrupted", outcome
    assert outcome["reason"]
    episode = open_episode(next((lab.data / "episodes").glob(name)))
    manifest = episode.manifest
    recorded = manifest["started_wall"] + episode.frames / manifest["fps"]
    assert recorded > killed_at - 1.2, (recorded, killed_at)  # a second, and the time to open the episode
    assert episode.frames == len(episode.rows)


def test_a_second_supervisor_for_the_same_station_is_refused(station):
    second = subprocess.run(
        [sys.executable, "-m", "runtime", "deployments/demo.toml", "--set", f'data_dir="{station.data}"'],
        capture_output=True,
        text=True,
        cwd=ROOT,
    )
    assert second.returncode == 1
    assert "station 'demo' is already running" in second.stderr
    assert station.answers()["state"] == "idle"


@pytest.mark.parametrize("state", ["idle", pytest.param("recording", marks=pytest.mark.story)])
def test_a_killed_process_is_restarted_and_nothing_moves_until_set_up_again(station, state):
    station.rest(kills=len(FAMILY))
    for process in FAMILY:
        if state == "recording":
            station.running(1.3)  # set up after the one before was killed
        one_is_killed(station, process, state)
        if state == "idle" or process == FAMILY[-1]:
            station.ready()


def one_is_killed(lab, process, state):
    before, episode = lab.pids(), lab.client.status()["recording"]["uuid"]
    killed_at = time.time()
    lab.kill(process)
    eventually(lambda: lab.pids()[process] != before[process], f"a restart of {process}")
    restarted_at = time.monotonic()
    lab.answers_again()
    step = lab.client.status()["control"]["step"]
    # else a set-up ends with the link that is lost yet, or with joints that a new control has not seen for long enough
    lab.client.wait(lambda s: seen_since(s, restarted_at) and s["control"]["step"] > step + 10, PATIENCE_S)
    lab.reach("idle")
    assert before | {process: 0} == lab.pids() | {process: 0}
    if state == "recording":
        readable_to_the_last_second(lab, killed_at, episode)
        held = lab.client.wait(lambda s: s["control"]["behaviour"] == "hold", PATIENCE_S)
        assert held["control"]["engaged"], process


def recording(lab, episode):
    """Some rows of that episode are recorded; the count is that of the one before until media has told of it."""
    lab.client.wait(lambda s: s["recording"]["uuid"] == episode and s["recording"]["rows"] > 15, PATIENCE_S)


@pytest.mark.parametrize(
    ("process", "status", "reason"),
    [
        ("control", "interrupted", "the process control died and was restarted"),
        ("coordinator", "interrupted", "the coordinator has given no sign of life since it was restarted"),
        ("media", "interrupted", "the recorder ended without closing the episode"),
        ("guard", "finished", "stopped by the operator"),
    ],
)
def test_a_recording_without_a_run_is_never_left_half_open_by_a_kill(station, process, status, reason):
    lab = station.rest(kills=1).ready()
    others = set(lab.episodes())
    alone = lab.client.command("record_start").data["episode"]
    recording(lab, alone)
    recorded = lab.data / "episodes" / alone
    eventually(lambda: open_episode(recorded).frames > 10, "what is counted is on the disk too")
    before = lab.pids()
    lab.kill(process)
    eventually(lambda: lab.pids()[process] != before[process], "a restart")
    lab.answers_again()
    lab.reach("idle")
    lab.ready()
    if process == "guard":  # it held nothing of the recording
        assert lab.client.status()["recording"]["uuid"] == alone
        lab.client.command("record_stop")
    run = lab.client.command("run").data["episode"]
    recording(lab, run)
    lab.client.command("stop")
    found = {}
    for episode in (alone, run):
        folder = lab.data / "episodes" / episode
        eventually((folder / "outcome.json").exists, f"the outcome of {episode}")
        found[episode] = open_episode(folder)
        assert found[episode].frames > 10
    assert (found[alone].outcome["status"], found[run].outcome["status"]) == (status, "finished")
    assert reason in found[alone].outcome["reason"]
    assert {path.name for path in set(lab.episodes()) - others} == {alone, run}


@pytest.mark.parametrize("state", ["idle", pytest.param("recording", marks=pytest.mark.story)])
def test_nothing_is_left_ten_seconds_after_the_supervisor_was_killed(lab, state):
    lab.up("control.orphan_hold_s=2.0")
    if state == "recording":
        lab.running(2.0)
    pids = lab.pids()
    killed_at = time.time()
    lab.kill("supervisor")
    if state == "recording":
        time.sleep(1.0)
        assert alive(pids["control"])  # it is holding
    eventually(lambda: not any(map(alive, pids.values())), "the end of the family")
    if state == "recording":
        readable_to_the_last_second(lab, killed_at)
