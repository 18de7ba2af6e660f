"""One trial by command, as the README has it, and what it leaves on the disk."""

import json
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from tests.e2e.lab import ROOT, environment

pytestmark = [pytest.mark.slow, pytest.mark.timeout(300)]
READER = ROOT / "tests" / "conformance" / "read_lerobot_v21.py"
MANAGE = [sys.executable, "manage.py", "demo"]


def once(folder, *options):
    """Run the command to its end; its result."""
    out = folder / "out.json"
    done = subprocess.run(
        [*MANAGE, "--once", "--json", str(out), "--port", "0", *options],
        cwd=ROOT,
        env=environment(folder / "data"),
        capture_output=True,
        text=True,
        timeout=180,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert json.loads(done.stdout) == json.loads(out.read_text())
    return json.loads(out.read_text())


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("once")


@pytest.fixture(scope="module")
def first(folder):
    return once(folder)


@pytest.fixture(scope="module")
def second(folder, first):
    return once(folder, "--position", "2")


def read(dataset):
    """The dataset by its format alone."""
    done = subprocess.run(
        [sys.executable, str(READER), str(dataset)], capture_output=True, text=True, timeout=60
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def test_a_complete_trial_is_reported(first):
    assert {"trial", "success", "score", "duration_s", "episode", "frames", "control"} <= set(first)
    assert first["success"] is True
    assert first["score"] == 1.0
    assert first["control"]["rate"] == 30.0
    assert min(first["control"]["ticks"], first["frames"]) > 150
    assert first["duration_s"] > 5


def test_its_episode_says_what_was_tried_by_whom_and_where(first, folder):
    episode = folder / "data" / "episodes" / first["episode"]
    manifest = json.loads((episode / "manifest.json").read_text())
    assert manifest["trial"]["id"] == first["trial"]
    assert (manifest["trial"]["scene"], manifest["trial"]["position"]) == ("block-on-plate", 1)
    assert manifest["checkpoint"]["name"] == "pick-place-40k"
    assert manifest["bench"]["seed"] == 1
    assert manifest["bench"]["positions"]["block"] == [-0.14, 0.26, 0]
    assert manifest["operator"] == "operator"
    outcome = json.loads((episode / "outcome.json").read_text())
    assert (outcome["status"], outcome["frames"]) == ("finished", first["frames"])
    assert (
        outcome["duration_s"] == first["duration_s"]
    )  # of the recording, to the frame; what was held left out


def test_its_score_is_on_the_disk_before_any_database(first, folder):
    lines = (folder / "data" / "scores" / f"{first['episode']}.jsonl").read_text().splitlines()
    assert len(lines) == 1
    score = json.loads(lines[0])
    assert (score["kind"], score["success"], score["score"]) == ("score", True, 1.0)
    assert score["source"] == "truth"
    assert [milestone["reached"] for milestone in score["milestones"]] == [True] * 4


def test_a_taken_port_is_named_and_its_holder_lives(folder):
    with socket.create_server(("127.0.0.1", 0)) as holder:
        port = holder.getsockname()[1]
        done = subprocess.run(
            [*MANAGE, "--port", str(port)],
            cwd=ROOT,
            env=environment(folder / "elsewhere"),
            capture_output=True,
            text=True,
            timeout=60,
        )
        assert done.returncode not in (0, None)
        assert f"127.0.0.1:{port}" in done.stderr
        assert "--port" in done.stderr
        assert "Traceback" not in done.stderr
        with socket.create_connection(("127.0.0.1", port), 5) as call:
            answer, _ = holder.accept()
            answer.close()
            assert call.recv(1) == b""


def test_another_trial_on_the_same_data_comes_after_the_first(first, second, folder):
    assert second["trial"] > first["trial"]
    assert second["dataset"] == first["dataset"]
    assert (first["dataset_index"], second["dataset_index"]) == (0, 1)
    for result in (first, second):
        assert Path(folder, "data", "episodes", result["episode"], "outcome.json").exists()


def test_a_second_process_that_knows_only_the_format_reads_both(first, second, folder):
    found = read(folder / "data" / first["dataset"])
    assert found["broken"] == []
    assert [episode["length"] for episode in found["episodes"]] == [first["frames"], second["frames"]]
    for episode in found["episodes"]:
        assert episode["tasks"] == ["put the block on the plate"]
        for brightness in episode["brightness"].values():
            assert len(brightness) == episode["length"]
            assert min(brightness) > 10
