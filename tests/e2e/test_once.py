"""One trial by command, as the README has it, and then a blind plan on the same data: what each leaves on the disk."""

import json
import socket
import sqlite3
import subprocess
import sys
from contextlib import closing, contextmanager

import pytest

from tests import migrated
from tests.e2e.conftest import SETS
from tests.e2e.lab import ROOT, environment
from tests.processes import PATIENCE_S, eventually

pytestmark = pytest.mark.slow
READER = ROOT / "tests" / "conformance" / "read_lerobot_v21.py"
MANAGE = [sys.executable, "manage.py", "demo"]


PLACES = """
SELECT episode.dataset, episode.dataset_index, episode.frames FROM trials_trial AS trial
JOIN episodes_episode AS episode ON episode.uuid = trial.episode_id WHERE trial.id IN (?, ?) ORDER BY trial.id
"""


def run(folder, *options):
    """Run the command to its end; what it wrote as its result, and how it ended."""
    out, data = folder / "out.json", folder / "data"
    if not data.exists():
        migrated.copy(data)
    done = subprocess.run(
        [*MANAGE, "--json", str(out), "--port", "0", *options],
        cwd=ROOT,
        env=environment(folder / "data"),
        capture_output=True,
        text=True,
        timeout=6 * PATIENCE_S,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return json.loads(out.read_text()), done


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("once")


@pytest.fixture(scope="module")
def first(folder):
    """One trial in a home that has nothing; a slow machine holds no robot of it, or a newcomer resumes."""
    found, done = run(folder, "--once", *SETS[1:])
    assert json.loads(done.stdout) == found
    return found


@pytest.fixture(scope="module")
def evaluated(folder, first):
    """Two trials of a blind plan on the same data, and what was said of them."""
    return run(folder, "--evaluate", "2", *SETS[1:])


@pytest.fixture(scope="module")
def places(folder, evaluated):
    """Where the episodes of the blind trials are: dataset, index, and how many frames they have.

    Whatever waited when the command ended is done by the next worker.
    """
    trials = [trial["trial"] for trial in evaluated[0]["trials"]]

    def published():
        with closing(sqlite3.connect(folder / "data" / "eva.sqlite3")) as database:
            found = database.execute(PLACES, trials).fetchall()
        return None if None in [index for _, index, _ in found] else found

    with working(folder):
        return eventually(published, "the episodes are in a dataset", 3 * PATIENCE_S)


@contextmanager
def working(folder):
    """A worker on that data, without a lab."""
    line = [sys.executable, "manage.py", "worker", "--lifeline"]
    with subprocess.Popen(line, cwd=ROOT, env=environment(folder / "data"), stdin=subprocess.PIPE) as worker:
        yield
        worker.stdin.close()


def read(dataset):
    """The dataset by its format alone."""
    done = subprocess.run(
        [sys.executable, str(READER), str(dataset)], capture_output=True, text=True, timeout=PATIENCE_S
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


@pytest.mark.story
def test_a_complete_trial_is_reported(first):
    assert {"trial", "success", "score", "duration_s", "episode", "frames", "control"} <= set(first)
    assert first["success"] is True
    assert first["score"] == 1.0
    assert first["control"]["rate"] == 30.0
    assert min(first["control"]["ticks"], first["frames"]) > 150
    assert first["duration_s"] > 5


@pytest.mark.story
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


@pytest.mark.story
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
            timeout=PATIENCE_S,
        )
        assert done.returncode not in (0, None)
        assert f"127.0.0.1:{port}" in done.stderr
        assert "--port" in done.stderr
        assert "Traceback" not in done.stderr
        with socket.create_connection(("127.0.0.1", port), PATIENCE_S) as call:
            answer, _ = holder.accept()
            answer.close()
            assert call.recv(1) == b""


def test_two_blind_trials_are_made_revealed_and_compared(evaluated):
    found, done = evaluated
    trials = found["trials"]
    assert {trial["checkpoint"] for trial in trials} == {
        "pick-place-40k-by-script",
        "pick-place-8k-by-script",
    }
    assert len({trial["code"] for trial in trials}) == 2
    assert len({trial["position"] for trial in trials}) == 1  # one block: the same condition for both
    assert found["lockstep"] is True
    for trial in trials:  # its own time: whole ticks of 30 Hz, and nothing was reached after its end
        assert trial["duration_s"] * 30 == pytest.approx(round(trial["duration_s"] * 30), abs=1e-6)
        assert all(0 < at <= trial["duration_s"] for at in trial["times"].values())
        assert trial["success"] == ("placed" in trial["times"])
    assert found["commitment"] in done.stderr
    assert len(bytes.fromhex(found["key"])) == 32
    assert [arm["success"]["n"] for arm in found["analysis"]["arms"]] == [1, 1]
    assert "difference" in done.stdout
    assert found["headline"] in done.stdout  # the design's own, of a plan that was closed before it ended
    assert "were not compared: closed after 1 of 4 pairs" in found["headline"]
    assert not any(trial["checkpoint"] in done.stderr for trial in trials)


def test_other_trials_on_the_same_data_come_after_the_first(first, evaluated, places, folder):
    assert min(trial["trial"] for trial in evaluated[0]["trials"]) > first["trial"]
    assert [dataset for dataset, _, _ in places] == [first["dataset"]] * 2
    assert [first["dataset_index"], *sorted(index for _, index, _ in places)] == [0, 1, 2]
    outcomes = (folder / "data" / "episodes").glob("*/outcome.json")
    assert len(list(outcomes)) == 3


@pytest.mark.story
def test_a_second_process_that_knows_only_the_format_reads_it(first, folder):
    assert_whole(folder / "data" / first["dataset"], {first["dataset_index"]: first["frames"]})


def test_and_so_it_does_with_the_others_behind_it(first, places, folder):
    lengths = {first["dataset_index"]: first["frames"]} | {index: frames for _, index, frames in places}
    assert_whole(folder / "data" / first["dataset"], lengths)


def assert_whole(dataset, lengths):
    """The episodes of these lengths by index are all there, each with its task and pictures that show something."""
    found = read(dataset)
    assert found["broken"] == []
    assert [episode["length"] for episode in found["episodes"]] == [lengths[at] for at in sorted(lengths)]
    assert sorted(lengths) == list(range(len(lengths)))
    for episode in found["episodes"]:
        assert episode["tasks"] == ["put the block on the plate"]
        for brightness in episode["brightness"].values():
            assert len(brightness) == episode["length"]
            assert min(brightness) > 10
