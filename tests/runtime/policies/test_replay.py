from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from runtime.clock import VirtualClock
from runtime.datasets.mapping import ColumnMapping
from runtime.errors import PolicyError
from runtime.policies import replay
from runtime.policies.replay import Config, ReplayPolicy
from runtime.pose_format import PoseFormat
from runtime.types import Observation
from tests.runtime.datasets.small import robot, write_dataset

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
@settings(deadline=None)
def test_steps_of_another_rate_find_the_row_of_their_time(
    root: Path, actions: np.ndarray, step: int, rate: float
) -> None:
    policy = connected(root, rate=rate, horizon=1)
    policy.infer(observation(0))
    row = min(round(step * FPS / rate), FRAMES - 1)
    assert np.array_equal(policy.infer(observation(step)).actions, actions[row : row + 1])


def test_chunks_get_shorter_at_the_end_and_then_hold_the_last_row(root: Path, actions: np.ndarray) -> None:
    policy = connected(root, horizon=5)
    policy.infer(observation(0))
    assert np.array_equal(policy.infer(observation(9)).actions, actions[9:])
    assert np.array_equal(policy.infer(observation(11)).actions, actions[11:])
    assert np.array_equal(policy.infer(observation(500)).actions, actions[-1:])


def test_whoever_changes_a_chunk_does_not_change_the_recording(root: Path, actions: np.ndarray) -> None:
    policy = connected(root)
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
