"""The README's first command, as a user runs it, and the dataset it leaves, read by the format alone."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from runtime.recording.reader import open_episode
from tests.processes import PATIENCE_S

ROOT = Path(__file__).parents[2]
READER = ROOT / "tests" / "conformance" / "read_lerobot_v21.py"

pytestmark = pytest.mark.slow
# What holds a robot on a slow machine is asked elsewhere; here a whole run has to come about.
PATIENCE = (
    "control.heartbeat_timeout_s=10",
    "control.coordinator_timeout_s=10",
    "control.starvation_hold_s=10",
    "recording.heartbeat_timeout_s=20",
    "safety.following_error=3",
    "safety.joint_age_s=5",
    "safety.picture_age_s=10",
)


@pytest.fixture(scope="module")
def demo(tmp_path_factory):
    folder = tmp_path_factory.mktemp("demo")
    sets = [part for one in PATIENCE for part in ("--set", one)]
    done = subprocess.run(
        [sys.executable, "-m", "runtime.standins.demo", "--once", "--json", str(folder / "out.json"), *sets],
        cwd=ROOT,
        env={**os.environ, "EVA_DATA_DIR": str(folder / "data")},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done, json.loads((folder / "out.json").read_text())


def test_the_demo_says_where_the_episode_lies_and_how_it_went(demo):
    done, result = demo
    assert result["episode_status"] == "finished"
    assert result["frames"] >= 236  # 8 s at 30 fps; the end is decided between two ticks
    assert result["published_frames"] == result["frames"]
    assert Path(result["episode_path"], "outcome.json").exists()
    assert result["control"]["rate"] == 30.0
    assert result["control"]["ticks"] > result["frames"]
    assert result["safety"]["refused"] == 0
    assert result["policy"]["answers"] > 3
    assert result["episode_path"] in done.stdout
    assert result["dataset_path"] in done.stdout


def test_the_arm_has_moved_and_its_pictures_with_it(demo):
    episode = open_episode(Path(demo[1]["episode_path"]))
    qpos = episode.rows["qpos"].to_pylist()
    spans = [max(column) - min(column) for column in zip(*qpos, strict=True)]
    assert max(spans) > 0.2
    assert set(episode.rows["control_source"].to_pylist()) >= {"policy"}
    assert sorted(episode.videos) == ["cam_high", "cam_left_wrist", "cam_right_wrist"]


def test_a_second_process_that_knows_only_the_format_agrees(demo):
    result = demo[1]
    read = subprocess.run(
        [sys.executable, str(READER), result["dataset_path"]],
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
    )
    assert read.returncode == 0, read.stderr
    found = json.loads(read.stdout)
    assert found["broken"] == []
    assert found["total_frames"] == result["published_frames"] == result["frames"]
    assert found["policy_outputs"] == ["action"]
    rows = open_episode(Path(result["episode_path"])).rows
    published = found["episodes"][result["episode_index"]]
    for column, ours in (("observation.state", "qpos"), ("action", "action"), ("eef_state", "eef")):
        assert published["sums"][column] == pytest.approx(sum(map(sum, rows[ours].to_pylist())), rel=1e-6)
    assert [len(frames) for frames in published["brightness"].values()] == [result["frames"]] * 3
