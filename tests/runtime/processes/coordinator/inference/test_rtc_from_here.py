"""Rows that are not absolute are continued from the observation that is asked about, as the answer will be."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from robots import load_robot
from runtime.core.pose_format import PoseFormat
from runtime.core.types import ActionChunk, Conditioning, Observation
from runtime.ipc.messages import MergeResult
from runtime.kinematics.compiled import CompiledKinematics
from runtime.motion.timeline import DimensionKinds
from runtime.processes.coordinator.inference.chunk_mixture import Mixture
from runtime.processes.coordinator.inference.rtc_prefix import RtcPrefix
from runtime.spaces.conversion import ActionSpaces
from runtime.spaces.pose_rows import PoseRows

RATE, COUNT, SINCE = 30.0, 40, 9
ROBOT = load_robot("agilex_piper")
SPACES = ActionSpaces(ROBOT, CompiledKinematics(ROBOT), RATE)
START = np.asarray(ROBOT.poses["ready"], np.float32)
MEASURED = SPACES.eef_of(START) + np.tile([0.004, -0.003, 0.002, 0, 0, 0, 0, 0], 2).astype(np.float32)
FORMS: list[dict[str, Any]] = [
    {"space": "joint"},
    {"space": "eef"},
    {"space": "eef", "frame": "tool"},
    {"space": "eef", "pose": PoseFormat(orientation="rotation_vector", frame=ROBOT.mount_frame)},
    {"space": "eef", "frame": "tool", "pose": PoseFormat(orientation="euler")},
]


def seen(step: int, qpos: np.ndarray, eef: np.ndarray | None = None) -> Observation:
    return Observation(step, 0.0, {}, np.asarray(qpos, np.float32), {}, eef=eef, step=step)


def answer(mode: Any, rate: float | None, seed: int, **form: Any) -> ActionChunk:
    """Rows that move all arms a little, each by other numbers."""
    numbers = np.random.default_rng(seed)

    def steps(*shape: int) -> np.ndarray:
        made = numbers.uniform(0.0003, 0.001, shape) + numbers.uniform(-0.0003, 0.0003, (COUNT, *shape))
        return made if mode == "delta" else made.cumsum(axis=0)

    if form["space"] == "joint":
        rows, still = 5.0 * steps(ROBOT.dim), list(ROBOT.gripper_dims)
    else:
        vectors = np.zeros((COUNT, 2, 8))
        vectors[..., :3], vectors[..., 3], vectors[..., 4:7] = steps(2, 3), 1.0, steps(2, 3)
        vectors[..., 3:7] /= np.linalg.norm(vectors[..., 3:7], axis=-1, keepdims=True)
        rows = PoseRows(form.get("pose") or PoseFormat(), ROBOT).written(vectors, np.zeros((COUNT, 0)))
        still = [rows.shape[1] // 2 - 1, rows.shape[1] - 1]
    rows[:, still] = np.linspace(0.02, 0.06, COUNT)[:, None]
    return ActionChunk(rows.astype(np.float32), mode=mode, rate=rate, **form)


def merged(number: int, step: int, delay: int, count: int, shares: Any = ()) -> MergeResult:
    told = np.array(shares, np.float64).reshape(-1, 3)
    return MergeResult(number, step + delay, delay, step + np.arange(count), run=1, contributions=told)


def prefix() -> RtcPrefix:
    return RtcPrefix(RATE, Mixture(DimensionKinds(), ROBOT))


def continued(
    held: RtcPrefix, observation: Observation, like: ActionChunk
) -> tuple[Conditioning, np.ndarray]:
    """What the policy is told, and the joints that it comes to where an answer of just these rows is executed."""
    found = held.conditioning(observation.step, [3], 0.9, None, observation)
    assert found is not None
    again = replace(like, actions=found.remaining_rows)
    eef = observation.eef if observation.eef is not None else SPACES.eef_of(observation.qpos)
    return found, SPACES.to_command(again, replace(observation, eef=eef)).rows


@pytest.mark.parametrize("rate", [None, 15.0])
@pytest.mark.parametrize("lag", [0.0, 0.05])
@pytest.mark.parametrize("mode", ["delta", "relative"])
@pytest.mark.parametrize("form", FORMS, ids=str)
def test_an_answer_of_just_the_rows_told_is_what_is_planned(
    form: dict[str, Any], mode: str, lag: float, rate: float | None
) -> None:
    chunk = answer(mode, rate, 1, **form)
    planned = SPACES.to_command(chunk, seen(100, START)).rows
    held = prefix()
    held.add_chunk(1, chunk, 100, commands=planned)
    held.on_merged(merged(1, 100, 3, len(planned)))
    since = SINCE if rate is None else SINCE - 1  # a row of its own rate is at each second step
    found, again = continued(held, seen(100 + since, planned[since] - lag), chunk)
    assert found.consumed_rows == (since if rate is None else since // 2)
    length = len(planned) - since - 2
    np.testing.assert_allclose(again[:length], planned[since:][:length], atol=1e-3)


@pytest.mark.parametrize("form", FORMS[:3], ids=str)
@pytest.mark.parametrize("mode", ["delta", "relative"])
def test_of_a_blend_the_rows_told_are_those_of_the_blended_joints(form: dict[str, Any], mode: str) -> None:
    chunks = [answer(mode, None, seed, **form) for seed in (1, 2)]
    plans = [SPACES.to_command(chunk, seen(100, START)).rows for chunk in chunks]
    held = prefix()
    for number, (chunk, plan) in enumerate(zip(chunks, plans, strict=True), 1):
        held.add_chunk(number, chunk, 100, commands=plan)
        told = [[step, 1, 0.5] for step in range(108, 120)] + [[step, 2, 0.5] for step in range(108, 120)]
        held.on_merged(merged(number, 100, 3 + number, len(plan), told if number == 2 else ()))
    between = np.concatenate([(plans[0] + plans[1])[8:20] / 2, plans[1][20:]])
    _, again = continued(held, seen(108, between[0] + 0.02), chunks[1])
    np.testing.assert_allclose(again, between, atol=1e-3)


@pytest.mark.parametrize("mode", ["delta", "relative"])
@pytest.mark.parametrize("cut", ["horizon", "refused"])
def test_what_is_not_planned_is_not_said(mode: str, cut: str) -> None:
    """Rows beyond the horizon, and those that were refused, are of the old observation."""
    chunk = answer(mode, None, 1, space="joint")
    planned = SPACES.to_command(chunk, seen(100, START)).rows[: 20 if cut == "refused" else None]
    held = prefix()
    held.add_chunk(1, chunk, 100, commands=planned)
    held.on_merged(merged(1, 100, 3, 20))
    found, again = continued(held, seen(106, planned[6] - 0.05), chunk)
    assert found.execution_horizon == 14
    assert len(found.remaining_rows) == COUNT - 6  # a server may want as many
    np.testing.assert_allclose(again[:14], planned[6:20], atol=1e-6)
    if mode == "relative":
        np.testing.assert_array_equal(
            found.remaining_rows[14:], np.tile(found.remaining_rows[13], (COUNT - 20, 1))
        )


def test_absolute_rows_that_were_refused_are_not_said_either() -> None:
    chunk = ActionChunk(np.tile(np.arange(COUNT, dtype=np.float32)[:, None], 14))
    held = prefix()
    held.add_chunk(1, chunk, 100, commands=chunk.actions[:20].astype(np.float64))
    held.on_merged(merged(1, 100, 3, 20))
    found = held.conditioning(106, [3], 0.9, None, seen(106, START))
    assert found is not None
    assert found.execution_horizon == 20
    np.testing.assert_array_equal(found.previous[:, 0], [*range(20), *[19] * (COUNT - 20)])


def test_poses_are_relative_to_those_that_the_policy_is_shown() -> None:
    chunk = answer("relative", None, 1, space="eef")
    planned = SPACES.to_command(chunk, seen(100, START)).rows
    held = prefix()
    held.add_chunk(1, chunk, 100, commands=planned)
    held.on_merged(merged(1, 100, 3, len(planned)))
    _, again = continued(held, seen(105, START, MEASURED), chunk)
    np.testing.assert_allclose(again, planned[5:], atol=1e-3)


@pytest.mark.parametrize("changes", [{"mode": "delta"}, {"mode": "relative"}, {"model_relative": True}])
def test_the_models_own_rows_are_not_handed_back_where_they_would_mean_something_else(
    changes: dict[str, Any],
) -> None:
    chunk = ActionChunk(np.zeros((COUNT, 14), np.float32), model_actions=np.ones((COUNT, 32), np.float32))
    held = prefix()
    held.add_chunk(1, replace(chunk, **changes), 100)
    held.on_merged(merged(1, 100, 3, COUNT))
    assert held.conditioning(110, [3], 0.9, None, seen(110, START)) is None
    assert "the model's own rows are relative to an earlier observation" in held.warning
