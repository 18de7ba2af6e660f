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
from tests.crash.lab import ROOT
from tests.processes import alive, eventually

pytestmark = pytest.mark.slow


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


@pytest.mark.parametrize("process", ["media", "coordinator", "guard"])
def test_a_process_is_restarted_although_the_disk_is_full_and_found_when_there_is_room(small_disk, process):
    lab = small_disk.up("recording.enabled=false")
    before = lab.pids()
    filler = lab.data / "filler"
    with contextlib.suppress(OSError), filler.open("wb", buffering=0) as file:
        while True:
            file.write(bytes(4096))
    lab.kill(process)
    log = lab.folder / "station.log"
    text = f"clients cannot find the process {process} until the disk takes its file"
    eventually(lambda: text in log.read_text(), 10, "the sentence in the log")
    assert lab.supervisor.poll() is None
    filler.unlink()
    eventually(lambda: lab.pids()[process] != before[process], 10, "the new process ids")
    eventually(lab.answers, 10, "the station answers")
    lab.ready()


@pytest.mark.parametrize("ending", ["manifest", "events"])
def test_a_leftover_that_cannot_be_repaired_does_not_keep_the_station_from_starting(lab, ending):
    lab.up("control.orphan_hold_s=0.5").running(0.5)
    pids = lab.pids().values()
    lab.kill("supervisor")
    eventually(lambda: not any(map(alive, pids)), 10, "the end of the family")
    lab.client.close()
    (bad,) = lab.episodes()
    (bad / "outcome.json").unlink()
    good = bad.with_name("22222222-2222-4222-8222-222222222222")
    shutil.copytree(bad, good)
    if ending == "manifest":
        (bad / "manifest.json").write_text(json.dumps({"station": "demo"}))
    else:
        (bad / "events.jsonl").unlink()
        (bad / "events.jsonl").mkdir()
    lab.station()
    lab.reach("idle")
    eventually((good / "outcome.json").exists, 10, "the repair of the other one")
    assert not (bad / "outcome.json").exists()
    assert open_episode(good).frames > 5
    assert bad.name in (lab.folder / "station.log").read_text()
    lab.running(0.5)


def test_many_leftovers_do_not_delay_the_start(lab):
    lab.up("control.orphan_hold_s=0.5").running(0.5)
    pids = lab.pids().values()
    lab.kill("supervisor")
    eventually(lambda: not any(map(alive, pids)), 10, "the end of the family")
    lab.client.close()
    (left,) = lab.episodes()
    (left / "outcome.json").unlink()
    copies = [left.with_name(f"22222222-2222-4222-8222-{number:012}") for number in range(50)]
    for copy in copies:
        shutil.copytree(left, copy)
    lab.station()
    lab.reach("idle", seconds=10)
    lab.ready()
    media = lab.pids()["media"]
    eventually(lambda: all((copy / "outcome.json").exists() for copy in copies), 30, "all repairs")
    assert lab.pids()["media"] == media


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


def test_a_set_up_that_waits_for_a_mute_server_is_cancelled_at_once(lab):
    with socket.create_server(("127.0.0.1", 0)) as mute:
        lab.addresses["server"] = {"url": f"ws://127.0.0.1:{mute.getsockname()[1]}"}
        lab.station("policy.connect_deadline=100.0")
        lab.reach("idle")
        lab.client.command("setup")
        assert lab.client.status()["state"] == "setting_up"
        lab.client.command("stop")  # answered within its two seconds
        assert lab.client.status()["state"] == "idle"
        lab.client.command("setup")  # and the worker is free for the next one
        with mute.accept()[0], mute.accept()[0]:
            lab.client.command("stop")


def headless(lab, *assignments):
    node, server = lab.addresses["node"], lab.addresses["server"]
    settings = [
        f'transport.sub_endpoint="{node["obs_endpoint"]}"',
        f'transport.pub_endpoint="{node["action_endpoint"]}"',
        f'policy.url="{server["url"]}"',
        f'data_dir="{lab.data}"',
        "recording.min_free_bytes=0",
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
    done = headless(lab, "run.duration_s=2.0")
    assert done.returncode == 0, done.stderr
    assert "INFO" not in done.stderr
    told = done.stdout.partition("How it went")[2]
    for word in (
        "ended     the run's 2 s are over",
        "recorded",
        "policy    p50",
        "control",
        "0 of",
        "dataset",
    ):
        assert word in told
