"""Runs of every mode, from the command to what the robot was sent and what was recorded."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from runtime.core.errors import PolicyError, PolicyLostError, SetupError
from runtime.ipc.session_state import SessionState
from tests.runtime.lockstep_station import STANDS, Station, column, on_time, ramp, stubbed

LEFT_GRIPPER = 6


def begun(tmp_path: Path, mode: str, rows: Any = on_time, **settings: Any) -> Station:
    """A station with an open run of that mode, recording."""
    station = Station(stubbed(tmp_path, rows, **settings)).ready()
    station.command("run", mode=mode)
    station.go(3)
    assert station.state is SessionState.RUNNING
    return station


def phase(station: Station) -> str:
    return str(station.coordinator.snapshot()["phase"])


def recorded(station: Station, stream: str, name: str) -> np.ndarray:
    return column(getattr(station.stop(), stream), name)


def test_step_executes_one_chunk_per_command_in_order_and_then_stands(tmp_path: Path) -> None:
    station = begun(tmp_path, "step", lambda o, n: ramp(o.step, 5), delay=2)
    assert phase(station) == "waiting"
    assert len(station.robot.commands) == 0 or np.allclose(station.robot.sent, STANDS)
    for _ in range(2):
        before = station.robot.sent[-1] if station.robot.commands else STANDS
        station.command("step")
        assert phase(station) == "asking"
        station.go(12)
        assert phase(station) == "waiting"
        assert not np.array_equal(station.robot.sent[-1], before)
    episode = station.stop()
    assert episode.manifest["mode"] == "step"
    raw = episode.raw
    assert column(raw, "delay").min() >= 2
    targets = column(raw, "target_step").reshape(2, 5)
    assert (np.diff(targets, axis=1) == 1).all()
    assert (targets[:, 0] == column(raw, "arrival_step")[::5]).all()
    station.close()


def test_step_is_refused_while_the_last_chunk_is_executed(tmp_path: Path) -> None:
    station = begun(tmp_path, "step")
    station.command("step")
    station.go(3)
    with pytest.raises(SetupError, match=r"step is not allowed now: the last chunk is still being executed"):
        station.command("step")
    station.command("cancel")
    station.go(20)
    assert phase(station) == "waiting"
    stood = station.robot.sent[-1]
    station.go(10)
    assert np.array_equal(station.robot.sent[-1], stood)
    station.close()


def test_a_proposal_moves_nothing_until_it_is_committed_however_long_one_looks(tmp_path: Path) -> None:
    station = begun(tmp_path, "preview", lambda o, n: ramp(0, 6))
    station.command("step")
    station.go(90)
    told = station.coordinator.snapshot()
    assert (told["phase"], told["proposal"]["rows"]) == ("proposed", 6)
    assert told["proposal"]["age_s"] > 2.0
    assert not station.robot.commands or np.allclose(station.robot.sent, STANDS)
    station.command("commit")
    station.go(20)
    assert phase(station) == "waiting"
    targets = recorded(station, "raw", "target_step")
    assert (targets >= 0).all()  # every action, in order: the robot stood while somebody looked
    station.close()


def test_a_cancelled_proposal_is_recorded_as_one_that_was_never_executed(tmp_path: Path) -> None:
    station = begun(tmp_path, "preview")
    station.command("step")
    station.go(2)
    assert station.coordinator.snapshot()["phase"] == "proposed"
    station.command("cancel")
    assert station.coordinator.snapshot()["proposal"] == {}
    station.go(5)
    assert not station.robot.commands or np.allclose(station.robot.sent, STANDS)
    episode = station.stop()
    assert (column(episode.raw, "arrival_step") == -1).all()
    assert (column(episode.raw, "target_step") == -1).all()
    station.close()


def test_approach_goes_to_where_the_shown_chunk_begins_and_commit_executes_it_from_there(
    tmp_path: Path,
) -> None:
    station = begun(tmp_path, "preview", lambda o, n: ramp(400, 5))
    station.command("step")
    station.go(2)
    assert station.coordinator.snapshot()["proposal"]["far"]
    station.command("approach")
    station.go(1)
    assert phase(station) == "approaching"
    station.until(lambda: phase(station) == "proposed", 20.0, "to arrive")
    assert np.allclose(station.robot.position, ramp(400, 1)[0], atol=1e-3)
    station.command("commit")
    station.go(12)
    assert station.state is SessionState.RUNNING
    assert np.allclose(station.robot.position, ramp(404, 1)[0], atol=5e-3)
    station.close()


def test_a_far_first_action_is_said_at_set_up_and_can_be_approached_before_the_run(tmp_path: Path) -> None:
    station = Station(stubbed(tmp_path, lambda o, n: ramp(400, 20))).ready()
    first = station.coordinator.snapshot()["first_action"]
    assert first["far"]
    assert "far" in station.reason
    station.command("approach")
    assert station.state is SessionState.SETTING_UP
    station.reach(SessionState.READY)
    assert not station.coordinator.snapshot()["first_action"]["far"]
    assert station.reason == "at the policy's first action"
    station.close()


@pytest.mark.parametrize("sim_state", ["live", "simulated"])
def test_simulation_moves_the_simulated_robot_and_never_the_real_one(tmp_path: Path, sim_state: str) -> None:
    seen = []

    def rows(observation: Any, number: int) -> Any:
        seen.append(observation.qpos.copy())
        return on_time(observation, number)

    station = Station(stubbed(tmp_path, rows)).ready()
    station.command("run", mode="sim", sim_state=sim_state)
    station.go(40)
    assert station.robot.commands == [] or np.allclose(station.robot.sent, STANDS)
    told = station.coordinator.snapshot()
    assert (told["mode"], told["sim_state"]) == ("sim", sim_state)
    simulated = station.shared.control.read()["simulated"]
    assert np.abs(simulated - STANDS).max() > 0.05
    moved = np.abs(seen[-1] - STANDS).max() > 0.02
    assert moved == (sim_state == "simulated")
    episode = station.stop()
    assert episode.manifest["mode"] == "sim"
    assert episode.manifest["sim_state"] == sim_state
    assert set(column(episode.ticks, "control_source")[5:]) <= {"sim", "none", "hold"}
    assert "sim" in column(episode.ticks, "control_source")
    assert episode.smoothed.num_rows > 20
    assert episode.raw.num_rows > 20
    station.close()


def test_a_run_after_a_simulation_shows_the_policy_the_real_robot_again(tmp_path: Path) -> None:
    station = begun(tmp_path, "sim")
    station.go(20)
    station.command("stop")
    station.go(3)
    station.command("run", mode="continuous")
    station.go(10)
    assert not station.coordinator.inference.requests.policy_observation.simulated
    assert station.coordinator.snapshot()["mode"] == "continuous"
    assert len(station.robot.commands) > 0
    station.close()


def test_manual_moves_go_where_they_are_told_and_are_recorded(tmp_path: Path) -> None:
    station = begun(tmp_path, "manual")
    goal = STANDS.copy()
    goal[0] += 0.3
    ack = station.command("move", joints=goal.tolist(), speed=0.5)
    assert ack.data["duration_s"] > 0
    station.go(2)
    assert phase(station) == "moving"
    station.until(lambda: phase(station) == "waiting", 20.0, "to arrive")
    assert np.allclose(station.robot.position, goal, atol=1e-3)
    episode = station.stop()
    assert episode.manifest["mode"] == "manual"
    assert "motion" in column(episode.ticks, "control_source")
    station.close()


def test_cancelling_a_motion_stops_on_the_way_and_the_run_goes_on(tmp_path: Path) -> None:
    station = begun(tmp_path, "manual")
    goal = STANDS.copy()
    goal[0] += 0.6
    station.command("move", joints=goal.tolist())
    station.go(8)
    station.command("cancel")
    station.go(15)
    assert phase(station) == "waiting"
    assert station.state is SessionState.RUNNING
    assert STANDS[0] < station.robot.position[0] < goal[0] - 0.05
    station.command("move", pose="ready")
    station.go(2)
    station.until(lambda: phase(station) == "waiting", 30.0, "to arrive")
    assert np.allclose(station.robot.position, station.spec.robot.poses["ready"], atol=1e-3)
    station.close()


def test_what_leads_nowhere_is_refused_before_anything_moves(tmp_path: Path) -> None:
    station = begun(tmp_path, "manual")
    for arguments, sentence in (
        ({"joints": [9.0] * 14}, r"left_arm\.joint0 = 9\.0000; allowed: "),
        ({"pose": "dance"}, "pose = 'dance'"),
        ({"joints": [0.0]}, "1 joints; agilex_piper has 14"),
    ):
        with pytest.raises(SetupError, match=sentence):
            station.command("move", **arguments)
    assert not station.robot.commands or np.allclose(station.robot.sent, STANDS)
    station.close()


def test_aiming_moves_nothing_and_needs_no_lease(tmp_path: Path) -> None:
    station = Station(stubbed(tmp_path)).ready()
    ack = station._handle("aim", {"pose": "home"})
    assert ack.status == "done"
    assert ack.data["reached"]
    assert len(ack.data["joints"]) == 14
    assert station._handle("aim", {"pose": "dance"}).status == "refused"
    station.go(10)
    assert station.robot.commands == []
    station.close()


def test_a_gripper_opens_by_hand_while_the_station_is_ready(tmp_path: Path) -> None:
    station = Station(stubbed(tmp_path)).ready()
    station.command("gripper", arm="left_arm", action="open")
    station.go(60)
    wide = station.spec.robot.group("left_arm").gripper.open
    assert station.robot.position[LEFT_GRIPPER] == pytest.approx(wide, abs=1e-4)
    assert np.allclose(
        np.delete(station.robot.position, LEFT_GRIPPER), np.delete(STANDS, LEFT_GRIPPER), atol=1e-4
    )
    assert station.state is SessionState.READY
    station.close()


def test_a_locked_gripper_stays_whatever_the_policy_wants_and_the_record_says_so(tmp_path: Path) -> None:
    def rows(observation: Any, number: int) -> Any:
        wanted = on_time(observation, number).copy()
        wanted[:, LEFT_GRIPPER] = 0.09 if number < 25 else 0.02
        return wanted

    station = Station(stubbed(tmp_path, rows)).running(20)
    at = float(station.shared.control.read()["commanded"][LEFT_GRIPPER])
    station.command("gripper", arm="left_arm", action="lock")
    station.go(20)
    assert station.robot.sent[-10:, LEFT_GRIPPER] == pytest.approx(at, abs=1e-3)
    assert station.coordinator.snapshot()["grippers"]["left_arm"]["locked"]
    station.command("gripper", arm="left_arm", action="unlock")
    station.go(30)
    assert station.robot.sent[-1, LEFT_GRIPPER] == pytest.approx(0.02, abs=1e-3)
    changes = station.stop().ticks["changes"].to_pylist()
    assert any("locked" in note for notes in changes for note in notes)
    station.close()


def test_a_trial_is_run_as_it_was_set_up_or_not_at_all(tmp_path: Path) -> None:
    station = Station(stubbed(tmp_path)).ready()
    with pytest.raises(SetupError, match="a trial runs in the mode continuous, and sim was asked for"):
        station.command("run", trial={"id": 1}, mode="sim")
    station.command("tune", strategy={"blend_window": 3})
    with pytest.raises(SetupError, match="tuned since the set-up: set up again"):
        station.command("run", trial={"id": 1})
    station.ready()
    assert station.coordinator.spec.deployment.strategy.blend_window == 8  # type: ignore[attr-defined]
    station.command("gripper", arm="left_arm", action="lock")
    with pytest.raises(SetupError, match="a gripper is locked"):
        station.command("run", trial={"id": 1})
    station.ready()
    station.command("run", trial={"id": 1})
    station.go(3)
    for kind, arguments in (("tune", {"task": "x"}), ("gripper", {"action": "open"})):
        with pytest.raises(SetupError, match="one of a trial"):
            station.command(kind, **arguments)
    station.close()


@pytest.mark.some(1)
@pytest.mark.parametrize("before", ["async", "sync", "ensemble", "naive"])
@pytest.mark.parametrize("after", ["async", "sync", "ensemble", "naive"])
def test_another_strategy_takes_over_within_a_run_without_a_gap_or_a_jump(
    tmp_path: Path, before: str, after: str
) -> None:
    station = Station(stubbed(tmp_path, strategy=before, delay=2)).running(25)
    station.command("tune", strategy={"kind": after})
    station.go(60)
    assert station.state is SessionState.RUNNING, station.reason
    assert station.coordinator.snapshot()["strategy"] == after
    assert station.events("starved") == []
    sent = station.robot.sent
    # The ramp's own steps are 0.002; what is caught up after a wait is blended in.
    assert np.abs(np.diff(sent, axis=0)).max() < 0.02
    episode = station.stop()
    assert set(column(episode.raw, "strategy")) == {before, after} if before != after else {before}
    assert any(event["kind"] == "tuned_to" for event in episode.events)
    station.close()


def test_another_instruction_reaches_the_policy_within_the_run(tmp_path: Path) -> None:
    prompts = []

    def rows(observation: Any, number: int) -> Any:
        prompts.append(observation.prompt)
        return on_time(observation, number)

    station = Station(stubbed(tmp_path, rows)).running(10)
    station.command("tune", task="put it back")
    station.go(30)
    assert prompts[0] == "stack the cups"
    assert prompts[-1] == "put it back"
    assert station.coordinator.snapshot()["task"] == "put it back"
    station.close()


@pytest.mark.some(1)
@pytest.mark.parametrize(
    ("strategy", "sentence"),
    [
        ({"kind": "magic"}, "magic"),
        ({"blend_window": 0}, "blend_window"),
        ({"colour": "blue"}, "colour"),
    ],
)
def test_a_strategy_that_there_is_not_is_refused_and_nothing_changes(
    tmp_path: Path, strategy: dict[str, Any], sentence: str
) -> None:
    station = Station(stubbed(tmp_path)).running(10)
    before = station.coordinator.snapshot()["tuning"]
    with pytest.raises(SetupError, match=sentence):
        station.command("tune", strategy=strategy)
    assert station.coordinator.snapshot()["tuning"] == before
    station.go(20)
    assert station.state is SessionState.RUNNING
    station.close()


class Failing:
    """A policy that fails from its n-th answer on, for so many times."""

    def __init__(self, error: Exception, first: int, times: int) -> None:
        self.error, self.first, self.left, self.asked = error, first, times, 0

    def __call__(self, observation: Any, number: int) -> Any:
        self.asked += 1
        if self.asked > self.first and self.left:
            self.left -= 1
            raise self.error
        return on_time(observation, number)


LOST, WRONG = PolicyLostError("no answer within 2 s"), PolicyError("actions have 3 columns")


@pytest.mark.parametrize(
    ("error", "answer", "state", "status"),
    [
        (LOST, "hold", SessionState.HOLDING, ""),
        (LOST, "stop", SessionState.READY, "failed"),
        (WRONG, "hold", SessionState.HOLDING, ""),
        (WRONG, "stop", SessionState.READY, "failed"),
    ],
)
def test_a_policy_that_fails_is_answered_as_the_deployment_says(
    tmp_path: Path, error: Exception, answer: str, state: SessionState, status: str
) -> None:
    faults = {"policy_lost": answer, "policy_error": answer}
    station = Station(stubbed(tmp_path, Failing(error, 4, 1000), faults=faults)).running(30)
    assert station.state is state
    assert str(error) in station.reason
    station.go(3)
    if status:
        assert station.coordinator.runs.last["status"] == status
    station.close()


@pytest.mark.some(1)
@pytest.mark.parametrize("error", [LOST, WRONG])
def test_slowly_means_going_on_with_what_is_planned_and_with_the_policy_when_it_is_back(
    tmp_path: Path, error: Exception
) -> None:
    faults = {"policy_lost": "slow", "policy_error": "slow"}
    station = Station(stubbed(tmp_path, Failing(error, 6, 2), faults=faults)).running(90)
    assert station.state is SessionState.RUNNING, station.reason
    assert len(station.events("policy_back")) == 1
    assert station.events("starved") == []  # what was planned has lasted
    station.close()


@pytest.mark.some(1)
@pytest.mark.parametrize("strategy", ["async", "sync", "naive", "ensemble"])
def test_a_policy_that_is_back_within_its_patience_ends_no_run_though_nothing_is_planned(
    tmp_path: Path, strategy: str
) -> None:
    policy = Failing(LOST, 6, 10**6)
    station = Station(stubbed(tmp_path, policy, strategy=strategy)).running(10)
    station.until(lambda: bool(station.events("policy_lost")), 10.0, "its loss")
    station.go(60)  # 2 s: longer than control.starvation_hold_s, shorter than faults.patience_s
    assert station.state is SessionState.RUNNING, station.reason
    assert (station.robot.sent[-5:] == station.robot.sent[-1]).all()  # it stands
    policy.left = 0
    station.go(40)
    assert station.state is SessionState.RUNNING, station.reason
    assert len(station.events("policy_back")) == 1
    assert (station.robot.sent[-1] != station.robot.sent[-5]).any()
    station.close()


def test_a_policy_that_is_lost_again_and_again_and_gives_nothing_usable_is_borne_once(tmp_path: Path) -> None:
    asked = iter(range(10**6))

    def rows(observation: Any, number: int) -> Any:
        if next(asked) % 4 == 3:
            raise LOST
        return ramp(observation.step, 3)  # over before it arrives

    station = Station(stubbed(tmp_path, rows, delay=8)).running(0)
    station.reach(SessionState.HOLDING)
    assert "no usable chunk" in station.reason
    station.close()


def test_where_starvation_holds_it_holds_though_the_policy_is_tried_again(tmp_path: Path) -> None:
    faults = {"policy_lost": "slow", "starvation": "hold"}
    station = Station(stubbed(tmp_path, Failing(LOST, 6, 10**6), faults=faults)).running(10)
    station.until(lambda: bool(station.events("policy_lost")), 10.0, "its loss")
    station.go(45)
    assert station.state is SessionState.HOLDING
    assert "no usable chunk" in station.reason
    station.close()


@pytest.mark.some(1)
@pytest.mark.parametrize("strategy", ["async", "sync"])
def test_patience_ends_in_holding_and_the_run_can_be_resumed(tmp_path: Path, strategy: str) -> None:
    policy = Failing(LOST, 6, 10**6)
    station = Station(stubbed(tmp_path, policy, strategy=strategy)).running(10)
    station.reach(SessionState.HOLDING)
    asked = policy.asked
    station.go(60)
    assert policy.asked == asked  # while it holds nobody is asked
    policy.left = 0
    station.command("resume")
    station.go(40)
    assert station.state is SessionState.RUNNING, station.reason
    station.close()


def test_the_outcome_of_a_run_tells_how_the_policy_did(tmp_path: Path) -> None:
    station = Station(stubbed(tmp_path, delay=3)).running(60)
    outcome = station.stop().outcome
    assert outcome is not None
    policy: Any = outcome["details"]["policy"] if "details" in outcome else outcome["policy"]  # type: ignore[index]
    assert policy["delay_steps"]["max"] == 3.0
    assert policy["answers"] > 5
    assert policy["starved"] == 0
    station.close()


@pytest.mark.some(1)
@pytest.mark.parametrize("strategy", ["async", "sync", "naive", "ensemble"])
def test_a_run_whose_first_action_is_farther_than_a_jump_moves_nothing_and_holds(
    tmp_path: Path, strategy: str
) -> None:
    station = Station(stubbed(tmp_path, lambda o, n: ramp(400, 20), strategy=strategy)).ready()
    station.command("run")
    station.reach(SessionState.HOLDING)
    assert "allowed 0.5 (safety.jump): approach it, or start elsewhere" in station.reason
    assert np.allclose(station.robot.sent, STANDS, atol=1e-6)
    station.command("stop")
    station.command("approach")
    station.reach(SessionState.READY)
    station.command("run")
    station.go(20)
    assert station.state is SessionState.RUNNING, station.reason
    station.close()


def closed_gripper(station: Station) -> Station:
    """Its left gripper is at one end of its travel, so that there is a way to go."""
    station.command("gripper", arm="left_arm", action="close")
    station.go(30)
    return station


def left_gripper(station: Station) -> float:
    return float(station.robot.position[LEFT_GRIPPER])


@pytest.mark.some(1)
@pytest.mark.parametrize("state", [SessionState.READY, SessionState.HOLDING])
@pytest.mark.parametrize("locked", [False, True])
def test_the_end_of_the_lease_stops_a_gripper_that_is_on_its_way(
    tmp_path: Path, state: SessionState, locked: bool
) -> None:
    station = closed_gripper(begun(tmp_path, "continuous"))
    station.command("halt" if state is SessionState.HOLDING else "stop")
    station.go(5)
    if locked:
        station.command("gripper", arm="left_arm", action="lock")
    station.command("gripper", arm="left_arm", action="open")
    station.go(3)
    station.coordinator.lease.release("lockstep", station.coordinator.lease.epoch, station.clock.now())
    station.tick()
    at = left_gripper(station)
    for _ in range(40):
        station.tick()
    assert station.state is state
    assert 0.0 < at < 0.05
    assert abs(left_gripper(station) - at) < 0.01
    station.close()


@pytest.mark.parametrize("command", ["halt", "stop"])
def test_a_stop_stops_a_gripper_that_is_on_its_way_to_its_lock(tmp_path: Path, command: str) -> None:
    station = closed_gripper(begun(tmp_path, "continuous"))
    station.command("gripper", arm="left_arm", action="open")
    station.go(1)
    at = left_gripper(station)
    station.command(command)
    station.go(40)
    assert 0.0 < at < 0.05
    assert abs(left_gripper(station) - at) < 0.01
    told = station.coordinator.snapshot()["grippers"]["left_arm"]
    assert told["locked"]
    assert told["at"] == pytest.approx(left_gripper(station), abs=1e-6)
    station.close()


def test_an_e_stop_forgets_locks_on_both_sides(tmp_path: Path) -> None:
    station = closed_gripper(begun(tmp_path, "continuous"))
    station.command("gripper", arm="left_arm", action="open")
    station.go(2)
    station.guard.press("lockstep", "a test")
    station.go(20)
    at = left_gripper(station)
    assert station.state is SessionState.FAULTED
    station.command("release")
    station.go(30)
    assert station.state is SessionState.IDLE
    assert left_gripper(station) == at
    assert not station.coordinator.snapshot()["grippers"]["left_arm"]["locked"]
    station.close()


@pytest.mark.parametrize("held", [False, True])
def test_in_simulation_no_gripper_of_the_real_robot_is_opened_or_closed(tmp_path: Path, held: bool) -> None:
    station = Station(stubbed(tmp_path, setup={"home": True})).ready()
    station.command("run", mode="sim")
    station.go(5)
    if held:
        station.command("halt")
        station.go(5)
    before = station.robot.position.copy()
    for action in ("open", "close"):
        with pytest.raises(SetupError, match=r"the run's mode is sim; allowed: lock, unlock"):
            station.command("gripper", action=action)
    station.command("gripper", action="lock")
    station.go(20)
    assert np.allclose(station.robot.position, before, atol=1e-6)
    station.close()


def test_a_chunk_is_not_committed_while_the_robot_is_on_its_way_to_it(tmp_path: Path) -> None:
    station = begun(tmp_path, "preview", lambda o, n: ramp(400, 5))
    station.command("step")
    station.go(2)
    station.command("approach")
    station.go(2)
    with pytest.raises(SetupError, match=r"moving to the start of the chunk: wait, or cancel"):
        station.command("commit")
    station.until(lambda: phase(station) == "proposed", 20.0, "to arrive")
    station.command("commit")
    station.go(3)
    assert not station.events("chunk_dropped")
    station.close()


@pytest.mark.parametrize("mode", ["step", "preview"])
def test_an_arm_that_was_moved_while_a_person_looks_holds_the_run(tmp_path: Path, mode: str) -> None:
    station = begun(tmp_path, mode)
    station.command("step")
    station.go(30)
    station.robot.blocked = True
    for _ in range(28):  # by a hand, which is seen on its way
        station.robot.position = station.robot.position + 0.02 * np.eye(14)[0]
        station.go(1)
    station.go(75)
    assert station.state is SessionState.HOLDING
    assert "from its hold target" in station.reason
    assert station.coordinator.inference.proposal is None
    if station.robot.commands:
        assert np.allclose(station.robot.sent[-1], station.robot.position, atol=0.05)
    station.close()


def test_another_instruction_makes_the_first_action_of_the_set_up_unknown(tmp_path: Path) -> None:
    station = Station(stubbed(tmp_path, lambda o, n: ramp(400, 20))).ready()
    station.command("tune", strategy={"blend_window": 4})
    assert "approach" in station.coordinator.snapshot()["allowed"]
    station.command("tune", task="something else")
    assert station.coordinator.snapshot()["first_action"] == {}
    with pytest.raises(SetupError, match=r"first action is not known: set up again"):
        station.command("approach")
    station.close()


def test_a_run_is_merged_by_the_strategy_it_was_set_up_with_also_by_a_control_that_was_restarted(
    tmp_path: Path,
) -> None:
    station = Station(stubbed(tmp_path)).ready()
    station.command("setup", strategy={"kind": "sync"})
    for _ in station.shared.rings["orders"].drain():
        pass  # a control that begins knows the deployment alone
    station.reach(SessionState.READY)
    station.command("run", trial={"id": 1})
    station.go(20)
    assert set(column(station.stop().raw, "strategy")) <= {"sync", ""}
    station.close()


def test_a_chunk_that_is_too_long_is_named_as_such(tmp_path: Path) -> None:
    station = begun(tmp_path, "continuous", lambda o, n: ramp(o.step, 20 if n < 6 else 5000))
    station.go(30)
    assert station.state is SessionState.HOLDING
    assert station.reason == "the policy answered with 5000 rows; allowed: at most 2000 in one chunk"
    station.close()


def test_a_failure_that_was_cancelled_is_not_held_against_the_next_question(tmp_path: Path) -> None:
    def rows(observation: Any, number: int) -> Any:
        raise PolicyLostError("no answer")

    station = begun(tmp_path, "step", faults={"policy_lost": "slow"})
    station.stubs.rows = rows
    station.command("step")
    station.go(15)
    assert station.coordinator.snapshot()["policy"]["lost"]
    station.command("cancel")
    assert not station.coordinator.snapshot()["policy"]["lost"]
    station.go(200)
    station.command("step")
    station.go(15)
    assert station.state is SessionState.RUNNING, station.reason
    station.close()


def test_the_end_of_a_motion_before_is_not_taken_for_the_end_of_homing(tmp_path: Path) -> None:
    station = Station(stubbed(tmp_path)).ready()
    station.command("gripper", action="open")
    station.until(
        lambda: station.shared.control.read()["behaviour"] == b"hold", 5.0, "the gripper to be open"
    )
    station.command("home")  # control has said that it is done, the coordinator has not heard it yet
    station.go(3)
    assert station.coordinator.setup.stage == "going to the pose"
    station.reach(SessionState.READY)
    assert np.abs(station.robot.position[~station.spec.limits.grippers]).max() < 1e-3
    station.close()


def test_a_gripper_that_a_policy_wants_beyond_its_travel_is_no_obstacle_to_an_approach(
    tmp_path: Path,
) -> None:
    def rows(observation: Any, number: int) -> Any:
        wanted = ramp(400, 5)
        wanted[:, LEFT_GRIPPER] = -0.002
        return wanted

    station = Station(stubbed(tmp_path, rows)).ready()
    station.command("approach")
    station.reach(SessionState.READY)
    assert left_gripper(station) == pytest.approx(0.0, abs=1e-6)
    station.command("run", mode="preview")
    station.go(3)
    station.command("step")
    station.go(3)
    station.command("approach")
    station.until(lambda: phase(station) == "proposed", 20.0, "to arrive")
    station.close()


def test_a_late_policy_that_means_to_begin_where_the_robot_stands_begins(tmp_path: Path) -> None:
    """Its first row that is not stale is farther than a jump: the robot stood meanwhile, and begins with the first."""

    def rows(observation: Any, number: int) -> Any:
        return ramp(observation.step, 50, speed=0.02)

    station = Station(stubbed(tmp_path, rows, delay=28)).ready()
    station.command("run", duration_s=1.3)
    station.go(38)
    assert station.state is SessionState.RUNNING, station.reason
    assert "begins with the first row of the answer" in station.events("far_start")[0]
    assert np.abs(np.diff(station.robot.sent, axis=0)).max() <= 0.021
    station.close()
