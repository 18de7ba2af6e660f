"""What a client of a running station is shown: snapshots, joints, poses, pictures, numbered events."""

import os
import signal
import subprocess
import sys

import numpy as np
import pytest
import simplejpeg
import zmq

from runtime.ipc.bus import Endpoints, Subscriber
from tests.crash.lab import ROOT, Lab
from tests.processes import PATIENCE_S, eventually

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def lab(tmp_path_factory, shared):
    """One station for all that is looked at."""
    made = Lab(tmp_path_factory.mktemp("live"), shared.addresses).node("--width", "640", "--height", "480")
    yield made.up("bus.preview_rate=15.0")
    made.close()


def watched(subscriber, names, number):
    """Every stream's contents, until each of these has come so often."""
    seen = {}

    def enough():
        for name, content in subscriber.receive(0.1).items():
            seen.setdefault(name, []).append(content)
        return all(len(seen.get(name, ())) > number for name in names)

    eventually(enough, f"{number} of each of {', '.join(names)}")
    return seen


def test_every_stream_of_a_run_is_live_and_the_pictures_are_jpegs_of_preview_size(lab):
    lab.running(0.5)
    cameras = Endpoints(lab.data / "stations" / "demo").read("media")["cameras"]
    pictures = Subscriber(zmq.Context.instance(), cameras, "camera/")
    streams = lab.client.subscribe("state", "joints", "poses")
    seen = watched(streams, ("state", "joints", "poses"), 10)
    shown = watched(
        pictures, [f"camera/{name}" for name in ("cam_high", "cam_left_wrist", "cam_right_wrist")], 10
    )
    streams.close()
    pictures.close()
    states = [status for status in seen["state"] if status["state"] == "running"]
    assert len(states) > 1
    assert states[-1]["run"]["elapsed"] > states[0]["run"]["elapsed"]
    assert np.abs(seen["joints"][-1]["commanded"] - seen["joints"][0]["commanded"]).max() > 0
    assert seen["poses"][-1].shape == (2, 16)
    assert np.isfinite(seen["poses"][-1]).all()
    assert sorted(shown) == ["camera/cam_high", "camera/cam_left_wrist", "camera/cam_right_wrist"]
    lab.client.command("stop")
    picture = simplejpeg.decode_jpeg(shown["camera/cam_high"][-1])
    assert picture.shape == (240, 320, 3)
    assert picture.std() > 5


def test_events_are_numbered_without_gaps_and_can_be_fetched_later(lab):
    closed = len(lab.events("episode_closed"))
    lab.running(0.3)
    lab.client.command("stop")
    eventually(lambda: len(lab.events("episode_closed")) > closed, "the episode")
    events = lab.client.events_since(0)
    assert [event["number"] for event in events] == list(range(1, len(events) + 1))
    middle = events[len(events) // 2]["number"]
    later = lab.client.events_since(middle)
    assert later[: len(events) - middle] == events[middle:]


def test_a_terminal_sets_up_runs_and_stops_a_station(lab):
    def ctl(*words):
        return subprocess.Popen(
            [sys.executable, "-m", "runtime.ctl", "--data-dir", str(lab.data), "demo", *words],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            cwd=ROOT,
        )

    lab.client.claim()  # it may be held from the test before
    lab.client.release()
    before = {folder.name for folder in lab.episodes()}
    setup = ctl("setup")
    out, err = setup.communicate()
    assert setup.returncode == 0, err
    assert "READY" in out
    run = ctl("run")
    eventually(lambda: lab.client.status()["run"]["elapsed"] > 0.5, "a run")
    second = ctl("record", "start")
    _, refused = second.communicate()
    assert second.returncode == 1
    assert "record_start is not allowed while running" in refused
    os.kill(run.pid, signal.SIGINT)  # Ctrl-C stops the run
    assert run.wait(PATIENCE_S) == 0
    assert lab.client.status()["state"] == "ready"
    (episode,) = {folder.name for folder in lab.episodes()} - before
    assert lab.outcome(episode)["status"] == "finished"


def test_whoever_stops_the_robot_is_next_after_control(lab):
    classes = {
        name: (os.sched_getscheduler(pid), os.sched_getparam(pid).sched_priority)
        for name, pid in lab.pids().items()
    }
    assert classes["guard"] == classes["reception"]
    got, priority = classes["control"]
    below = priority - 1 if got == os.SCHED_FIFO else 0
    assert classes["guard"] == (got, below)
    assert classes["coordinator"] == (os.SCHED_OTHER, 0)
