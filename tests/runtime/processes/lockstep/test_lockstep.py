from __future__ import annotations

import re
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from runtime import __main__ as command_line
from runtime.config import loader
from runtime.core.errors import PolicyError, SetupError
from runtime.core.types import Float64, Observation
from runtime.datasets.publishing import publish
from runtime.ipc.estop_latch import Latch
from runtime.ipc.session_state import SessionState
from runtime.ipc.shared_state import EStop
from runtime.kinematics.base import ChainForward
from runtime.processes.lockstep import lockstep
from runtime.recording.reader import Episode, open_episode
from runtime.spaces.end_effectors import EndEffectors
from runtime.station.checks import check_deployment
from tests.processes import PATIENCE_S
from tests.runtime.lockstep_station import DIM, MOVED, STANDS, Station, column, on_time, ramp, stubbed
from tests.runtime.recording.samples import decoded, numbers

DELAYS = [0, 3, 7]
TABLES = ("rows", "ticks", "smoothed", "raw")


def in_order(observation: Observation, number: int) -> Float64:
    """Answer n goes on where answer n - 1 ended, whenever it is asked."""
    return ramp(12 * number, 12)


def executed(episode: Episode, source: str = "policy") -> tuple[np.ndarray, Float64]:
    """The steps that `source` filled since the run began, and what was sent for them."""
    chosen = column(episode.ticks, "control_source") == source
    steps = column(episode.ticks, "step") - episode.ticks["step"][0].as_py()
    return steps[chosen], column(episode.ticks, "executed")[chosen]


def finite_and_within_limits(station: Station) -> bool:
    robot, sent = station.spec.robot, station.robot.sent
    return bool(
        np.isfinite(sent).all() and (sent >= robot.lower - 1e-6).all() and (sent <= robot.upper + 1e-6).all()
    )


# --- time --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("delay", DELAYS)
def test_async_executes_for_every_step_exactly_what_the_policy_meant_for_it(
    tmp_path: Path, delay: int
) -> None:
    station = Station(stubbed(tmp_path, delay=delay)).running(90)
    episode = station.stop()
    steps, actions = executed(episode)
    assert steps.tolist() == list(
        range(delay, delay + len(steps))
    )  # from the first arrival on, without a gap
    assert len(steps) >= 90 - delay - 1
    meant = ramp(0, steps[-1] + 1).astype(np.float32)[steps]
    if delay:  # the robot stands still until the first chunk, which is `delay` steps ahead by then
        assert (actions[3:] == meant[3:]).all()
    else:
        assert (actions == meant).all()
    raw = episode.raw.to_pylist()
    assert {row["delay"] for row in raw if row["arrival_step"] >= 0} == {delay}
    assert all(
        row["target_step"] in (-1, row["observation_step"] + row["index"])
        for row in raw
        if row["arrival_step"] >= 0
    )
    station.close()


@pytest.mark.parametrize("delay", DELAYS)
def test_sync_executes_every_action_once_and_in_order_and_stands_while_it_waits(
    tmp_path: Path, delay: int
) -> None:
    station = Station(stubbed(tmp_path, in_order, strategy="sync", delay=delay)).running(100)
    episode = station.stop()
    steps, actions = executed(episode)
    assert (actions == ramp(0, len(actions)).astype(np.float32)).all()
    gaps = np.diff(steps) - 1
    assert set(gaps[11::12].tolist()) == {delay}
    assert gaps.sum() == gaps[11::12].sum()
    assert station.events("starved") == []
    standing, held = executed(episode, "hold")
    assert len(standing) + len(steps) == episode.ticks.num_rows
    assert not delay or len(held) >= delay
    station.close()


@pytest.mark.some(4)
@pytest.mark.parametrize("strategy", ["sync", "async"])
@pytest.mark.parametrize("delay", DELAYS)
def test_two_runs_are_recorded_equal_to_the_last_bit(tmp_path: Path, strategy: str, delay: int) -> None:
    episodes = []
    for name in ("one", "two"):
        made = stubbed(tmp_path / name, strategy=strategy, delay=delay, run={"duration_s": 2.0})
        done = lockstep.run(made.spec, peers=made.peers)
        assert done.state is SessionState.READY, done.reason
        episodes.append(open_episode(Path(done.episode["path"])))
    one, two = episodes
    for table in TABLES:
        assert getattr(one, table).equals(getattr(two, table)), table
    assert one.frames == two.frames == 60
    assert {key: one.outcome[key] for key in ("status", "reason", "frames", "held_rows")} == {
        key: two.outcome[key] for key in ("status", "reason", "frames", "held_rows")
    }
    for camera in one.videos:
        assert np.array_equal(decoded(one.videos[camera]), decoded(two.videos[camera]))


def test_a_policy_of_another_rate_still_means_the_same_times(tmp_path: Path) -> None:
    """A policy at 15 Hz under control at 30 Hz: every other step is a row of it, those between are midway."""
    made = stubbed(tmp_path, lambda o, n: ramp(o.step, 20)[::2], delay=3)
    station = Station(made).ready()
    infer = station.policy.infer

    def at_half_rate(observation: Observation, conditioning: Any = None) -> Any:
        chunk = infer(observation)
        return type(chunk)(chunk.actions, rate=15.0)

    station.policy.infer = at_half_rate  # type: ignore[method-assign]
    station.command("run")
    station.go(60)
    steps, actions = executed(station.stop())
    assert np.allclose(actions[8:], ramp(0, steps[-1] + 1)[steps][8:], atol=1e-6)
    station.close()


def test_control_at_100_hz_is_recorded_on_a_grid_of_30(tmp_path: Path) -> None:
    made = stubbed(tmp_path, control={"rate": 100.0}, recording={"fps": 30.0})
    station = Station(made).running(200)
    episode = station.stop()
    first = episode.ticks["step"][0].as_py()
    expected = [first + k * 100 // 30 for k in range(episode.frames)]
    assert column(episode.rows, "step").tolist() == expected
    assert episode.frames in (60, 61)
    assert np.array_equal(column(episode.rows, "time"), np.arange(episode.frames) / 30)
    assert (column(episode.rows, "tick_time") <= column(episode.rows, "time") + 0.011).all()
    shown = numbers(next(iter(episode.videos.values())))[: episode.frames]
    assert shown == [s % (1 << 16) for s in column(episode.rows, "sequence").tolist()]
    station.close()


def test_each_row_has_its_own_picture(tmp_path: Path) -> None:
    station = Station(stubbed(tmp_path)).running(40)
    episode = station.stop()
    for video in episode.videos.values():
        assert numbers(video) == column(episode.rows, "sequence").tolist()
    assert not any(column(episode.rows, f"repeated.{camera}").any() for camera in episode.videos)
    station.close()


# --- policies that are no good -----------------------------------------------------------------------------


@pytest.mark.parametrize("strategy", ["sync", "async"])
def test_a_policy_that_answers_nan_leads_to_holding_with_a_named_reason(
    tmp_path: Path, strategy: str
) -> None:
    def rows(observation: Observation, number: int) -> Float64:
        answer = ramp(observation.step, 10)
        if number == 3:
            answer[4, 2] = np.nan
        return answer

    station = Station(stubbed(tmp_path, rows, strategy=strategy)).running(0)
    station.reach(SessionState.HOLDING)
    assert "nan for left_arm.joint2 in row 4" in station.reason
    station.go(30)
    assert finite_and_within_limits(station)
    assert len(station.robot.sent) >= 30  # the held target is sent on every tick
    assert (station.robot.sent[-10:] == station.robot.sent[-1]).all()
    station.close()


def test_a_policy_with_the_wrong_dimension_fails_the_set_up_with_a_sentence(tmp_path: Path) -> None:
    station = Station(stubbed(tmp_path, lambda o, n: np.zeros((10, 13))))
    station.prepare()
    assert station.state is SessionState.IDLE
    assert "joint actions of shape (10, 13); agilex_piper takes [H, 14]" in station.reason
    assert station.robot.commands == []
    assert station.policy.calls[-1] == "close"
    with pytest.raises(SetupError, match="run is not allowed while idle"):
        station.command("run")
    station.close()


@pytest.mark.some(4)
@pytest.mark.parametrize("delay", DELAYS)
@pytest.mark.parametrize("error", [RuntimeError("cuda out of memory"), KeyError("state")])
def test_a_policy_that_raises_in_the_middle_of_a_run_is_held_and_not_asked_again(
    tmp_path: Path, delay: int, error: Exception
) -> None:
    def rows(observation: Observation, number: int) -> Float64:
        if number == 4:
            raise error
        return ramp(observation.step, 20)

    station = Station(stubbed(tmp_path, rows, delay=delay)).running(0)
    station.reach(SessionState.HOLDING)
    assert str(error) in station.reason
    assert type(error).__name__ in station.reason
    asked = station.policy.calls.count("infer")
    station.go(60)
    assert station.policy.calls.count("infer") == asked
    assert station.events("policy_failed") == [station.reason]
    assert finite_and_within_limits(station)
    assert (station.robot.sent[-30:] == station.robot.sent[-1]).all()
    station.close()


def test_a_policy_that_jumps_is_refused_and_held(tmp_path: Path) -> None:
    def rows(observation: Observation, number: int) -> Float64:
        answer = ramp(observation.step, 20)
        if number >= 5:
            answer[:, 0] += 1.5
        return answer

    station = Station(stubbed(tmp_path, rows, strategy="sync")).running(0)
    station.reach(SessionState.HOLDING)
    assert "10 actions refused in a row" in station.reason
    assert "left_arm.joint0 would be 1.5" in station.reason
    assert "from where it is measured" in station.reason
    assert np.abs(np.diff(station.robot.sent, axis=0)).max() < 0.01
    station.close()


def test_a_policy_that_is_always_too_late_is_held_and_not_running_for_ever(tmp_path: Path) -> None:
    station = Station(stubbed(tmp_path, lambda o, n: ramp(o.step, 5), delay=7)).running(0)
    station.reach(SessionState.HOLDING, PATIENCE_S)
    assert "no usable chunk" in station.reason
    assert len(station.events("chunk_dropped")) >= 2
    assert (station.robot.sent == STANDS.astype(np.float32)).all()
    station.close()


@pytest.mark.exhaustive
def test_of_a_policy_that_does_not_answer_it_is_said_since_when(tmp_path: Path) -> None:
    station = Station(stubbed(tmp_path, delay=300)).running(0)
    station.reach(SessionState.HOLDING, PATIENCE_S)
    reason = r"no usable chunk for [\d.]+ s: the policy was asked [1-9][\d.]* s ago and has not answered yet"
    assert re.fullmatch(reason, station.reason), station.reason
    station.close()


def test_a_run_that_held_is_no_success_and_is_not_published(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    made = stubbed(tmp_path, lambda o, n: ramp(o.step, 5), delay=7, publish={"dataset": "set"})
    assert command_line.run_in_lockstep(made.spec, made.peers) == 1
    assert "holding: no usable chunk" in capsys.readouterr().out
    assert not (tmp_path / "set").exists()
    short = stubbed(tmp_path, run={"duration_s": 0.5}, publish={"dataset": "set"})
    assert command_line.run_in_lockstep(short.spec, short.peers) == 0
    assert (tmp_path / "set/meta/info.json").exists()


def test_a_policy_that_is_absent_fails_the_set_up_with_its_sentence(tmp_path: Path) -> None:
    made = stubbed(tmp_path, absent="no server listens there")
    with pytest.raises(SetupError, match="set-up failed: no server listens there"):
        lockstep.run(made.spec, peers=made.peers)


# --- commands ----------------------------------------------------------------------------------------------


def test_the_e_stop_in_the_middle_of_a_run_faults_and_sends_where_moving_joints_are_measured(
    tmp_path: Path,
) -> None:
    station = Station(stubbed(tmp_path)).running(30)
    assert station.guard.press("ada", "smoke") == ""
    station.robot.blocked = True
    station.robot.position = STANDS + 0.01
    station.go(20)
    assert station.state is SessionState.FAULTED
    assert "ada: smoke" in station.reason
    stopped = STANDS.copy()
    stopped[list(MOVED)] += 0.01
    assert (station.robot.sent[-12:] == stopped.astype(np.float32)).all()
    for kind in ("setup", "run", "resume", "home"):
        with pytest.raises(SetupError, match="not allowed while faulted"):
            station.command(kind)
    outcome = station.episode().outcome
    assert outcome is not None
    assert outcome["status"] == "interrupted"
    assert "ada: smoke" in str(outcome["reason"])
    station.close()


@pytest.mark.parametrize(("on_disk", "reason"), [(True, "by ada: smoke"), (False, "e-stop pressed")])
def test_an_e_stop_is_told_with_who_pressed_where_the_disk_has_it_soon(
    tmp_path: Path, on_disk: bool, reason: str
) -> None:
    station = Station(stubbed(tmp_path)).running(30)
    station.shared.set_estop(EStop.LATCHED)
    station.go(3)
    assert station.state is SessionState.RUNNING  # control obeys already; nobody knows yet who it was
    if on_disk:
        Latch(station.spec.deployment.station_dir).set("ada", "smoke")
        station.go(2)
    else:
        station.go(6)
    assert station.state is SessionState.FAULTED
    assert reason in station.reason
    station.close()


def test_the_e_stop_is_latched_on_disk_and_read_before_the_first_command_of_a_second_start(
    tmp_path: Path,
) -> None:
    made = stubbed(tmp_path)
    station = Station(made).running(30)
    station.guard.press("ada", "smoke")
    station.go(3)
    station.close()
    latched = Latch(made.spec.deployment.station_dir).read()
    assert latched is not None
    assert (latched.by, latched.why) == ("ada", "smoke")

    second = Station(made)
    second.robot.silent = True  # not seen yet: nobody knows where it is
    second.go(10)
    assert second.state is SessionState.FAULTED
    assert second.robot.commands == []
    second.robot.silent = False
    second.go(10)
    assert (second.robot.sent == STANDS.astype(np.float32)).all()
    with pytest.raises(SetupError, match="setup is not allowed while faulted"):
        second.command("setup")
    second.command("release")
    second.go(3)
    assert second.state is SessionState.IDLE
    assert Latch(made.spec.deployment.station_dir).read() is None
    second.running(20)
    assert second.state is SessionState.RUNNING
    second.close()


def test_the_duration_ends_the_run_and_time_on_hold_does_not_count(tmp_path: Path) -> None:
    station = Station(stubbed(tmp_path, run={"duration_s": 2.0})).running(30)
    station.command("halt")
    station.go(45)
    station.command("resume")
    station.reach(SessionState.READY)
    assert "2 s are over" in station.reason
    station.go(3)
    outcome = station.episode().outcome
    assert outcome is not None
    assert outcome["status"] == "finished"
    assert outcome["run_seconds"] == pytest.approx(2.0, abs=0.04)
    assert outcome["frames"] == pytest.approx(105, abs=3)
    assert outcome["held_rows"] == pytest.approx(45, abs=3)
    station.close()


def test_halt_and_resume_keep_one_episode_with_its_held_rows_marked(tmp_path: Path) -> None:
    station = Station(stubbed(tmp_path, delay=3)).running(30)
    station.command("halt")
    assert station.state is SessionState.HOLDING
    asked = station.policy.calls.count("infer")
    station.go(20)
    assert station.policy.calls.count("infer") == asked  # halted is not asked
    station.command("resume")
    station.go(30)
    episode = station.stop()
    assert station.policy.calls.count("reset") == 2  # for warming up and for the run, not for the resume
    assert len(list((tmp_path / "episodes").iterdir())) == 1
    sources = column(episode.rows, "control_source").tolist()
    assert Counter(sources)["hold"] >= 20
    assert sources[-10:] == ["policy"] * 10
    assert column(episode.rows, "step").tolist() == list(
        range(episode.rows["step"][0].as_py(), episode.rows["step"][0].as_py() + episode.frames)
    )
    assert np.abs(np.diff(station.robot.sent, axis=0)).max() < 0.07  # 60 rad/s2 within a tick, never a jump
    station.close()


def test_a_run_that_is_halted_before_it_began_begins_when_it_is_resumed(tmp_path: Path) -> None:
    station = Station(stubbed(tmp_path, run={"duration_s": 1.0})).ready()
    station.command("run")
    station.command("halt")  # media has not even heard of the run
    station.go(30)
    assert station.state is SessionState.HOLDING
    assert station.policy.calls.count("reset") == 1
    station.command("resume")
    station.reach(SessionState.READY, PATIENCE_S)
    assert "1 s are over" in station.reason
    assert station.policy.calls.count("reset") == 2
    station.go(3)
    assert station.episode().outcome["run_seconds"] == pytest.approx(1.0, abs=0.04)  # type: ignore[index]
    station.close()


def test_stop_writes_the_outcome_and_holds(tmp_path: Path) -> None:
    station = Station(stubbed(tmp_path)).running(45)
    episode = station.stop()
    assert episode.outcome is not None
    assert episode.outcome["status"] == "finished"
    assert episode.outcome["reason"] == "stopped by the operator"
    assert episode.outcome["frames"] == episode.rows.num_rows
    assert station.state is SessionState.READY
    before = len(station.robot.commands)
    station.go(10)
    assert len(station.robot.commands) == before + 10  # holding is never silence
    assert station.coordinator.run is None
    station.close()


def test_the_policy_is_told_once_of_each_end_of_what_it_drove(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    station = Station(stubbed(tmp_path)).ready()
    policy = station.coordinator.inference.policy
    monkeypatch.setattr(policy, "end_episode", lambda: policy.calls.append("rest"))
    station.command("run", mode="manual")
    station.go(5)
    station.command("stop")
    assert "rest" not in policy.calls
    for _ in range(2):
        station.command("run")
        station.go(20)
        station.command("stop")
    station.go(5)
    told = [call for call in policy.calls if call in ("rest", "reset")]
    assert told == ["reset", "reset", "rest", "reset", "rest"]  # the first of the set-up
    station.close()


def test_a_policy_that_cannot_end_its_rollout_keeps_no_run_from_ending(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def rest() -> None:
        raise PolicyError("the server is mute")

    station = Station(stubbed(tmp_path)).ready()
    monkeypatch.setattr(station.coordinator.inference.policy, "end_episode", rest)
    station.command("run")
    station.go(20)
    episode = station.stop()
    assert episode.outcome is not None
    assert episode.outcome["status"] == "finished"
    assert "may still keep the rollout that is over: the server is mute" in caplog.text
    station.command("run")
    station.go(20)
    assert station.state is SessionState.RUNNING
    station.close()


def test_a_second_run_is_an_episode_of_its_own(tmp_path: Path) -> None:
    station = Station(stubbed(tmp_path)).running(20)
    first = station.stop()
    station.command("run")
    station.go(20)
    second = station.stop()
    assert first.path != second.path
    assert second.rows["index"][0].as_py() == 0
    assert station.policy.calls.count("reset") == 3
    station.close()


def test_a_lease_that_is_not_renewed_holds_the_robot(tmp_path: Path) -> None:
    station = Station(stubbed(tmp_path, lease={"ttl_s": 1.0})).running(20)
    for _ in range(40):
        station.tick()
    assert station.state is SessionState.HOLDING
    assert "the lease was not renewed" in station.reason
    station.command("resume")
    station.go(10)
    assert station.state is SessionState.RUNNING
    station.close()


@pytest.mark.parametrize("strategy", ["sync", "async", "naive", "ensemble"])
def test_a_node_that_is_silent_for_a_moment_ends_no_run(tmp_path: Path, strategy: str) -> None:
    def rows(observation: Observation, number: int) -> Float64:
        return np.asarray(observation.qpos + ramp(1, 20) - STANDS, np.float64)

    station = Station(stubbed(tmp_path, rows, strategy=strategy)).running(30)
    for ticks in (20, 28):
        before = station.robot.sent[-1].copy()
        station.robot.silent = True
        station.go(ticks)
        stood = station.robot.sent[-1].copy()
        station.robot.silent = False
        station.go(30)
        assert station.state is SessionState.RUNNING, station.reason
        assert np.abs(station.robot.sent[-1] - stood).max() > 0.005  # it goes on
        assert np.abs(stood - before).max() < 0.05  # and stood meanwhile
    waits = strategy == "sync"  # it may stand for its next answer anyway
    assert len(station.events("joints_missing")) == len(station.events("joints_back"))
    assert waits or len(station.events("joints_back")) == 2
    assert np.abs(np.diff(station.robot.sent, axis=0)).max() < 0.01
    assert finite_and_within_limits(station)
    station.close()


def test_a_node_that_falls_silent_holds_the_robot(tmp_path: Path) -> None:
    station = Station(stubbed(tmp_path)).running(30)
    station.robot.silent = True
    station.reach(SessionState.HOLDING, 3.0)
    assert "old (limit" in station.reason
    station.close()


def test_homing_comes_to_the_pose_within_the_limits_of_motions(tmp_path: Path) -> None:
    made = stubbed(tmp_path, setup={"home": True})
    station = Station(made).ready()
    robot = made.spec.robot
    home = robot.poses["home"]
    assert np.allclose(station.robot.position, home, atol=1e-6)
    speeds = np.abs(np.diff(station.robot.sent, axis=0)) * made.spec.rate
    assert (speeds <= robot.velocity * 0.3 + 1e-4).all()
    station.close()


def test_a_halt_while_it_homes_stops_it(tmp_path: Path) -> None:
    station = Station(stubbed(tmp_path, setup={"home": True}))
    station.reach(SessionState.IDLE)
    station.command("setup")
    station.go(15)
    assert station.state is SessionState.SETTING_UP
    station.command("halt")
    station.go(20)
    assert station.state is SessionState.IDLE
    assert (station.robot.sent[-5:] == station.robot.sent[-1]).all()
    assert np.abs(station.robot.position - station.spec.robot.poses["home"]).max() > 0.1
    station.close()


@pytest.mark.parametrize("kind", ["run", "record_start"])
def test_without_room_on_the_disk_nothing_is_begun_and_the_refusal_says_how_much_is_wanted(
    tmp_path: Path, kind: str
) -> None:
    station = Station(stubbed(tmp_path, recording={"min_free_bytes": 10**15})).ready()
    wanted = rf"room to record in {tmp_path}/episodes: \d+ bytes free, at least {10**15} wanted"
    with pytest.raises(SetupError, match=wanted):
        station.command(kind)
    station.go(5)
    assert (station.state, station.coordinator.run, station.coordinator.runs.is_recording_standalone) == (
        SessionState.READY,
        None,
        False,
    )
    assert station.robot.commands == []
    assert not (tmp_path / "episodes").exists()
    station.close()


@pytest.mark.parametrize("on_failure", ["hold", "continue"])
def test_a_recording_that_cannot_be_opened_ends_a_trial_before_it_began_and_says_so(
    tmp_path: Path, on_failure: str
) -> None:
    station = Station(stubbed(tmp_path, recording={"on_failure": on_failure})).ready()
    (tmp_path / "episodes").write_text("in its place")
    ack = station.command("run", trial={"id": 1})
    station.go(5)
    assert (station.state, station.coordinator.run) == (SessionState.READY, None)
    assert "disk error while creating" in station.reason
    assert station.robot.commands == []
    told = [event for event in station.coordinator.events.since(0) if event["data"].get("state") == "ready"][
        -1
    ]
    assert told["data"]["unbegun"] == {
        "command": ack.uuid,
        "episode": ack.data["episode"],
        "unopened": True,
    }
    (tmp_path / "episodes").unlink()
    station.command("run", trial={"id": 1})  # it is as it was
    station.go(5)
    assert station.stop().frames > 0
    station.close()


def test_a_run_that_is_stopped_before_it_began_is_told_as_such(tmp_path: Path) -> None:
    station = Station(stubbed(tmp_path)).ready()
    run = station.command("run").uuid
    station.command("stop")  # before media has heard of either
    station.go(5)
    said = [event["data"] for event in station.coordinator.events.since(0) if event["kind"] == "command"][-1]
    assert (said["unbegun"]["command"], said["unbegun"]["unopened"]) == (run, False)
    assert station.robot.commands == []
    assert station.episode().frames == 0
    station.command("run")
    station.go(5)
    station.command("stop")
    said = [event["data"] for event in station.coordinator.events.since(0) if event["kind"] == "command"][-1]
    assert "unbegun" not in said
    station.close()


def test_a_trial_is_refused_where_nothing_is_recorded(tmp_path: Path) -> None:
    station = Station(stubbed(tmp_path, recording={"enabled": False})).ready()
    with pytest.raises(SetupError, match=r"a trial counts by its recording, and recording\.enabled = false"):
        station.command("run", trial={"id": 1})
    station.command("run")
    station.close()


def test_where_evidence_is_not_wanted_a_run_goes_on_without_its_recording(tmp_path: Path) -> None:
    made = stubbed(tmp_path, recording={"min_free_bytes": 10**15, "on_failure": "continue"})
    station = Station(made).running(30)
    assert station.state is SessionState.RUNNING
    assert len(station.events("recording_failed")) == 1
    assert station.robot.position[0] > STANDS[0] + 0.03
    station.close()


def test_a_run_whose_recording_was_lost_is_not_resumed(tmp_path: Path) -> None:
    station = Station(stubbed(tmp_path)).running(20)
    station.robot.picture = lambda number: np.zeros((24, 32, 3), np.uint8)  # another size from now on
    station.reach(SessionState.HOLDING, PATIENCE_S)
    assert "must be uint8" in station.reason
    station.go(3)
    assert station.coordinator.runs.last_episode["status"] == "failed"
    with pytest.raises(SetupError, match=r"the recording of this run has ended .*stop, then run"):
        station.command("resume")
    assert station.state is SessionState.HOLDING
    station.command("stop")
    station.close()


# --- spaces ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("delay", [0, 3])
def test_a_policy_that_speaks_poses_reaches_them(tmp_path: Path, delay: int) -> None:
    made = stubbed(tmp_path, delay=delay, space="eef")
    eef_of = EndEffectors(made.spec.robot, ChainForward(made.spec.robot)).eef_of

    def poses(observation: Observation, number: int) -> Any:
        return eef_of(ramp(observation.step, 20))

    made.rows = poses
    station = Station(made).running(45)
    episode = station.stop()
    steps, actions = executed(episode)
    assert len(steps) >= 40
    wanted = eef_of(ramp(0, steps[-1] + 1))[steps]
    reached = eef_of(actions)
    settled = slice(10, None)  # a chunk that was waited for is caught up with first
    for arm in (0, 8):
        position = np.linalg.norm((reached - wanted)[settled, arm : arm + 3], axis=1)
        turned = np.abs((reached * wanted)[settled, arm + 3 : arm + 7].sum(axis=1))
        assert position.max() < 1e-3
        assert turned.min() > 1 - 1e-5
        assert np.allclose(reached[settled, arm + 7], wanted[settled, arm + 7], atol=1e-6)
    assert {row["space"] for row in episode.raw.to_pylist()} == {"eef"}
    assert {len(row["action"]) for row in episode.raw.to_pylist()} == {16}
    station.close()


# --- a recording as robot and policy -----------------------------------------------------------------------


@pytest.mark.parametrize("strategy", ["sync", "async"])
def test_what_was_published_plays_through_the_whole_pipeline_unchanged(tmp_path: Path, strategy: str) -> None:
    made = stubbed(tmp_path, run={"duration_s": 2.0})
    first = lockstep.run(made.spec, peers=made.peers)
    publish(Path(first.episode["path"]), tmp_path / "set")
    mapping = {"eef": "eef_state", "action_eef": "eef_action"}
    tree = {
        "station": "replay",
        "robot": "agilex_piper",
        "data_dir": str(tmp_path / "again"),
        "transport": {"kind": "dataset", "path": str(tmp_path / "set"), "mapping": mapping},
        "policy": {"kind": "replay", "path": str(tmp_path / "set"), "horizon": 16},
        "strategy": {"kind": strategy},
        "safety": {"report_only": True},
        "recording": {"min_free_bytes": 0},
    }
    done = lockstep.run(check_deployment(loader.resolve_deployment(tree, {}, "test")))
    assert (done.state, done.reason) == (SessionState.READY, "the recording that is the source has ended")
    source, copy = open_episode(Path(first.episode["path"])), open_episode(Path(done.episode["path"]))
    assert copy.frames == source.frames == 60
    for name in ("index", "time", "qpos", "action", "eef", "eef_action"):
        assert np.array_equal(column(copy.rows, name), column(source.rows, name)), name
    assert column(copy.rows, "eef_action_reported").all()
    for camera in source.videos:
        assert numbers(copy.videos[camera]) == numbers(source.videos[camera])


def test_no_command_ever_leaves_before_set_up(tmp_path: Path) -> None:
    station = Station(stubbed(tmp_path))
    station.go(30)
    assert station.state is SessionState.IDLE
    assert station.robot.commands == []
    station.close()


def test_the_ramp_moves_only_joints_with_room() -> None:
    moved = np.ptp(ramp(0, 100), axis=0) > 0
    assert np.flatnonzero(moved).tolist() == list(MOVED)
    assert ramp(0, 1).shape == (1, DIM)
    assert (on_time(Observation(1, 0.0, {}, STANDS.astype(np.float32), {}, step=3), 0)[0] == ramp(3, 1)).all()
