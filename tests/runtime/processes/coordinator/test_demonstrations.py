"""Demonstrations in lockstep: what a leader wants takes the way of a policy, what a node reports is recorded."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest

from runtime.config import loader
from runtime.core.errors import RecordingError, SetupError
from runtime.datasets.publishing import publish
from runtime.ipc.session_state import SessionState
from runtime.processes.control.process import Loop, hold_then_end, make_tick
from runtime.recording.labels import read_labels
from runtime.recording.reader import Episode
from runtime.station.checks import check_deployment
from tests.runtime.collect_station import CollectStation, SelfDriven, collecting
from tests.runtime.lockstep_station import MOVED, STANDS, column, stubbed

LEFT = MOVED[0]
SESSION = {"uuid": "00000000-0000-4000-8000-000000000007", "dataset": "cups"}


def demonstrated(station: CollectStation, ticks: int = 60, turn: float = 0.002, **run: Any) -> Episode:
    """One demonstration of a station that is armed, stopped and read."""
    station.command("run", **run)
    station.turn = turn
    station.go(ticks)
    station.turn = 0.0
    station.command("stop")
    station.go(3)
    return station.episode()


def rows_of(episode: Episode, source: str = "teleop") -> tuple[Any, np.ndarray]:
    table = episode.rows
    return table, column(table, "control_source") == source


# --- relay -------------------------------------------------------------------------------------------------


def test_the_robot_goes_where_the_leader_is_and_every_stream_is_recorded(tmp_path: Path) -> None:
    station = collecting(tmp_path).armed(task="stack the cups twice")
    episode = demonstrated(station, session=SESSION)
    table, led = rows_of(episode)
    assert led.sum() > 50
    assert (column(table, "intervention") == led).all()
    action = np.array(column(table, "action").tolist())[led]
    assert np.ptp(action[:, LEFT]) == pytest.approx(0.12, abs=0.01)
    assert np.allclose(np.delete(action, MOVED, 1), np.delete(STANDS, MOVED), atol=1e-6)
    # What the leader was at two ticks before has become the command: one to be asked, one to be merged.
    assert (np.diff(action[:, LEFT]) > 0).sum() > 50
    assert len(episode.raw) > 50
    assert (column(episode.ticks, "control_source") == "teleop").sum() > 50
    manifest = episode.manifest
    assert (manifest["kind"], manifest["mode"], manifest["strategy"]) == ("demonstration", "collect", "naive")
    assert manifest["session"] == SESSION
    assert manifest["task"] == "stack the cups twice"
    assert manifest["policy"]["kind"] == "teleop"
    assert manifest["collection"]["source"] == "relay"
    assert manifest["collection"]["cameras"] == list(manifest["cameras"])
    station.close()


def test_a_leader_says_no_chunks(tmp_path: Path) -> None:
    station = collecting(tmp_path).armed()
    station.command("run")
    station.turn, seen = 0.002, set()
    for _ in range(30):
        station.go(1)
        status = station.shared.control.read()
        seen.add((int(status["chunk"]), int(status["chunks"])))
    assert seen <= {(-1, 0), (0, 0)}, "nothing is drawn where nothing is planned in chunks"
    station.command("stop")
    station.go(3)
    assert len(station.episode().raw) > 20, "what the leader said is recorded all the same"
    station.close()


def test_the_task_of_a_run_is_that_of_its_episode_alone(tmp_path: Path) -> None:
    station = collecting(tmp_path).armed()
    assert demonstrated(station, 10, task="fold").manifest["task"] == "fold"
    assert demonstrated(station, 10).manifest["task"] == "stack the cups"
    station.close()


def test_relative_follows_the_leaders_change_from_wherever_both_are(tmp_path: Path) -> None:
    station = collecting(tmp_path, mode="relative")
    station.ready(collect=True)
    station.leader.joints[list(MOVED)] += 0.8
    station.go(2)
    station.command("arm")
    episode = demonstrated(station)
    table, led = rows_of(episode)
    action = np.array(column(table, "action").tolist())[led]
    assert action[0, LEFT] == pytest.approx(STANDS[LEFT], abs=0.02)
    assert action[-1, LEFT] == pytest.approx(STANDS[LEFT] + 0.12, abs=0.01)
    assert station.events("too_far") == station.events("far_start") == []
    station.close()


def test_relative_is_engaged_anew_after_a_halt(tmp_path: Path) -> None:
    station = collecting(tmp_path, mode="relative").armed()
    station.command("run")
    station.go(10)
    station.command("halt")
    station.go(20)
    station.leader.joints[LEFT] += 0.5
    stood = station.robot.position[LEFT]
    station.command("resume")
    station.go(20)
    assert station.robot.position[LEFT] == pytest.approx(stood, abs=1e-3)
    station.close()


def test_no_demonstration_lowers_an_arm_that_stands_below_its_command(tmp_path: Path) -> None:
    station = collecting(tmp_path, mode="relative")
    station.ready(collect=True)
    station.robot.bias[LEFT] = -0.09
    station.command("arm")
    demonstrated(station, 20, turn=0.0)
    told = station.robot.commands[-1].action.copy()
    for _ in range(3):
        demonstrated(station, 20, turn=0.0)
    assert station.robot.commands[-1].action == pytest.approx(told, abs=1e-6)
    station.close()


def test_what_a_leader_did_while_joints_were_missing_is_not_caught_up(tmp_path: Path) -> None:
    station = collecting(tmp_path, mode="relative").armed()
    station.command("run")
    station.go(20)
    stood = station.robot.commands[-1].action[LEFT]
    station.robot.silent, station.turn = True, 0.01
    station.go(24)
    station.robot.silent, station.turn = False, 0.0
    station.go(20)
    assert station.events("joints_back")
    assert station.robot.commands[-1].action[LEFT] == pytest.approx(stood, abs=0.08)
    station.turn = 0.01
    station.go(20)
    assert station.robot.commands[-1].action[LEFT] > stood + 0.1
    station.close()


def test_a_leader_that_is_far_away_is_approached_before_it_is_followed(tmp_path: Path) -> None:
    station = collecting(tmp_path)
    station.ready(collect=True)
    station.leader.joints[LEFT] += 1.2
    station.go(2)
    assert station.coordinator.snapshot()["first_action"]["far"]
    station.command("arm")
    station.command("run")
    station.go(10)
    assert station.state is SessionState.HOLDING
    assert "1.20 rad" in station.reason
    assert not station.collect["armed"]
    assert "1.20 rad" in station.collect["why_not"]
    station.command("stop")
    station.go(3)
    station.command("approach")
    station.reach(SessionState.READY)
    assert station.robot.position[LEFT] == pytest.approx(station.leader.joints[LEFT], abs=0.01)
    station.command("arm")
    station.command("run")
    station.go(10)
    assert station.state is SessionState.RUNNING
    station.close()


def test_a_leader_that_falls_silent_holds_the_robot_and_takes_the_arm(tmp_path: Path) -> None:
    station = collecting(tmp_path).armed()
    station.command("run")
    station.turn = 0.002
    station.go(30)
    station.leader.silent = True
    station.go(20)
    assert station.state is SessionState.HOLDING
    assert "last message" in station.reason
    assert station.events("starvation") == []
    assert not station.collect["armed"]
    stood = station.robot.position.copy()
    station.leader.silent, station.turn = False, 0.0
    station.go(20)
    assert (station.robot.position == stood).all()
    with pytest.raises(SetupError, match="arm first"):
        station.command("resume")
    station.close()


def test_what_a_leader_wants_is_limited_by_safety_like_anything_else(tmp_path: Path) -> None:
    station = collecting(tmp_path).armed()
    station.command("run")
    station.go(10)
    station.turn = 0.2  # 6 rad/s
    station.go(6)
    speed = np.abs(np.diff(station.robot.sent[:, LEFT])).max() * 30
    assert speed <= station.spec.robot.velocity[LEFT] + 1e-6
    station.close()


def test_no_leader_fails_the_set_up_with_its_sentence(tmp_path: Path) -> None:
    station = collecting(tmp_path)
    station.stubs.mute = True
    station.prepare(collect=True)
    assert station.state is SessionState.IDLE
    assert "the leader in the test says nothing" in station.reason
    station.close()


# --- node --------------------------------------------------------------------------------------------------


def test_a_node_that_drives_is_told_so_five_times_and_what_it_reports_is_the_action(tmp_path: Path) -> None:
    station = collecting(tmp_path, "node").armed()
    robot = station.robot
    assert isinstance(robot, SelfDriven)
    sent = len(robot.commands)
    station.command("run")
    station.go(60)
    assert len(robot.commands) == sent  # nothing of ours
    assert station.coordinator.snapshot()["control"]["behaviour"] == "yield"
    assert station.collect["leader"]["state"] == "alive"
    station.command("stop")
    station.go(10)
    assert [word for word, _ in robot.told] == ["collect_start"] * 5 + ["collect_stop"] * 5
    table, led = rows_of(station.episode())
    assert led.sum() >= 50
    assert led[:-3].all()
    action, state = (np.array(column(table, name).tolist()) for name in ("action", "qpos"))
    assert np.allclose(action[led] - state[led], 0.01, atol=1e-6)
    assert (column(table, "intervention") == led).all()
    assert len(robot.commands) == sent
    station.close()


def outlived(station: CollectStation, seconds: float = 5.0) -> float:
    """How long control goes on after its supervisor has ended [s]."""
    began = station.clock.now()
    loop = Loop(station._tick, station.shared, station.clock, station.spec.rate, "virtual")
    hold_then_end(loop, station._tick, station.shared, station.clock, seconds)
    return station.clock.now() - began


@pytest.mark.parametrize("hold_s", [0.0, 5.0])
def test_a_node_that_drives_when_the_station_ends_is_told_to_end_however_short_it_holds(
    tmp_path: Path, hold_s: float
) -> None:
    station = collecting(tmp_path, "node").armed()
    station.command("run")
    station.go(30)
    assert outlived(station, hold_s) < 1.0
    assert [word for word, _ in station.robot.told] == ["collect_start"] * 5 + ["collect_stop"] * 5
    station.close()


def test_a_node_that_is_being_told_to_end_when_the_station_ends_is_told_all_of_it(tmp_path: Path) -> None:
    station = collecting(tmp_path, "node").armed()
    station.command("run")
    station.go(30)
    station.command("stop")
    while [word for word, _ in station.robot.told].count("collect_stop") < 2:
        station.go(1)
    outlived(station)
    assert [word for word, _ in station.robot.told].count("collect_stop") == 5
    station.close()


def test_a_control_that_died_while_a_node_drove_and_ends_with_its_station_tells_the_node(
    tmp_path: Path,
) -> None:
    station = collecting(tmp_path, "node").armed()
    station.command("run")
    station.go(30)
    station._tick = make_tick(station.spec, station.shared, station.robot, station.clock.now)
    outlived(station)
    assert [word for word, _ in station.robot.told].count("collect_stop") == 5
    station.close()


def test_a_robot_that_is_held_when_the_station_ends_is_held_for_that_long_and_a_silent_one_is_not(
    tmp_path: Path,
) -> None:
    station = collecting(tmp_path)
    assert outlived(station) < 0.1
    assert station.robot.commands == []
    station.close()
    station = collecting(tmp_path).armed()
    station.command("run")
    station.go(10)
    sent = len(station.robot.commands)
    assert outlived(station) == pytest.approx(5.0, abs=0.1)
    assert len(station.robot.commands) - sent == pytest.approx(5.0 * station.spec.rate, abs=3)
    station.close()


def test_a_node_that_reports_no_action_fails_the_run_within_two_seconds(tmp_path: Path) -> None:
    station = collecting(tmp_path, "node").armed()
    station.robot.leaderless = True  # type: ignore[attr-defined]
    station.command("run")
    station.go(55)
    assert station.state is SessionState.RUNNING
    station.go(15)
    assert station.state is SessionState.READY
    assert "reports no action within 2 s" in station.reason
    assert not station.collect["armed"]
    station.go(5)
    assert station.robot.told[-1][0] == "collect_stop"
    assert station.coordinator.runs.last_episode["status"] == "failed"
    assert station.coordinator.runs.last_episode["rows"] == 0
    station.close()


def test_a_node_that_stops_reporting_is_told_to_end_and_the_episode_is_kept_open(tmp_path: Path) -> None:
    station = collecting(tmp_path, "node").armed()
    station.command("run")
    station.go(40)
    station.robot.leaderless = True  # type: ignore[attr-defined]
    station.go(70)
    assert station.state is SessionState.HOLDING
    assert "has reported no action for" in station.reason
    station.go(6)
    assert station.robot.told[-1][0] == "collect_stop"
    station.command("stop")
    station.go(3)
    sources = column(station.episode().rows, "control_source").tolist()
    assert sources.count("none") >= 60
    assert sources.count("teleop") >= 35
    station.close()


@pytest.mark.parametrize("cause", ["e-stop", "lease", "coordinator"])
def test_whatever_stops_us_stops_the_node_too(tmp_path: Path, cause: str) -> None:
    station = collecting(tmp_path, "node").armed()
    station.command("run")
    station.go(20)
    assert station.robot.collects  # type: ignore[attr-defined]
    if cause == "e-stop":
        station.guard.press("anna", "a test")
        station.go(10)
    elif cause == "lease":
        station.coordinator.lease.release("lockstep", station.coordinator.lease.epoch, station.clock.now())
        for _ in range(10):
            station.tick()
    else:
        for _ in range(45):  # control sees that nobody is there after a second
            station._tick(station.step, station.clock.now())
            station.step += 1
            station.clock.sleep_until(station.step / station.spec.rate)
    assert not station.robot.collects  # type: ignore[attr-defined]
    assert [word for word, _ in station.robot.told].count("collect_stop") == 5
    if cause != "coordinator":
        assert not station.collect["armed"]
    station.close()


# --- arm, set-up, modes ------------------------------------------------------------------------------------


def test_nothing_begins_before_it_is_armed_and_the_arm_stays_for_the_next_episode(tmp_path: Path) -> None:
    station = collecting(tmp_path)
    station.ready(collect=True)
    assert "not armed since" in station.collect["why_not"]
    with pytest.raises(SetupError, match="arm first"):
        station.command("run")
    station.command("arm")
    demonstrated(station, 10)
    assert station.collect["armed"]
    first = station.collect["last"]["uuid"]
    demonstrated(station, 10)
    assert station.collect["last"]["uuid"] != first
    station.command("disarm")
    assert station.collect["why_not"] == "by lockstep"
    station.close()


@pytest.mark.some(3)
@pytest.mark.parametrize("cause", ["lease", "e-stop", "link", "set-up", "nothing", "leader", "moved"])
def test_the_arm_falls_with_its_sentence(tmp_path: Path, cause: str) -> None:
    station = collecting(tmp_path).armed()
    station.go(2)
    if cause == "lease":
        station.coordinator.lease.release("lockstep", station.coordinator.lease.epoch, station.clock.now())
        station.tick()
    elif cause == "e-stop":
        station.guard.press("anna", "a test")
        station.go(3)
    elif cause == "link":
        station.robot.silent = True
        station.go(90)
    elif cause == "set-up":
        station.prepare(collect=True)
    elif cause == "leader":
        station.leader.silent = True
        station.go(15)
    elif cause == "moved":
        station.command("home")
        station.reach(SessionState.READY)
        station.robot.blocked = True
        station.robot.position[LEFT] += 1.0
        station.go(30)
    else:
        station.coordinator.collecting._touched -= 300.0
        station.go(2)
    assert not station.collect["armed"]
    assert station.collect["why_not"]
    assert len(station.events("collect_disarmed")) == 1
    station.close()


def test_a_station_set_up_to_collect_runs_no_policy_and_one_with_a_policy_collects_nothing(
    tmp_path: Path,
) -> None:
    station = collecting(tmp_path).armed()
    for mode in ("continuous", "step", "preview", "sim"):
        with pytest.raises(SetupError, match="set up to collect"):
            station.command("run", mode=mode)
    with pytest.raises(SetupError, match="strategy while the station is set up to collect"):
        station.command("tune", strategy={"kind": "async"})
    station.ready()
    assert station.coordinator.spec.deployment.strategy.kind == "async"
    with pytest.raises(SetupError, match="set up with collect = true first"):
        station.command("run", mode="collect")
    with pytest.raises(SetupError, match="set up with collect first"):
        station.command("arm")
    with pytest.raises(SetupError, match="task with mode = 'continuous'"):
        station.command("run", task="fold")
    station.command("run")
    station.go(20)
    assert station.stop().manifest["kind"] == "rollout"
    station.close()


@pytest.mark.parametrize(
    ("transport", "leader"), [({"kind": "ros2", "domain": 77}, "ros2"), ({"kind": "dataset"}, "zmq")]
)
def test_a_node_that_cannot_be_told_to_leave_off_is_refused(
    tmp_path: Path, transport: dict[str, Any], leader: str
) -> None:
    if leader == "ros2":
        pytest.importorskip("cyclonedds", reason="the package cyclonedds (extra ros2) is not installed")
    else:
        transport = {**transport, "path": str(tmp_path)}
    tree = {
        "station": "bench",
        "robot": "r1_lite",
        "data_dir": str(tmp_path),
        "task": "wave",
        "transport": transport,
        "collection": {"source": "node"},
        "recording": {"min_free_bytes": 0},
    }
    with pytest.raises(SetupError, match=r"switch a robot's own leader on and off.*nor report") as refused:
        check_deployment(loader.resolve_deployment(tree, {}, "test"))
    assert f"collection.leader.kind = '{leader}'" in str(refused.value)


@pytest.mark.parametrize("given", [{"policy": {"kind": "mock"}}, {"strategy": {"kind": "sync"}}])
def test_a_set_up_to_collect_takes_no_policy(tmp_path: Path, given: dict[str, Any]) -> None:
    station = collecting(tmp_path)
    with pytest.raises(SetupError, match="a person drives"):
        station.ready(collect=True, **given)
    station.close()


def test_a_deployment_without_a_collection_says_so(tmp_path: Path) -> None:
    from tests.runtime.lockstep_station import Station

    station = Station(stubbed(tmp_path)).ready()
    assert station.coordinator.snapshot()["collect"] is None
    with pytest.raises(SetupError, match=r"no \[collection\]"):
        station.command("setup", collect=True)
    with pytest.raises(SetupError, match=r"no \[collection\]"):
        station.command("label", result="success")
    station.close()


def test_a_snapshot_says_what_the_next_episode_will_be_like_in_the_words_of_its_manifest(
    tmp_path: Path,
) -> None:
    cameras = list(stubbed(tmp_path).spec.cameras)[:2]
    station = collecting(tmp_path, cameras=cameras, columns=["eef"])
    assert station.collect["setup"] is None
    station.armed()
    told = station.collect["setup"]
    manifest = demonstrated(station).manifest
    assert told == {
        "robot": manifest["robot"]["name"],
        "groups": list(dict.fromkeys(name.partition(".")[0] for name in manifest["robot"]["joint_names"])),
        "joints": manifest["robot"]["joint_names"],
        "cameras": manifest["cameras"],
        "fps": manifest["fps"],
        "streams": manifest["streams"],
    }
    assert list(told["cameras"]) == cameras
    assert told["streams"] == {"qvel": False, "effort": False, "eef": True, "eef_action": False}
    station.close()


# --- what is recorded --------------------------------------------------------------------------------------


def test_only_the_cameras_and_columns_of_the_schema_are_recorded(tmp_path: Path) -> None:
    cameras = [camera.key for camera in collecting(tmp_path / "other").spec.robot.cameras][:1]
    station = collecting(tmp_path, cameras=cameras, columns=["eef"], primary_camera=cameras[0]).armed()
    manifest = demonstrated(station, 10).manifest
    assert list(manifest["cameras"]) == cameras
    assert manifest["streams"] == {"qvel": False, "effort": False, "eef": True, "eef_action": False}
    assert manifest["collection"]["primary_camera"] == cameras[0]
    station.close()


def test_an_episode_does_not_begin_without_what_the_schema_asks_for(tmp_path: Path) -> None:
    station = collecting(tmp_path, streams=["effort"]).armed()
    station.command("run")
    station.go(5)
    assert station.state is SessionState.READY
    assert "measures no effort" in station.reason
    station.close()


# --- labels ------------------------------------------------------------------------------------------------


def test_labels_are_lines_of_which_the_newest_counts(tmp_path: Path) -> None:
    station = collecting(tmp_path).armed()
    with pytest.raises(SetupError, match="no demonstration has been collected"):
        station.command("label", result="fail")
    episode = demonstrated(station, 10).manifest["uuid"]
    station.command("label", result="partial")
    station.command("label", result="success", note="slow")
    said = read_labels(tmp_path, episode)
    assert [(label.result, label.note, label.by) for label in said] == [
        ("partial", "", "lockstep"),
        ("success", "slow", "lockstep"),
    ]
    assert station.collect["last"]["result"] == "success"
    assert station.events("labelled")[-1] == f"episode {episode}: success"
    station.close()


def test_discarding_ends_the_open_episode_keeps_its_files_and_the_next_may_begin(tmp_path: Path) -> None:
    station = collecting(tmp_path).armed()
    station.command("run")
    station.go(20)
    episode = station.collect["episode"]
    station.command("discard")
    assert station.state is SessionState.READY
    station.command("run")
    station.go(10)
    assert station.collect["last"] == {
        "uuid": episode,
        "rows": station.collect["last"]["rows"],
        "result": None,
        "discarded": True,
    }
    assert (tmp_path / "episodes" / episode / "outcome.json").exists()
    assert station.collect["episode"] not in (None, episode)
    station.command("label", episode=episode, result="fail")
    assert [label.discarded for label in read_labels(tmp_path, episode)] == [True, True]
    assert station.state is SessionState.RUNNING
    with pytest.raises(SetupError, match="is the open one"):
        station.command("discard", episode=station.collect["episode"])
    station.close()


def test_only_demonstrations_that_are_here_are_labelled(tmp_path: Path) -> None:
    station = collecting(tmp_path)
    rollout = station.running().stop().manifest["uuid"]
    for name, why in ((rollout, "is a rollout"), ("../x", "uuid"), (SESSION["uuid"], "no such episode")):
        with pytest.raises(SetupError, match=why):
            station.command("label", episode=name, result="success")
    assert not (tmp_path / "labels").exists()
    station.close()


def test_an_episode_that_is_too_short_is_said_to_be(tmp_path: Path) -> None:
    station = collecting(tmp_path, min_length_s=0.5).armed()
    demonstrated(station, 10)
    assert "shorter than 0.5 s" in station.events("episode_short")[0]
    demonstrated(station, 30)
    assert len(station.events("episode_short")) == 1
    station.close()


def test_what_is_discarded_is_never_published_and_a_label_is_the_success(tmp_path: Path) -> None:
    station = collecting(tmp_path).armed()
    kept, thrown = (Path(demonstrated(station, 20).path) for _ in range(2))
    station.command("discard")
    station.command("label", episode=kept.name, result="success")
    with pytest.raises(RecordingError, match="was discarded by lockstep"):
        publish(thrown, tmp_path / "datasets" / "cups")
    publish(kept, tmp_path / "datasets" / "cups")
    table = pq.read_table(next((tmp_path / "datasets" / "cups" / "data").rglob("*.parquet")))
    assert table.num_rows >= 20
    assert column(table, "next.success")[-1]
    station.close()
