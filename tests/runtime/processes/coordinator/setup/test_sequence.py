from __future__ import annotations

from concurrent.futures import Future
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from runtime.config import loader
from runtime.core.errors import PolicyError, SetupError
from runtime.core.types import Observation
from runtime.ipc.session_state import SessionState
from runtime.kinematics.base import ChainForward
from runtime.policies.base import PolicyInfo
from runtime.processes.coordinator import assembly
from runtime.processes.coordinator.inference.runners import LockstepRunner
from runtime.processes.coordinator.setup.sequence import Stage
from runtime.spaces.conversion import CommandRows
from tests.runtime.lockstep_station import MOVED, STANDS, Station, on_time, ramp, stubbed


def failed(station: Station) -> str:
    """Set up, in vain; the reason."""
    station.prepare()
    assert station.state is SessionState.IDLE
    assert station.coordinator.setup.stage is Stage.IDLE
    return station.reason


def without_control(station: Station, seconds: float, beating: bool = True) -> None:
    """Time passes, and control, alive or not, does not tick."""
    until, others = station.clock.now() + seconds, ("guard", "media", "reception")
    while station.clock.now() < until:
        now = station.clock.now()
        for process in ("control", *others) if beating else others:
            station.shared.beat(process, now)
        station._handle("lease_renew")
        station.reception.poll(0.0)
        station.media.poll()
        station.coordinator.poll()
        station.clock.advance(1 / 30)


def test_it_goes_from_stage_to_stage_and_says_so(tmp_path: Path) -> None:
    station = Station(stubbed(tmp_path, setup={"home": True})).ready()
    assert station.events("setup") == [
        "waiting for a complete observation",
        "going to the pose",
        "warming up the policy",
        "idle",
    ]
    assert station.reason.startswith("20 rows in 0 ms, the first at most ")
    assert station.coordinator.setup.validated == station.reason
    assert station.coordinator.setup.info is not None
    assert station.coordinator.setup.info.name == "stub"
    station.close()


@pytest.mark.parametrize("fails", [False, True])
def test_kinematics_that_are_not_compiled_yet_are_waited_for_and_that_is_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, fails: bool
) -> None:
    compiled: Future[Any] = Future()
    monkeypatch.setattr(assembly, "kinematics_compiled", lambda spec: False)
    monkeypatch.setattr(LockstepRunner, "run_in_background", lambda self, call: compiled)
    station = Station(stubbed(tmp_path))
    station.until(lambda: station.state is SessionState.IDLE, 5.0, "observations")
    station.command("setup")
    station.go(300)
    assert station.coordinator.setup.stage is Stage.COMPILE
    assert station.events("setup")[-1] == "compiling the robot's kinematics, once on this machine"
    states = {stage["name"]: stage["state"] for stage in station.coordinator.snapshot()["stages"]}
    assert list(states.values())[:3] == ["done", "active", "waiting"]
    if fails:  # most policies speak joints, and need none of it
        compiled.set_exception(SetupError("no compiler"))
    else:
        compiled.set_result(ChainForward(station.spec.robot))
    station.reach(SessionState.READY)
    station.close()


def test_the_policy_is_reset_once_and_warmed_up_as_often_as_asked(tmp_path: Path) -> None:
    station = Station(stubbed(tmp_path, setup={"warmup_chunks": 4})).ready()
    assert station.policy.calls == ["connect", "reset", "infer", "infer", "infer", "infer"]
    assert station.robot.commands == []  # nothing moved: no homing was asked for
    station.close()


def test_the_first_row_is_compared_with_where_the_arm_is(tmp_path: Path) -> None:
    station = Station(stubbed(tmp_path, lambda o, n: ramp(100, 5))).ready()
    assert (
        station.coordinator.setup.validated
        == "5 rows in 0 ms, the first at most 0.200 rad away (left_arm.joint0)"
    )
    station.close()


def test_a_policy_that_cannot_be_reached_ends_it_with_its_sentence(tmp_path: Path) -> None:
    station = Station(stubbed(tmp_path, absent="no server at ws://there: start it"))
    assert failed(station) == "no server at ws://there: start it"
    assert station.policy.calls == ["connect", "close"]
    station.close()


@pytest.mark.parametrize("error", [PolicyError("out of memory"), ValueError("bad shape")])
def test_a_policy_that_fails_while_it_is_warmed_up_ends_it(tmp_path: Path, error: Exception) -> None:
    def rows(observation: Observation, number: int) -> np.ndarray:
        if number == 1:
            raise error
        return on_time(observation, number)

    station = Station(stubbed(tmp_path, rows, delay=2))
    assert str(error) in failed(station)
    assert station.policy.calls == ["connect", "reset", "infer", "infer", "close"]
    station.close()


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_policy_that_answers_what_is_no_number_ends_it(tmp_path: Path, value: float) -> None:
    def rows(observation: Observation, number: int) -> np.ndarray:
        answer = ramp(0, 5)
        answer[3, 9] = value
        return answer

    station = Station(stubbed(tmp_path, rows))
    assert f"{value} for right_arm.joint2 in row 3" in failed(station)
    assert station.robot.commands == []
    station.close()


def test_a_camera_that_falls_away_ends_it_with_its_name(tmp_path: Path) -> None:
    station = Station(stubbed(tmp_path, setup={"observation_timeout_s": 1.0}))
    station.reach(SessionState.IDLE)
    station.robot.cameras.remove("cam_left_wrist")
    station.go(30)  # the last picture of it grows old
    reason = failed(station)
    assert reason.startswith("no complete observation within 1 s: cam_left_wrist: ")
    assert "cam_left_wrist: nothing has arrived yet" in reason
    station.close()


def test_an_arm_that_does_not_arrive_ends_it_with_its_name_and_how_far_it_is(tmp_path: Path) -> None:
    station = Station(stubbed(tmp_path, setup={"home": True}))
    station.robot.bias[8] = 0.2
    reason = failed(station)
    assert "the arm did not arrive: right_arm.joint1 is 0.20 rad from the pose 'home'" in reason
    assert "another program" in reason
    station.go(10)
    assert (station.robot.sent[-5:] == station.robot.sent[-1]).all()  # it holds
    station.close()


def test_a_blocked_arm_is_not_pulled_at_further_than_the_following_error(tmp_path: Path) -> None:
    station = Station(stubbed(tmp_path, setup={"home": True}))
    station.robot.blocked = True
    reason = failed(station)
    assert "10 actions refused in a row" in reason
    station.go(10)
    way = np.abs(station.robot.sent - station.robot.sent[0]).max(axis=1)
    assert np.diff(way[: way.argmax() + 1]).min() >= -1e-6  # it goes on or stands, and never jumps back
    assert way[-1] < 0.05  # then it is held where it is measured
    assert "from where it is measured, allowed 0.5" in reason
    assert np.abs(station.robot.sent - STANDS).max() < 0.6
    station.close()


def test_a_node_that_falls_silent_while_it_homes_stops_the_motion(tmp_path: Path) -> None:
    station = Station(stubbed(tmp_path, setup={"home": True}))
    station.reach(SessionState.IDLE)
    station.command("setup")
    station.go(15)
    station.robot.silent = True
    station.reach(SessionState.IDLE, 2.0)
    assert "10 actions refused in a row, the last one: joint readings are " in station.reason
    station.go(15)  # it has come to a stand
    assert (station.robot.sent[-5:] == station.robot.sent[-1]).all()
    station.close()


def test_joints_that_read_exactly_0_are_named_before_anything_moves(tmp_path: Path) -> None:
    standing = STANDS.copy()
    standing[[3, 12]] = 0.0
    station = Station(stubbed(tmp_path, start=standing)).ready()
    (named,) = station.events("zero_joints")
    zero = np.flatnonzero(station.spec.limits.position_mask & (standing == 0.0))
    assert named.startswith(", ".join(station.spec.limits.names[i] for i in zero) + " read exactly 0 rad")
    station.close()
    simulated = Station(stubbed(tmp_path / "simulated", start=standing, simulated=True)).ready()
    assert simulated.events("zero_joints") == []  # it has no encoders
    simulated.close()


def test_a_set_up_waits_until_the_joints_are_believed(tmp_path: Path) -> None:
    station = Station(stubbed(tmp_path, setup={"observation_timeout_s": 1.0}))
    station.reach(SessionState.IDLE)
    noise = np.random.default_rng(1)
    station.robot.blocked = True
    station.command("setup")
    for _ in range(60):
        station.robot.position = (
            STANDS + noise.normal(0.0, 0.6, len(STANDS)) * station.spec.limits.position_mask
        )
        station.go(1)
    assert station.state is SessionState.IDLE
    assert "no complete observation within 1 s: " in station.reason
    assert station.robot.commands == []
    station.close()


def test_a_motion_that_control_never_finishes_ends_it(tmp_path: Path) -> None:
    station = Station(stubbed(tmp_path, setup={"home": True}))
    station.reach(SessionState.IDLE)
    station.go(10)  # control has seen the joints
    station.command("setup")
    without_control(station, 10.0)
    assert station.state is SessionState.IDLE
    assert "control did not reach the pose 'home' within" in station.reason
    station.close()


def test_without_control_no_motion_is_ordered(tmp_path: Path) -> None:
    station = Station(stubbed(tmp_path, setup={"home": True, "observation_timeout_s": 3.0}))
    station.reach(SessionState.IDLE)
    station.command("setup")
    without_control(station, 4.5, beating=False)
    assert station.state is SessionState.IDLE
    assert "the process control does not answer" in station.reason
    station.close()


@pytest.mark.parametrize("ticks", [1, 3, 8])  # while connecting, before and within warming up
@pytest.mark.parametrize("command", ["stop", "halt"])
def test_it_can_be_cancelled_at_any_time_and_begun_again(tmp_path: Path, ticks: int, command: str) -> None:
    station = Station(stubbed(tmp_path, delay=4))
    station.reach(SessionState.IDLE)
    station.command("setup")
    station.go(ticks)
    assert station.state is SessionState.SETTING_UP
    station.command(command)
    assert station.state is SessionState.IDLE
    assert station.policy.calls[-1] == "close"  # what is under way is cut off
    station.go(10)
    assert station.state is SessionState.IDLE
    station.ready()
    station.close()


def test_homing_alone_asks_no_policy(tmp_path: Path) -> None:
    station = Station(stubbed(tmp_path)).ready()
    asked = len(station.policy.calls)
    station.command("home")
    assert station.state is SessionState.SETTING_UP
    station.reach(SessionState.READY)
    assert station.reason == "at the pose 'home'"
    assert len(station.policy.calls) == asked
    assert np.allclose(station.robot.position, station.spec.robot.poses["home"], atol=1e-6)
    station.close()


def test_a_transport_that_moves_nothing_is_not_homed(tmp_path: Path) -> None:
    station = Station(stubbed(tmp_path, moves_robot=False, setup={"home": True})).ready()
    assert station.robot.commands == []
    with pytest.raises(SetupError, match="transport 'dataset' moves no robot"):
        station.command("home")
    assert station.state is SessionState.READY
    station.close()


def test_a_second_set_up_connects_and_validates_anew(tmp_path: Path) -> None:
    station = Station(stubbed(tmp_path)).ready()
    station.command("setup")
    assert station.coordinator.setup.validated == ""
    station.reach(SessionState.READY)
    assert station.policy.calls.count("connect") == 2
    assert station.coordinator.setup.validated != ""
    station.close()


def test_the_e_stop_ends_it(tmp_path: Path) -> None:
    station = Station(stubbed(tmp_path, setup={"home": True}))
    station.reach(SessionState.IDLE)
    station.command("setup")
    station.go(15)
    station.guard.press("ada", "smoke")
    station.go(3)
    assert station.state is SessionState.FAULTED
    assert station.coordinator.setup.stage is Stage.IDLE
    here = station.robot.position.copy()
    station.go(20)
    assert np.array_equal(station.robot.position, here)
    station.close()


# What the server says of itself, what the robot measures


def with_horizon(tmp_path: Path, steps: int, **said: Any) -> Station:
    """A station that is to execute so many steps of each answer; its policy says of itself what is `said`."""
    made = stubbed(tmp_path, strategy="sync")
    strategy = {"strategy": {"execution_horizon": steps}}
    made.spec = replace(made.spec, resolved=loader.apply_changes(made.spec.resolved, strategy, "test"))
    station = Station(made)
    station.policy.connect = lambda: PolicyInfo("stub", **said)  # type: ignore[method-assign]
    return station


@pytest.mark.parametrize(
    "said", [{"horizon": 20}, {"horizon": 11, "rate": 15.5}, {"horizon": 40, "rate": 60.0}]
)
def test_no_more_steps_can_be_executed_of_an_answer_than_it_has(tmp_path: Path, said: dict[str, Any]) -> None:
    station = with_horizon(tmp_path, 21, **said)
    assert (
        f"strategy.execution_horizon = 21 control steps, but the policy 'stub' says that its answers have "
        f"{said['horizon']} rows, 20 control steps"
    ) in failed(station)
    station.close()


@pytest.mark.some(1)
@pytest.mark.parametrize("strategy", ["sync", "async", "ensemble", "naive"])
@pytest.mark.parametrize(("rate", "count"), [(60.0, 1), (45.0, 1), (60.0, 2), (10.0, 1)])
def test_a_short_fast_chunk_is_set_up_and_moves_the_robot(
    tmp_path: Path, strategy: str, rate: float, count: int
) -> None:
    station = Station(stubbed(tmp_path, lambda seen, number: ramp(seen.step, count), strategy))
    infer = station.policy.infer
    station.policy.infer = lambda *asked: replace(infer(*asked), rate=rate)  # type: ignore[method-assign]
    station.ready().command("run")
    station.go(60)
    assert station.state is SessionState.RUNNING, station.reason
    assert station.robot.sent[-1, MOVED[0]] == pytest.approx(
        0.002 * station.coordinator.shared.control.read()["step"], abs=0.1
    )
    assert len(np.unique(station.robot.sent[:, MOVED[0]])) > 10
    station.close()


def test_what_goes_wrong_with_an_answer_ends_the_set_up_and_not_main(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    station = Station(stubbed(tmp_path))
    monkeypatch.setattr(CommandRows, "intended_start", property(lambda made: made.rows[len(made.rows)]))
    assert "the policy's answer cannot be used: IndexError: index 20 is out of bounds" in failed(station)
    assert "Traceback" in caplog.text
    station.close()


def test_what_a_policy_says_of_itself_ends_the_set_up_and_not_main(tmp_path: Path) -> None:
    station = with_horizon(tmp_path, 5, horizon="twenty")
    assert "the policy's metadata cannot be used: TypeError" in failed(station)
    station.close()


@pytest.mark.parametrize("said", [{"horizon": 20}, {"horizon": 11, "rate": 15.0}, {}])
def test_as_many_steps_as_it_has_can_be(tmp_path: Path, said: dict[str, Any]) -> None:
    with_horizon(tmp_path, 20, **said).ready().close()


def measuring(tmp_path: Path, off: float) -> Station:
    """A station whose robot measures the pose of its right arm `off` metres too high."""
    station = Station(stubbed(tmp_path))
    receive = station.robot.receive

    def with_poses(timeout: float) -> Observation | None:
        seen = receive(timeout)
        assert seen is not None
        poses = station.coordinator.spaces.eef_of(seen.qpos)
        poses[10] += off
        return replace(seen, eef=poses, captured={**seen.captured, "eef": seen.arrived})

    station.robot.receive = with_poses  # type: ignore[method-assign]
    return station


def test_measured_poses_of_another_link_are_an_error_where_the_policy_depends_on_them(tmp_path: Path) -> None:
    station = measuring(tmp_path, 0.1)
    station.policy.uses_poses = True
    why = failed(station)
    assert (
        "measures the pose of right_arm 100 mm and 0 degrees from where its joints have gripper_base" in why
    )
    assert 'allowed: policy.observation_eef = "fk"' in why
    station.close()


def test_they_are_said_where_it_does_not_and_no_matter_where_it_is_shown_those_of_the_joints(
    tmp_path: Path,
) -> None:
    station = measuring(tmp_path / "joints", 0.1).ready()
    (said,) = station.events("eef_disagrees")
    assert "right_arm 100 mm" in said
    station.close()
    station = measuring(tmp_path / "fk", 0.1)
    station.policy.uses_poses, station.policy.observation_eef = True, "fk"
    assert station.ready().events("eef_disagrees") == []
    station.close()


def test_measured_poses_that_agree_are_nothing_to_speak_of(tmp_path: Path) -> None:
    station = measuring(tmp_path, 0.01)
    station.policy.uses_poses = True
    assert station.ready().events("eef_disagrees") == []
    station.close()


def set_up_in(station: Station, **args: Any) -> float:
    """How long a set-up with these arguments lasts, on the station's clock [s]."""
    began = station.clock.now()
    station.command("setup", **args)
    station.until(lambda: station.state is SessionState.READY, 60.0, "set-up")
    return station.clock.now() - began


def test_whose_policy_is_quick_takes_as_long_as_it_is_told_to(tmp_path: Path) -> None:
    station = Station(stubbed(tmp_path))
    station.until(lambda: station.state is SessionState.IDLE, 5.0, "observations")
    quick = set_up_in(station)
    assert quick < 1.0
    assert station.coordinator.snapshot()["setup_took"].keys() == {"connect_s", "warm_up_s"}
    rested = set_up_in(station, least={"connect_s": 3.0, "warm_up_s": 5.0})
    assert rested == pytest.approx(8.0 + quick, abs=0.5)
    entered = station.coordinator.setup.stages
    assert entered[Stage.OBSERVE] - entered[Stage.CONNECT] == pytest.approx(3.0, abs=0.1)
    took = station.coordinator.snapshot()["setup_took"]
    assert max(took.values()) < 0.5, "rests are none of the policy's time"
    assert station.policy.calls.count("infer") == 2 * 2
    station.close()


def test_a_rest_can_be_cancelled_and_times_that_cannot_be_are_refused(tmp_path: Path) -> None:
    station = Station(stubbed(tmp_path))
    station.until(lambda: station.state is SessionState.IDLE, 5.0, "observations")
    station.command("setup", least={"warm_up_s": 100.0})
    station.go(90)
    assert station.state is SessionState.SETTING_UP
    assert station.coordinator.setup.stage is Stage.WARM_UP
    station.command("halt")
    assert station.state is SessionState.IDLE
    with pytest.raises(
        SetupError, match=r"least\.warm_up_s = -1: Input should be greater than or equal to 0"
    ):
        station.command("setup", least={"warm_up_s": -1})
    station.close()
