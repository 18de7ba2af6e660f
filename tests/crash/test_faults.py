"""Every fault from outside is a named state and a sentence that says what to do."""

import os
import resource
import signal
import subprocess
import time
import uuid

import numpy as np
import pytest

from runtime.clients.client import Refused, StationClient
from runtime.core.errors import TransportError
from runtime.policies.tunnel.ssh_process import free_port
from runtime.recording.reader import open_episode
from tests.crash.lab import ROBOT
from tests.processes import PATIENCE_S, eventually

pytestmark = pytest.mark.slow


def assert_setup_fails(lab, *words, **asked):
    lab.client.command("setup", **asked)
    status = lab.reach("idle", "ready")
    assert status["state"] == "idle"
    for word in words:
        assert word in status["reason"], status["reason"]


def assert_holds(lab, *words):
    status = lab.reach("holding")
    for word in words:
        assert word in status["reason"], status["reason"]
    behaviour = lab.client.wait(lambda s: s["control"]["behaviour"] == "hold", PATIENCE_S)
    assert behaviour["control"]["engaged"]
    return status


# --- the policy server -------------------------------------------------------------------------------------


@pytest.fixture
def served(station):
    """The shared station, and how a set-up asks for a policy server that fails so."""

    def by(*arguments):
        address = station.start(
            *("failing", "runtime.standins.serve", "openpi", "--robot", ROBOT, "--port", "0"),
            *("--latency-ms", "20", *arguments),
        )
        return {"policy": {"url": address["url"], "connect_deadline": 1.0, "inference_deadline": 1.0}}

    yield station, by
    server = station.children.pop("failing")
    server.stdin.close()
    server.wait(PATIENCE_S)


def test_policy_server_mute_on_connect(served):
    lab, by = served
    assert_setup_fails(lab, "1 s", **by("--fault", "mute_on_connect"))


def test_policy_server_mute_in_the_middle_of_a_run(served):
    lab, by = served
    lost = len(lab.events("policy_lost"))
    lab.running(0.5, **by("--fault", "mute_on_infer:20"))
    assert_holds(lab, "no usable chunk for ", "1 s")  # one loss is borne, the next is not
    assert len(lab.events("policy_lost")) > lost


def test_policy_server_dying_in_the_middle_of_a_run(served):
    lab, by = served
    before = len(lab.events("policy_lost"))
    lab.running(0.2, **by("--fault", "die:25"))
    status = assert_holds(lab)
    lost = lab.events("policy_lost")[before:]
    assert lost
    assert "no usable chunk" in status["reason"]
    assert status["reason"].partition(": ")[2][:30] in lost[0]["text"] + status["reason"]
    episode = status["recording"]["uuid"]
    assert episode  # the run is open: resume or stop
    lab.client.command("stop")
    assert lab.outcome(episode)["status"] == "finished"
    assert lab.outcome(episode)["held_rows"] > 0


def test_policy_with_a_wrong_dimension(served):
    lab, by = served
    assert_setup_fails(lab, "13", "14", **by("--fault", "wrong_dim"))


def test_policy_answering_nan(served):
    lab, by = served
    assert_setup_fails(lab, "nan", "row 3", **by("--fault", "nan"))


# --- the execution node ------------------------------------------------------------------------------------


def test_node_dying_in_the_middle_of_a_run(station):
    station.running(0.5)
    station.children.pop("node").kill()
    assert_holds(station, "10 actions refused in a row", "old")


def test_node_restarted_with_a_smaller_clock_is_noticed_and_seen_again(station):
    told = len(station.events("source_clock_backwards"))
    station.children.pop("node").kill()
    station.reach("disconnected")
    station.node("--clock-offset", "-100000")
    station.reach("idle")
    eventually(lambda: len(station.events("source_clock_backwards")) > told, "the event")
    assert station.client.status()["link"]["ages"]["joints"] < 0.5
    station.ready()
    station.children.pop("node").kill()


# --- commands and leases -----------------------------------------------------------------------------------


def test_two_commanders_the_second_is_refused_and_told_who_holds_the_lease(station):
    lab = station.ready()
    second = StationClient(lab.data / "stations" / "demo", holder="somebody else")
    with pytest.raises(Refused, match="test holds the lease"):
        second.command("run")
    assert lab.client.status()["state"] == "ready"
    assert second.estop("anybody may").status == "done"
    assert lab.reach("faulted")["reason"].startswith("e-stop by account:")
    second.close()


def test_a_stale_command_is_refused_and_a_repeated_one_gets_its_first_answer(station):
    lab = station.rest(kills=1).ready()
    client, identity = lab.client, str(uuid.uuid4())
    client.claim()
    client.status()
    old = client._sequence
    first = client.command("run", identity=identity)
    client._sequence = old
    with pytest.raises(Refused, match="stale"):
        client._command("run", 2.0, epoch=client._epoch)
    runs = client.status()["run"]["number"]
    again = client._command("run", 2.0, epoch=client._epoch, identity=identity)
    assert (again.status, again.sequence) == (first.status, first.sequence)
    assert client.status()["run"]["number"] == runs
    lab.kill("coordinator")
    eventually(lab.answers, "a new coordinator")
    eventually(lambda: client.status()["state"] == "idle", "the end of the run")
    replayed = client._command("run", 2.0, identity=identity)
    assert replayed.status == "accepted"  # its first answer, from the journal
    assert client.status()["state"] == "idle"  # and nothing else


@pytest.mark.story
def test_the_e_stop_works_while_main_is_stuck_and_outlives_a_restart_of_the_station(station):
    lab = station.running(0.5)
    main, episode = lab.pids()["coordinator"], lab.client.status()["recording"]["uuid"]
    os.kill(main, signal.SIGSTOP)
    try:
        ack = lab.client.estop("main is stuck")
        assert ack.status == "done", ack.reason
    finally:
        os.kill(main, signal.SIGCONT)
    lab.reach("faulted")
    assert lab.outcome(episode)["status"] == "interrupted"
    lab.end()
    lab.station()
    status = lab.reach("faulted")
    assert "main is stuck" in status["reason"]
    with pytest.raises(Refused, match="not allowed while faulted"):
        lab.client.command("setup")
    lab.client.command("release")
    lab.reach("idle")
    lab.ready()


# --- the machine -------------------------------------------------------------------------------------------


def test_a_stall_of_half_a_second_is_no_burst(station):
    lab = station.running(0.5)
    status = lab.client.status()
    episode, missed = status["recording"]["uuid"], status["control"]["missed"]
    control = lab.pids()["control"]
    os.kill(control, signal.SIGSTOP)
    time.sleep(0.5)
    os.kill(control, signal.SIGCONT)
    before = lab.client.status()["run"]["elapsed"]
    lab.client.wait(lambda s: s["run"]["elapsed"] > before + 1.0 or s["state"] != "running", PATIENCE_S)
    assert lab.client.status()["control"]["missed"] - missed >= 10
    lab.client.command("stop")
    lab.outcome(episode)
    ticks = open_episode(lab.data / "episodes" / episode).ticks
    sent = np.array(ticks["sent"].to_pylist())
    steps = np.array(ticks["step"].to_pylist())
    stall, skip = int(np.argmax(np.diff(sent))), int(np.argmax(np.diff(steps)))
    assert skip - stall in (0, 1)  # a tick that was stopped half done sends late; the one after it skips
    assert np.diff(steps)[skip] >= 10  # not caught up
    resumed = sent[skip + 1]
    soon = sent[(sent >= resumed) & (sent < resumed + 0.5)]
    assert len(soon) <= 0.5 * 30 + 1  # the first one comes on the next deadline, then one a period, no burst


@pytest.fixture
def small_disk(station):
    """The shared station, whose episodes are on a disk of 1 MiB of their own."""
    folder = station.data / "episodes"
    folder.mkdir(parents=True, exist_ok=True)
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=1m", "tmpfs", str(folder)], capture_output=True, text=True
    )
    if mounted.returncode:
        pytest.skip(f"no disk can be mounted here: {mounted.stderr.strip()}")
    yield station
    subprocess.run(["umount", "--lazy", str(folder)], check=True)  # where the test failed, files may be open


def test_a_full_disk_ends_the_recording_with_a_sentence_and_holds_the_robot(small_disk):
    lab = small_disk.running(0.5)
    media = lab.pids()["media"]
    assert_holds(lab, "disk full while writing", "bytes free")
    assert lab.pids()["media"] == media
    episode = open_episode(lab.episodes()[0])
    assert episode.frames > 15
    lab.client.command("stop")
    lab.reach("ready")
    status = lab.client.wait(lambda s: s["recording"]["unclosed"], PATIENCE_S)
    assert "disk full while writing" in status["recording"]["unclosed"][episode.path.name]
    assert not (episode.path / "outcome.json").exists()
    subprocess.run(["mount", "-o", "remount,size=8m", str(lab.data / "episodes")], check=True)
    lab.client.wait(lambda s: not s["recording"]["unclosed"], PATIENCE_S)
    whole = open_episode(episode.path)
    assert whole.outcome["status"] == "failed"
    assert whole.frames >= episode.frames
    assert lab.pids()["media"] == media


def test_a_file_that_may_not_grow_ends_the_recording_and_holds_the_robot(station):
    station.running(1.0)
    media, episode = station.pids()["media"], station.client.status()["recording"]["uuid"]
    _, most = resource.prlimit(media, resource.RLIMIT_FSIZE)
    resource.prlimit(media, resource.RLIMIT_FSIZE, (20_000, most))
    assert_holds(station, "too large while writing")
    assert station.pids()["media"] == media
    assert station.outcome(episode)["status"] == "failed"
    assert open_episode(station.data / "episodes" / episode).frames > 15
    resource.prlimit(media, resource.RLIMIT_FSIZE, (most, most))


# --- stations of their own -----------------------------------------------------------------------------------


def test_an_expiring_lease_makes_the_robot_hold_and_its_holder_may_resume(lab):
    lab.up("lease.ttl_s=2.5").running(0.5)
    # nobody renews
    eventually(lambda: lab.client.status()["state"] == "holding", "the end of the lease")
    assert "lease" in lab.client.status()["reason"]
    eventually(lambda: lab.client.status()["control"]["behaviour"] == "hold", "the hold")
    lab.client.command("resume")
    lab.client.wait(lambda s: s["state"] == "running" and s["control"]["remaining"] > 0, PATIENCE_S)
    lab.client.command("stop")
    episode = open_episode(eventually(lambda: lab.outcome() and lab.episodes()[0], "an episode"))
    sources = episode.rows["control_source"].to_pylist()
    assert {"policy", "hold"} <= set(sources)


def test_a_station_that_lacks_node_policy_server_and_room_says_so_one_after_the_other(lab):
    server = lab.addresses.pop("server")["url"]
    ends = {end: f"tcp://127.0.0.1:{free_port()}" for end in ("obs_endpoint", "action_endpoint")}
    lab.addresses["node"] = lab.own["node"] = ends
    lab.station("recording.min_free_bytes=1000000000000000")
    status = lab.client.status()
    assert status["state"] == "disconnected"
    assert "observation" in status["reason"]
    with pytest.raises(Refused, match="setup is not allowed while disconnected"):
        lab.client.command("setup")
    lab.node()
    lab.reach("idle")
    assert_setup_fails(lab, "no policy server listens at ws://127.0.0.1:1", "start it")
    lab.ready(policy={"url": server})
    with pytest.raises(
        Refused, match=rf"room to record in {lab.data}/episodes: \d+ bytes free, at least 10{{15}} wanted"
    ):
        lab.client.command("run")  # before anything moves
    assert lab.client.status()["state"] == "ready"
    assert lab.episodes() == []


def test_a_station_that_is_not_running_is_an_error_that_says_so(tmp_path):
    client = StationClient(tmp_path / "stations" / "bench-9")
    with pytest.raises(TransportError, match="station 'bench-9' is not running here"):
        client.status()
