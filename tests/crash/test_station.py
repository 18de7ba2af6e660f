"""What must not stop a whole station: a full disk, a stuck terminal, a bad leftover, a mute server."""

import contextlib
import json
import os
import select
import shutil
import socket
import subprocess
import sys
import threading

import pytest

from runtime.recording.reader import open_episode
from tests.crash.lab import ROOT, UNHURRIED
from tests.processes import alive, eventually

pytestmark = pytest.mark.slow


def leftover(lab, *names):
    """Copies of an episode that a station without its supervisor has ended, without how; the station is ended."""
    lab.running(0.5)
    episode = lab.data / "episodes" / lab.client.status()["recording"]["uuid"]
    pids = lab.pids().values()
    lab.kill("supervisor")
    eventually(lambda: not any(map(alive, pids)), "the end of the family")
    lab.client.close()
    (episode / "outcome.json").unlink()
    copies = [episode.with_name(name) for name in names]
    for copy in copies:
        shutil.copytree(episode, copy)
    return [episode, *copies]


def test_leftovers_that_cannot_be_repaired_do_not_keep_the_station_from_starting(station):
    before, after = "00000000-0000-4000-8000-000000000000", "ffffffff-ffff-4fff-8fff-ffffffffffff"
    unlike = "88888888-8888-4888-8888-888888888888"
    manifest, *good, events = leftover(station, before, after, unlike)
    (manifest / "manifest.json").write_text(json.dumps({"station": "demo"}))
    (events / "events.jsonl").unlink()
    (events / "events.jsonl").mkdir()
    station.station()
    station.reach("idle")
    for episode in good:
        eventually((episode / "outcome.json").exists, "the repair of the others")
        assert open_episode(episode).frames > 5
    for bad in (manifest, events):
        assert not (bad / "outcome.json").exists()
        assert bad.name in (station.folder / "station.log").read_text()
    station.running(0.5)
    for bad in (manifest, events):
        shutil.rmtree(bad)


def test_many_leftovers_do_not_delay_the_start(station):
    episodes = leftover(station, *(f"22222222-2222-4222-8222-{number:012}" for number in range(50)))
    station.station()
    station.reach("idle")
    station.ready()
    media = station.pids()["media"]
    eventually(lambda: all((episode / "outcome.json").exists() for episode in episodes), "all repairs")
    assert station.pids()["media"] == media


def test_a_set_up_that_waits_for_a_mute_server_is_cancelled_at_once(station):
    with socket.create_server(("127.0.0.1", 0)) as mute:
        policy = {"url": f"ws://127.0.0.1:{mute.getsockname()[1]}", "connect_deadline": 100.0}
        station.client.command("setup", policy=policy)
        assert station.client.status()["state"] == "setting_up"
        station.client.command("stop")  # answered within its two seconds
        assert station.client.status()["state"] == "idle"
        station.client.command("setup", policy=policy)  # and the worker is free for the next one
        with mute.accept()[0], mute.accept()[0]:
            station.client.command("stop")


@pytest.fixture
def small_disk(lab):
    """All of the station's files on a disk of 2 MiB of their own."""
    lab.data.mkdir(parents=True)
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=2m", "tmpfs", str(lab.data)], capture_output=True, text=True
    )
    if mounted.returncode:
        pytest.skip(f"no disk can be mounted here: {mounted.stderr.strip()}")
    yield lab
    lab.close()
    subprocess.run(["umount", str(lab.data)], check=True)


def test_a_process_is_restarted_although_the_disk_is_full_and_found_when_there_is_room(small_disk):
    lab = small_disk.up("recording.enabled=false")
    filler = lab.data / "filler"
    log = lab.folder / "station.log"
    for process in ("media", "coordinator", "guard"):
        before = lab.pids()
        with contextlib.suppress(OSError), filler.open("wb", buffering=0) as file:
            while True:
                file.write(bytes(4096))
        lab.kill(process)
        text = f"clients cannot find the process {process} until the disk takes its file"
        eventually(lambda text=text: text in log.read_text(), "the sentence in the log")
        assert lab.supervisor.poll() is None
        filler.unlink()
        eventually(
            lambda process=process, before=before: lab.pids()[process] != before[process],
            f"the new process id of {process}",
        )
        lab.answers_again()
        lab.reach("idle")
        lab.ready()


@contextlib.contextmanager
def terminal(lab):
    """A station's standard error that is read until `stuck` is set."""
    reading, writing = os.pipe()
    stuck, gone = threading.Event(), threading.Event()

    def read():
        while not gone.is_set():
            if not stuck.is_set() and select.select([reading], [], [], 0.05)[0]:
                os.read(reading, 65536)
            gone.wait(0.005)

    thread = threading.Thread(target=read)
    thread.start()
    try:
        yield writing, stuck
    finally:
        gone.set()
        thread.join()
        os.close(writing)
        os.close(reading)


def test_a_terminal_that_takes_no_more_stops_neither_commands_nor_the_e_stop(lab, monkeypatch):
    with terminal(lab) as (writing, stuck):
        real = subprocess.Popen

        def started(arguments, **options):
            if "deployments/demo.toml" in arguments:
                options["stderr"] = writing
            return real(arguments, **options)

        monkeypatch.setattr("tests.crash.lab.subprocess.Popen", started)
        lab.up().running(0.5)
        stuck.set()
        os.set_blocking(writing, False)
        with contextlib.suppress(BlockingIOError):
            while True:
                os.write(writing, bytes(4096))
        os.set_blocking(writing, True)
        for _ in range(20):
            lab.client.command("halt")  # each is a line in the coordinator's log
        assert lab.client.status()["state"] == "holding"
        for _ in range(2):
            assert lab.client.estop("the terminal is stuck").status == "done"
        assert (lab.data / "stations" / "demo" / "estop.json").exists()
        lab.reach("faulted")
        lab.close()  # ends in time, although its last lines go nowhere


def headless(lab, *assignments):
    node, server = lab.addresses["node"], lab.addresses["server"]
    settings = [
        f'transport.sub_endpoint="{node["obs_endpoint"]}"',
        f'transport.pub_endpoint="{node["action_endpoint"]}"',
        f'policy.url="{server["url"]}"',
        f'data_dir="{lab.data}"',
        "recording.min_free_bytes=0",
        *UNHURRIED,
        *assignments,
    ]
    sets = [part for setting in settings for part in ("--set", setting)]
    return subprocess.run(
        [sys.executable, "-m", "runtime", "deployments/demo.toml", "--headless", *sets],
        capture_output=True,
        text=True,
        cwd=ROOT,
    )


def of_this_lab(lab):
    """Processes that name the lab's folder."""
    found = subprocess.run(["pgrep", "-f", str(lab.data)], capture_output=True, text=True)
    return found.stdout.split()


def test_a_headless_driver_ends_with_a_family_that_gives_up(lab):
    (lab.data / "stations" / "demo" / "commands.jsonl").mkdir(parents=True)  # over which the coordinator dies
    done = headless(lab)
    assert done.returncode == 1
    assert "giving up" in done.stderr
    assert of_this_lab(lab) == []


def test_a_headless_run_that_cannot_begin_says_why_and_waits_for_no_episode(lab):
    done = headless(lab, "recording.min_free_bytes=1000000000000000")
    assert done.returncode == 1
    assert "error: too little room to record in " in done.stderr


def test_a_headless_run_says_how_it_went_and_nothing_that_nobody_asked(lab):
    done = headless(lab, "run.duration_s=1.0")
    assert done.returncode == 0, done.stderr
    assert "INFO" not in done.stderr
    told = done.stdout.partition("How it went")[2]
    for word in (
        "ended     the run's 1 s are over",
        "recorded",
        "policy    p50",
        "control",
        "0 of",
        "dataset",
    ):
        assert word in told
