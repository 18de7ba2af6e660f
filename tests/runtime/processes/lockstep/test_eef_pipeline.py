"""Whole stations in lockstep: joints seen, poses answered, joints commanded, and what is recorded of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from runtime.config import loader
from runtime.core.pose_format import PoseFormat
from runtime.core.types import ActionChunk, ActionMode, Conditioning, Float64, Observation
from runtime.ipc.session_state import SessionState
from runtime.kinematics.base import IkFlag
from runtime.processes.coordinator.builders import make_kinematics
from runtime.spaces.conversion import ActionSpaces
from runtime.spaces.pose_rows import PoseRows
from runtime.spaces.relative_poses import to_absolute
from runtime.transports.base import Capabilities
from tests.runtime.lockstep_station import MOVED, STANDS, Station, column, on_time, ramp, stubbed

SIX = PoseFormat(orientation="6d", gripper=False)
EULER = PoseFormat(orientation="euler", euler_order="ZYX", degrees=True, frame="world")
Rows = Callable[[Observation, int], Float64]


def reversed_offsets(vectors: Float64, start: Float64, mode: ActionMode) -> Float64:
    """What absolute vectors [T, arms, 8] are from `start` along the base: the inverse of `poses.absolute`."""
    if mode == "absolute":
        return vectors
    made, before = vectors.copy(), start
    for row, wanted in zip(made, vectors, strict=True):
        turned = to_absolute(_inverse(before)[None], wanted, "relative", "tool")[0]
        row[:, :3] = wanted[:, :3] - before[:, :3]
        row[:, 3:7] = turned[:, 3:7]
        before = start if mode == "relative" else wanted
    return made


def _inverse(vectors: Float64) -> Float64:
    made = vectors.copy()
    made[..., 4:7] *= -1.0
    return made


def speaking(station: Station, rows: Rows, pose: PoseFormat, mode: ActionMode = "absolute") -> Station:
    """The station's policy, answering with joint rows as poses of that format, relative to what it is shown."""
    robot, spaces = station.spec.robot, station.coordinator.spaces
    layout = PoseRows(pose, robot)
    numbers = PoseRows(pose.model_copy(update={"frame": ""}), robot)

    def infer(observation: Observation, conditioning: Conditioning | None = None) -> ActionChunk:
        if station.policy.first is None:
            station.policy.first = observation.step
        at = observation.qpos.astype(np.float64)[None]
        shifted = replace(observation, step=observation.step - station.policy.first)
        vectors = layout.frame.express(spaces.vectors(np.asarray(rows(shifted, 0), np.float64)), at)
        assert observation.eef is not None
        seen = layout.frame.express(observation.eef.astype(np.float64).reshape(1, 2, 8), at)[0]
        written = numbers.encode(reversed_offsets(vectors, seen, mode), at)
        return ActionChunk(written.astype(np.float32), space="eef", mode=mode, pose=pose)

    station.policy.infer = infer  # type: ignore[method-assign]
    return station


@pytest.mark.some(1)
@pytest.mark.parametrize("delay", [0, 3])
@pytest.mark.parametrize("mode", ["absolute", "relative", "delta"])
@pytest.mark.parametrize("pose", [SIX, EULER], ids=str)
def test_poses_of_any_format_and_mode_move_the_joints_as_they_are_meant(
    tmp_path: Path, pose: PoseFormat, mode: ActionMode, delay: int
) -> None:
    station = speaking(Station(stubbed(tmp_path, delay=delay)), on_time, pose, mode).running(60)
    episode = station.stop()
    chosen = column(episode.ticks, "control_source") == "policy"
    steps = column(episode.ticks, "step")[chosen] - episode.ticks["step"][0].as_py()
    meant = ramp(0, steps[-1] + 1)[steps]
    np.testing.assert_allclose(column(episode.ticks, "executed")[chosen][8:], meant[8:], atol=2e-3)
    assert not any(column(episode.ticks, "refused"))
    assert station.events("ik_unreached") == []
    raw = episode.raw.to_pylist()
    assert {len(row["action"]) for row in raw} == {PoseRows(pose, station.spec.robot).width}
    assert {row["space"] for row in raw} == {"eef"}
    flags = np.array([row["ik_flags"] for row in raw])
    assert flags.shape == (len(raw), 2)
    assert not (flags & IkFlag.OVER_TOLERANCE).any()
    assert np.array([row["ik_position_error"] for row in raw]).max() < 1e-3
    station.close()


def stretching(station: Station) -> Station:
    """The tenth row of each answer, and all that follow, are far out of reach."""
    speaking(station, on_time, PoseFormat())
    infer = station.policy.infer

    def stretched(observation: Observation, conditioning: Conditioning | None = None) -> ActionChunk:
        chunk = infer(observation)
        chunk.actions[10:, 8] += 1.0  # the right arm's x
        return chunk

    station.policy.infer = stretched  # type: ignore[method-assign]
    return station


def test_poses_out_of_reach_are_not_driven_to(tmp_path: Path) -> None:
    station = stretching(Station(stubbed(tmp_path))).running(40)
    episode = station.stop()
    assert "row 10 of the answer is a pose of right_arm" in station.events("poses_refused")[-1]
    assert "the 10 rows before it are executed" in station.events("poses_refused")[-1]
    raw = episode.raw.to_pylist()
    assert {row["target_step"] >= 0 for row in raw if row["index"] < 10} >= {True}
    assert {row["target_step"] for row in raw if row["index"] >= 10} == {-1}
    assert np.nanmax([row["ik_position_error"][1] for row in raw if row["index"] < 10]) < 0.001
    station.close()


def test_poses_out_of_reach_may_be_executed_as_near_as_can_be_and_are_recorded_as_missed(
    tmp_path: Path,
) -> None:
    station = stretching(Station(stubbed(tmp_path, safety={"missed_pose": "flag"}))).running(40)
    shown = station.coordinator.snapshot()["policy"]["ik"]
    assert shown["over"] == 10
    assert shown["worst_mm"] > 300
    assert shown["rows"] == 20
    assert station.coordinator.inference.shown is not None
    assert station.coordinator.inference.shown.ik["over"] == 10
    episode = station.stop()
    assert "10 of 20 poses are not reached, the worst by" in station.events("ik_unreached")[-1]
    raw = episode.raw.to_pylist()
    missed = [[flag & IkFlag.OVER_TOLERANCE for flag in row["ik_flags"]] for row in raw]
    assert missed == [[0, int(row["index"] >= 10)] for row in raw]
    assert max(row["ik_position_error"][1] for row in raw) > 0.3
    sent, robot = station.robot.sent, station.spec.robot
    assert (sent >= robot.lower - 1e-6).all()
    assert (sent <= robot.upper + 1e-6).all()
    assert np.all(np.abs(np.diff(sent, axis=0)) <= robot.velocity / 30 + 1e-6)
    assert episode.outcome is not None
    assert episode.outcome["policy"]["ik"]["over"] >= 10  # type: ignore[index]
    station.close()


def far_away(observation: Observation, number: int) -> Float64:
    rows = ramp(observation.step, 20)
    rows[:, MOVED] += 0.9
    return rows


@pytest.mark.parametrize("strategy", ["sync", "async"])
def test_a_policy_that_means_to_begin_far_away_is_found_out_although_the_first_step_is_small(
    tmp_path: Path, strategy: str
) -> None:
    station = speaking(Station(stubbed(tmp_path, strategy=strategy)), far_away, SIX).ready()
    first = station.coordinator.snapshot()["first_action"]
    assert first["far"]
    assert first["distance"] == pytest.approx(0.9, abs=0.01)
    station.command("run")
    station.reach(SessionState.HOLDING)
    assert "the first action is 0.9" in station.reason
    station.close()


def test_an_approach_to_a_shown_chunk_goes_to_where_its_first_pose_is_meant(tmp_path: Path) -> None:
    station = speaking(Station(stubbed(tmp_path)), far_away, SIX).ready()
    station.command("run", mode="preview")
    station.go(3)
    station.command("step")
    station.go(3)
    assert station.coordinator.snapshot()["proposal"]["distance"] == pytest.approx(0.9, abs=0.02)
    station.command("approach")
    station.until(lambda: station.coordinator.snapshot()["phase"] == "proposed", 20.0, "to arrive")
    assert station.coordinator.snapshot()["proposal"]["distance"] < 0.02
    station.close()


def test_joint_chunks_say_nothing_of_poses(tmp_path: Path) -> None:
    station = Station(stubbed(tmp_path)).running(20)
    assert station.coordinator.snapshot()["policy"]["ik"] == {}
    raw = station.stop().raw.to_pylist()
    assert {row["ik_flags"] for row in raw} == {row["eef_source"] for row in raw} == {None}
    station.close()


@pytest.mark.some(1)
@pytest.mark.parametrize("wanted", ["measured", "fk"])
def test_the_recording_says_which_poses_there_were_and_which_the_policy_was_shown(
    tmp_path: Path, wanted: Any
) -> None:
    station = speaking(Station(stubbed(tmp_path)), on_time, SIX, "relative")
    station.policy.uses_poses, station.policy.observation_eef = True, wanted
    receive = station.robot.receive

    def with_poses(timeout: float) -> Observation | None:
        seen = receive(timeout)
        assert seen is not None
        poses = station.coordinator.spaces.eef_of(seen.qpos)
        poses[2] += 0.01
        return replace(seen, eef=poses, captured={**seen.captured, "eef": seen.arrived})

    station.robot.receive = with_poses  # type: ignore[method-assign]
    episode = station.running(20).stop()
    assert all(column(episode.rows, "eef_measured"))
    high = (
        column(episode.rows, "eef")[:, 2]
        - station.coordinator.spaces.eef_of(column(episode.rows, "qpos"))[:, 2]
    )
    np.testing.assert_allclose(high, 0.01, atol=1e-5)
    assert set(episode.raw["eef_source"].to_pylist()) == {wanted}
    station.close()


# Publication


def publishing(tmp_path: Path, pose: PoseFormat) -> Station:
    made = stubbed(tmp_path)
    wanted = {"publication": {"space": "eef", "pose": pose.model_dump()}}
    takes = Capabilities(moves_robot=True, spaces=frozenset({"joint", "eef"}))
    resolved = loader.apply_changes(made.spec.resolved, wanted, "test")
    made.spec = replace(made.spec, resolved=resolved, capabilities=takes)
    return Station(made)


@pytest.mark.some(1)
@pytest.mark.parametrize("pose", [SIX, EULER], ids=str)
def test_published_poses_are_those_of_the_safe_joint_command(tmp_path: Path, pose: PoseFormat) -> None:
    station = publishing(tmp_path, pose).running(60)
    robot = station.spec.robot
    spaces, layout = ActionSpaces(robot, make_kinematics(station.spec), 30.0), PoseRows(pose, robot)
    sent = station.robot.commands
    assert len(sent) > 50
    previous = None
    for command in sent:
        joints = command.action.astype(np.float64)[None]
        expected = layout.encode(spaces.vectors(joints), joints, previous)[0]
        assert command.eef is not None
        np.testing.assert_allclose(command.eef, expected, atol=1e-4)
        previous = expected
    station.close()


def test_where_joints_are_published_there_are_no_poses(tmp_path: Path) -> None:
    station = Station(stubbed(tmp_path, start=STANDS)).running(10)
    assert {command.eef for command in station.robot.commands} == {None}
    station.close()
