"""Every fault from outside is a named state and a sentence that says what to do."""

import os
import resource
import signal
import subprocess
import time

import numpy as np
import pytest

from runtime.clients.client import Refused, StationClient
from runtime.core.errors import TransportError
from runtime.recording.reader import open_episode
from tests.crash.lab import Lab
from tests.processes import eventually

pytestmark = pytest.mark.slow


def assert_setup_fails(lab, *words, **asked):
    lab.client.command("setup", **asked)
    status = lab.reach("idle", "ready")
    assert status["state"] == "idle"
    for word in words:
        assert word in status["reason"], status["reason"]


def assert_holds(lab, *words, seconds=15):
    status = lab.reach("holding", seconds=seconds)
    for word in words:
        assert word in status["reason"], status["reason"]
    behaviour = lab.client.wait(lambda s: s["control"]["behaviour"] == "hold", 60)
    assert behaviour["control"]["engaged"]
    return status


# --- the policy server -------------------------------------------------------------------------------------


def test_policy_server_absent(lab):
    lab.addresses.pop("server")
    lab.station()
    lab.reach("idle")
    assert_setup_fails(lab, "no policy server listens at ws://127.0.0.1:1", "start it")


@pytest.fixture(scope="module")
def station(tmp_path_factory, peers):
    """One station, set up with one policy server after the other."""
    made = Lab(tmp_path_factory.mktemp("served"), peers).node()  # which obeys one station at a time
    yield made.up("policy.connect_deadline=1.0", "policy.inference_deadline=1.0")
    made.close()


@pytest.fixture
def served(station):
    """That station, and how it is given a server that fails so; at rest afterwards."""

    def by(*arguments):
        station.server(*arguments)
        return {"policy": {"url": station.addresses["server"]["url"]}}

    yield station, by
    if "stop" in station.client.status()["allowed"]:
        station.client.command("stop")
    server = station.children.pop("server")
    server.stdin.close()
    server.wait(10)


def test_policy_server_mute_on_connect(served):
    lab, by = served
    assert_setup_fails(lab, "1 s", **by("--fault", "mute_on_connect"))


def test_policy_server_mute_in_the_middle_of_a_run(served):
    lab, by = served
    lost = len(lab.events("policy_lost"))
    lab.running(0.5, **by("--fault", "mute_on_infer:20"))
    assert_holds(lab, "no usable chunk for 1.", "1 s")
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


def test_node_absent(lab):
    lab.addresses.pop("node")
    lab.station()
    status = lab.client.status()
    assert status["state"] == "disconnected"
    assert "observation" in status["reason"]
    with pytest.raises(Refused, match="setup is not allowed while disconnected"):
        lab.client.command("setup")


def test_node_dying_in_the_middle_of_a_run(lab):
    lab.node().up().running(0.5)
    lab.children.pop("node").kill()
    assert_holds(lab, "10 actions refused in a row", "old")


def test_node_restarted_with_a_smaller_clock_is_noticed_and_seen_again(lab):
    lab.node().up()
    lab.children.pop("node").kill()
    lab.reach("disconnected")
    lab.node("--clock-offset", "-100000")
    lab.reach("idle")
    eventually(lambda: lab.events("source_clock_backwards"), 5, "the event")
    assert lab.client.status()["link"]["ages"]["joints"] < 0.5
    lab.ready()


# --- commands and leases -----------------------------------------------------------------------------------


def test_two_commanders_the_second_is_refused_and_told_who_holds_the_lease(lab):
    lab.up().ready()
    second = StationClient(lab.data / "stations" / "demo", holder="somebody else")
    with pytest.raises(Refused, match="test holds the lease"):
        second.command("run")
    assert lab.client.status()["state"] == "ready"
    assert second.estop("anybody may").status == "done"
    assert lab.reach("faulted")["reason"].startswith("e-stop by account:")
    second.close()


def test_a_stale_command_is_refused_and_a_repeated_one_gets_its_first_answer(lab):
    lab.up().ready()
    client = lab.client
    client.claim()
    client.status()
    old = client._sequence
    first = client.command("run", identity="11111111-1111-4111-8111-111111111111")
    client._sequence = old
    with pytest.raises(Refused, match="stale"):
        client._command("run", 2.0, epoch=client._epoch)
    runs = client.status()["run"]["number"]
    again = client._command("run", 2.0, epoch=client._epoch, identity="11111111-1111-4111-8111-111111111111")
    assert (again.status, again.sequence) == (first.status, first.sequence)
    assert client.status()["run"]["number"] == runs
    lab.kill("coordinator")
    eventually(lab.answers, 10, "a new coordinator")
    lab.reach("idle")
    replayed = client._command("run", 2.0, identity="11111111-1111-4111-8111-111111111111")
    assert replayed.status == "accepted"  # its first answer, from the journal
    assert client.status()["state"] == "idle"  # and nothing else


def test_an_expiring_lease_makes_the_robot_hold_and_its_holder_may_resume(lab):
    lab.up("lease.ttl_s=1.0").running(0.5)
    time.sleep(1.5)  # nobody renews
    status = lab.client.status()
    assert status["state"] == "holding"
    assert "lease" in status["reason"]
    lab.client.command("resume")
    lab.client.wait(lambda s: s["state"] == "running" and s["control"]["remaining"] > 0, 60)
    lab.client.command("stop")
    episode = open_episode(eventually(lambda: lab.outcome() and lab.episodes()[0], 10, "an episode"))
    sources = episode.rows["control_source"].to_pylist()
    assert {"policy", "hold"} <= set(sources)


def test_the_e_stop_works_while_main_is_stuck_and_outlives_a_restart_of_the_station(lab):
    lab.up().running(0.5)
    main = lab.pids()["coordinator"]
    os.kill(main, signal.SIGSTOP)
    try:
        ack = lab.client.estop("main is stuck")
        assert ack.status == "done", ack.reason
    finally:
        os.kill(main, signal.SIGCONT)
    lab.reach("faulted")
    assert lab.outcome()["status"] == "interrupted"
    lab.supervisor.send_signal(signal.SIGTERM)
    lab.supervisor.wait(20)
    lab.client.close()
    lab.station()
    status = lab.reach("faulted")
    assert "main is stuck" in status["reason"]
    with pytest.raises(Refused, match="not allowed while faulted"):
        lab.client.command("setup")
    lab.client.command("release")
    lab.reach("idle")
    lab.ready()


# --- the machine -------------------------------------------------------------------------------------------


def test_a_stall_of_half_a_second_is_no_burst(lab):
    lab.up().running(1.0)
    control = lab.pids()["control"]
    os.kill(control, signal.SIGSTOP)
    time.sleep(0.5)
    os.kill(control, signal.SIGCONT)
    before = lab.client.status()["run"]["elapsed"]
    lab.client.wait(lambda s: s["run"]["elapsed"] > before + 1.0 or s["state"] != "running", 60)
    assert lab.client.status()["control"]["missed"] >= 10
    lab.client.command("stop")
    lab.outcome()
    ticks = open_episode(lab.episodes()[0]).ticks
    sent = np.array(ticks["sent"].to_pylist())
    steps = np.array(ticks["step"].to_pylist())
    stall = int(np.argmax(np.diff(sent)))
    assert np.diff(steps)[stall] >= 10  # skipped, not caught up
    resumed = sent[stall + 1]
    soon = sent[(sent >= resumed) & (sent < resumed + 0.5)]
    assert len(soon) <= 0.5 * 30 + 1  # the first one comes on the next deadline, then one a period, no burst


@pytest.fixture
def small_disk(lab):
    """The episodes on a disk of 1 MiB of their own."""
    folder = lab.data / "episodes"
    folder.mkdir(parents=True)
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=1m", "tmpfs", str(folder)], capture_output=True, text=True
    )
    if mounted.returncode:
        pytest.skip(f"no disk can be mounted here: {mounted.stderr.strip()}")
    yield lab
    lab.close()
    subprocess.run(["umount", str(folder)], check=True)


def test_a_full_disk_ends_the_recording_with_a_sentence_and_holds_the_robot(small_disk):
    lab = small_disk.up().running(0.5)
    media = lab.pids()["media"]
    assert_holds(lab, "disk full while writing", "bytes free", seconds=60)
    assert lab.pids()["media"] == media
    episode = open_episode(lab.episodes()[0])
    assert episode.frames > 15
    lab.client.command("stop")
    lab.reach("ready")
    status = lab.client.wait(lambda s: s["recording"]["unclosed"], 15)
    assert "disk full while writing" in status["recording"]["unclosed"][episode.path.name]
    assert not (episode.path / "outcome.json").exists()
    subprocess.run(["mount", "-o", "remount,size=8m", str(lab.data / "episodes")], check=True)
    lab.client.wait(lambda s: not s["recording"]["unclosed"], 60)
    whole = open_episode(episode.path)
    assert whole.outcome["status"] == "failed"
    assert whole.frames >= episode.frames
    assert lab.pids()["media"] == media


def test_a_file_that_may_not_grow_ends_the_recording_and_holds_the_robot(lab):
    lab.up().running(1.0)
    media = lab.pids()["media"]
    resource.prlimit(media, resource.RLIMIT_FSIZE, (20_000, 20_000))
    assert_holds(lab, "too large while writing")
    assert lab.pids()["media"] == media
    assert lab.outcome()["status"] == "failed"
    assert open_episode(lab.episodes()[0]).frames > 15


def test_too_little_room_refuses_the_run_before_anything_moves(lab):
    lab.up("recording.min_free_bytes=1000000000000000").ready()
    with pytest.raises(
        Refused, match=rf"room to record in {lab.data}/episodes: \d+ bytes free, at least 10{{15}} wanted"
    ):
        lab.client.command("run")
    assert lab.client.status()["state"] == "ready"
    assert lab.episodes() == []


def test_a_station_that_is_not_running_is_an_error_that_says_so(tmp_path):
    client = StationClient(tmp_path / "stations" / "bench-9")
    with pytest.raises(TransportError, match="station 'bench-9' is not running here"):
        client.status()
