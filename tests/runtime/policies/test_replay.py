from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from runtime.core.clock import VirtualClock
from runtime.core.errors import PolicyError
from runtime.core.pose_format import PoseFormat
from runtime.core.types import Observation
from runtime.datasets.finished_episode import read_finished_episode
from runtime.datasets.mapping import ColumnMapping
from runtime.policies import replay
from runtime.policies.replay import Config, ReplayPolicy
from runtime.recording.archive_index import write_index
from tests.runtime.datasets.foreign import Plan, column, write
from tests.runtime.datasets.small import record, robot, write_dataset
from tests.runtime.recording.samples import resealed

FRAMES, FPS = 12, 10.0


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("dataset")
    write_dataset(root, lengths=(FRAMES,), fps=FPS, cameras=())
    return root


@pytest.fixture(scope="module")
def actions(tmp_path_factory: pytest.TempPathFactory) -> np.ndarray:
    return write_dataset(tmp_path_factory.mktemp("same"), lengths=(FRAMES,), fps=FPS, cameras=())[0]["action"]


def observation(step: int) -> Observation:
    return Observation(
        sequence=step, arrived=0.0, captured={}, qpos=np.zeros(6, np.float32), pictures={}, step=step
    )


def connected(
    root: Path, rate: float = FPS, clock: VirtualClock | None = None, **options: Any
) -> ReplayPolicy:
    policy = replay.build(Config(path=str(root), **options), robot(), clock or VirtualClock(), rate)
    policy.connect()
    return policy


def test_the_rows_are_exactly_those_recorded(root: Path, actions: np.ndarray) -> None:
    policy = connected(root, horizon=5)
    chunk = policy.infer(observation(0))
    assert chunk.actions.dtype == np.float32
    assert np.array_equal(chunk.actions, actions[:5])
    assert (chunk.space, chunk.rate) == ("joint", FPS)


def test_the_first_observation_after_a_reset_has_row_0(root: Path, actions: np.ndarray) -> None:
    policy = connected(root, horizon=2)
    assert np.array_equal(policy.infer(observation(40)).actions, actions[:2])
    assert np.array_equal(policy.infer(observation(43)).actions, actions[3:5])
    policy.reset()
    assert np.array_equal(policy.infer(observation(44)).actions, actions[:2])


@given(step=st.integers(0, 200), rate=st.sampled_from([10.0, 20.0, 30.0, 50.0, 100.0]))
def test_steps_of_another_rate_find_the_row_of_their_time(
    root: Path, actions: np.ndarray, step: int, rate: float
) -> None:
    policy = connected(root, rate=rate, horizon=1)
    policy.infer(observation(0))
    row = min(round(step * FPS / rate), FRAMES - 1)
    assert np.array_equal(policy.infer(observation(step)).actions, actions[row : row + 1])


def test_beyond_the_end_chunks_hold_the_last_row(root: Path, actions: np.ndarray) -> None:
    policy = connected(root, horizon=5)
    policy.infer(observation(0))
    held = np.repeat(actions[-1:], 5, axis=0)
    assert np.array_equal(policy.infer(observation(9)).actions, np.concatenate([actions[9:], held])[:5])
    assert np.array_equal(policy.infer(observation(11)).actions, held)
    assert np.array_equal(policy.infer(observation(500)).actions, held)


def test_whoever_changes_a_chunk_does_not_change_the_recording(root: Path, actions: np.ndarray) -> None:
    policy = connected(root, horizon=FRAMES)
    policy.infer(observation(0)).actions[:] = 0
    assert np.array_equal(policy.infer(observation(0)).actions, actions)


def test_the_latency_is_waited_for_on_the_clock(root: Path) -> None:
    clock = VirtualClock(7.0)
    policy = connected(root, clock=clock, latency_s=0.25)
    policy.infer(observation(0))
    assert clock.now() == 7.25


def test_poses_are_replayed_where_the_space_says_so(root: Path) -> None:
    policy = connected(root, space="eef", mapping=ColumnMapping(action_eef="action_eef"), horizon=3)
    chunk = policy.infer(observation(0))
    assert (chunk.space, chunk.actions.shape, chunk.pose) == ("eef", (3, 16), PoseFormat())


def test_poses_of_another_width_are_those_of_another_format(root: Path) -> None:
    poses = {"space": "eef", "mapping": ColumnMapping(action_eef="action_eef")}
    with pytest.raises(PolicyError, match="action_eef column is 16 wide, small needs 18"):
        connected(root, **poses, action_pose=PoseFormat(orientation="6d", gripper=False))
    pose = PoseFormat(orientation="euler", euler_order="ZYX", degrees=True, groups=[])
    with pytest.raises(PolicyError, match="small needs 14"):
        connected(root, **poses, action_pose=pose)


def test_it_says_what_it_is(root: Path) -> None:
    policy = replay.build(Config(path=str(root), horizon=4), robot(), VirtualClock(), FPS)
    info = policy.connect()
    assert (info.action_space, info.horizon, info.metadata["rows"]) == ("joint", 4, FRAMES)


@pytest.mark.parametrize(
    ("options", "bench", "named"),
    [
        ({"episode": 3}, robot(), "no episode 3"),
        ({"mapping": ColumnMapping(action="command")}, robot(), "'command'.*observation.state"),
        ({"mapping": ColumnMapping(action="")}, robot(), "mapping.action names no column"),
        ({"space": "eef"}, robot(), "mapping.action_eef names no column"),
        ({}, robot(dim=7), "6 wide, small needs 7"),
    ],
)
def test_what_does_not_fit_is_refused_at_connect(
    root: Path, options: dict[str, Any], bench: Any, named: str
) -> None:
    policy = replay.build(Config(path=str(root), **options), bench, VirtualClock(), FPS)
    with pytest.raises(PolicyError, match=named):
        policy.connect()


def test_an_observation_from_before_the_reset_is_refused(root: Path) -> None:
    policy = connected(root)
    policy.infer(observation(10))
    with pytest.raises(PolicyError, match="step 4, before the first one since the reset"):
        policy.infer(observation(4))


def test_it_answers_only_while_it_is_connected(root: Path) -> None:
    policy = connected(root)
    policy.close()
    policy.close()
    with pytest.raises(PolicyError, match="not connected"):
        policy.infer(observation(0))


@pytest.mark.parametrize("version", ["v2.0", "v2.1", "v3.0"])
def test_every_version_is_replayed(tmp_path: Path, version: str) -> None:
    plan = Plan(version)
    write(tmp_path / "set", plan)
    policy = connected(tmp_path / "set", rate=plan.fps, episode=1, horizon=plan.lengths[1])
    assert np.array_equal(policy.infer(observation(0)).actions, column(1, "action", plan.lengths[1]))


def test_only_the_column_of_the_actions_has_to_be_there(tmp_path: Path) -> None:
    rows = write_dataset(tmp_path, fps=FPS, cameras=(), names={"observation.state": "joints"})[0]
    policy = connected(tmp_path, horizon=3)
    assert np.array_equal(policy.infer(observation(0)).actions, rows["action"][:3])


# --- after a hold ------------------------------------------------------------------------------------------


def held_at(qpos: np.ndarray, step: int) -> Observation:
    return Observation(sequence=step, arrived=0.0, captured={}, qpos=qpos, pictures={}, step=step)


def test_after_a_hold_it_goes_on_where_the_robot_was_held(root: Path, actions: np.ndarray) -> None:
    policy = connected(root, horizon=5)
    policy.infer(observation(0))
    policy.infer(observation(3))
    policy.resume()
    assert np.array_equal(policy.infer(held_at(actions[5], 70)).actions, actions[5:10])
    assert np.array_equal(policy.infer(held_at(actions[6], 71)).actions, actions[6:11])


def test_without_a_hold_a_late_question_finds_the_row_of_its_time(root: Path, actions: np.ndarray) -> None:
    policy = connected(root, horizon=2)
    policy.infer(observation(0))
    assert np.array_equal(policy.infer(held_at(actions[1], 9)).actions, actions[9:11])


def test_a_hold_before_a_new_run_is_forgotten(root: Path, actions: np.ndarray) -> None:
    policy = connected(root, horizon=2)
    policy.infer(observation(4))
    policy.resume()
    policy.reset()
    assert np.array_equal(policy.infer(held_at(actions[7], 50)).actions, actions[:2])


# --- a recording of ours -----------------------------------------------------------------------------------


def test_a_recorded_episode_is_replayed_without_a_dataset(tmp_path: Path) -> None:
    episode = record(tmp_path / "episodes", frames=FRAMES)
    policy = replay.build(Config(path=str(episode), horizon=3), robot(), VirtualClock(), FPS)
    info = policy.connect()
    assert info.name == f"replay of {episode}"
    assert np.array_equal(
        policy.infer(observation(0)).actions, read_finished_episode(episode).vectors("action")[:3]
    )


def test_a_recorded_episode_has_no_further_ones(tmp_path: Path) -> None:
    episode = record(tmp_path / "episodes", frames=FRAMES)
    policy = replay.build(Config(path=str(episode), episode=1), robot(), VirtualClock(), FPS)
    with pytest.raises(PolicyError, match=r"policy\.episode = 1, .*allowed: 0"):
        policy.connect()


@pytest.mark.parametrize("other", ["ur5e", "metaworld"])  # one that is shipped, and one of a bench
def test_the_actions_of_another_robot_are_refused(tmp_path: Path, other: str) -> None:
    episode = record(tmp_path / "episodes", frames=FRAMES)
    manifest = json.loads((episode / "manifest.json").read_text())
    manifest["robot"]["name"] = other
    (episode / "manifest.json").write_text(json.dumps(manifest))
    resealed(episode)
    policy = replay.build(Config(path=str(episode)), robot(), VirtualClock(), FPS)
    with pytest.raises(PolicyError, match=f"is of the robot {other}, the station's is small"):
        policy.connect()


def test_the_same_joints_in_another_order_are_refused(tmp_path: Path) -> None:
    episode = record(tmp_path / "episodes", frames=FRAMES)
    manifest = json.loads((episode / "manifest.json").read_text())
    manifest["robot"]["joint_names"].reverse()
    (episode / "manifest.json").write_text(json.dumps(manifest))
    resealed(episode)
    policy = replay.build(Config(path=str(episode)), robot(), VirtualClock(), FPS)
    with pytest.raises(PolicyError, match="the actions are of the joints"):
        policy.connect()


def test_a_recording_whose_videos_are_in_the_labs_store_is_replayed(tmp_path: Path) -> None:
    episode = record(tmp_path / "episodes", frames=FRAMES)
    rows = connected(episode, horizon=5).infer(observation(0)).actions
    videos = {path.name: "0" * 64 for path in episode.glob("*.mp4")}
    write_index(tmp_path, episode.name, videos)
    for name in videos:
        (episode / name).unlink()
    assert videos
    assert np.array_equal(connected(episode, horizon=5).infer(observation(0)).actions, rows)
