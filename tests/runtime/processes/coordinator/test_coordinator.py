"""What the coordinator notices and tells, in whole stations in lockstep."""

from pathlib import Path

import numpy as np
import pytest

from runtime.core.errors import SetupError
from runtime.ipc.messages import NO_SUBSCRIBER, Command, EpisodeOpened, Event, encode
from runtime.ipc.session_state import SessionState
from runtime.ipc.shared_state import EStop, RecorderStage
from tests.processes import PATIENCE_S
from tests.runtime.lockstep_station import STANDS, Station, column, ramp, stubbed


def without(station: Station, process: str, seconds: float) -> None:
    """Let everything go on but the heartbeat of `process`."""
    beat = station.shared.beat
    station.shared.beat = lambda name, now: None if name == process else beat(name, now)
    station.go(int(seconds * station.spec.rate))
    station.shared.beat = beat


@pytest.mark.parametrize("process", ["control", "reception"])
def test_a_process_that_hangs_in_a_run_holds_it_and_is_named(tmp_path: Path, process: str) -> None:
    station = Station(stubbed(tmp_path)).running(10)
    without(station, process, 0.5)
    assert station.state is SessionState.RUNNING
    without(station, process, 1.5)
    assert station.state is SessionState.HOLDING
    assert f"no sign of life from the process {process}" in station.reason
    station.go(1)
    station.command("resume")
    station.go(5)
    assert station.state is SessionState.RUNNING
    station.close()


def hanging(station: Station, seconds: float) -> None:
    """Let everything go on but media, which reads nothing meanwhile."""
    digest, station.media.poll = station.media.poll, lambda: None
    without(station, "media", seconds)
    station.media.poll = digest


def test_a_recorder_that_hangs_in_a_run_is_told_once_and_loses_nothing_of_it(tmp_path: Path) -> None:
    station = Station(stubbed(tmp_path)).running(10)
    with station.shared.recorder_stage(RecorderStage.CLOSING):
        hanging(station, 8.0)
    station.go(2)
    assert station.state is SessionState.RUNNING
    (late,) = station.events("recording_late")
    assert "for 5.0 s, while closing an episode" in late
    assert len(station.events("recording_goes_on")) == 1
    episode = station.stop()
    steps = np.diff(column(episode.rows, "step"))
    assert len(steps) > 8.0 * station.spec.rate
    assert (steps == 1).all()
    station.close()


def test_a_run_is_held_before_what_waits_to_be_recorded_is_lost_and_none_begins_meanwhile(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    station = Station(stubbed(tmp_path)).running(10)
    monkeypatch.setattr(type(station.shared.rings["ticks"]), "fill", property(lambda ring: 0.6))
    hanging(station, 4.0)
    assert station.state is SessionState.RUNNING
    hanging(station, 6.0)
    assert station.state is SessionState.HOLDING
    assert "no sign of life from the process media" in station.reason
    assert "more than half of the room" in station.reason
    station.shared.beat = lambda name, now: None
    with pytest.raises(SetupError, match="media"):
        station.command("resume")
    station.close()


@pytest.mark.parametrize(
    ("answer", "state"),
    [("slow", SessionState.HOLDING), ("hold", SessionState.HOLDING), ("stop", SessionState.READY)],
)
def test_a_run_whose_chunks_all_come_too_late_is_ended_by_the_rule_of_starvation(
    tmp_path: Path, answer: str, state: SessionState
) -> None:
    late = stubbed(tmp_path, lambda seen, number: ramp(seen.step, 2), delay=4, faults={"starvation": answer})
    station = Station(late).ready()
    station.command("run")
    station.reach(state, PATIENCE_S)
    assert "no usable chunk" in station.reason
    assert "all in the past" in station.events("chunk_dropped")[0]
    station.close()


@pytest.mark.some(2)
@pytest.mark.parametrize(
    ("answer", "state"),
    [("slow", SessionState.HOLDING), ("hold", SessionState.HOLDING), ("stop", SessionState.READY)],
)
def test_a_run_of_which_no_answer_can_be_used_is_ended_by_the_rule_of_errors(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, answer: str, state: SessionState
) -> None:
    station = Station(stubbed(tmp_path, faults={"policy_error": answer, "starvation": "slow"})).ready()
    monkeypatch.setattr(station.coordinator.inference.requests, "log_ik_problems", lambda answered: [][0])
    station.command("run")
    station.reach(state, PATIENCE_S)
    assert "the policy's answer cannot be used: IndexError" in station.reason
    station.close()


def test_an_arm_that_was_moved_while_ready_makes_the_station_idle_and_stays_where_it_is(
    tmp_path: Path,
) -> None:
    station = Station(stubbed(tmp_path)).running(10)
    station.stop()
    station.robot.blocked = True
    moved = STANDS.copy()
    for _ in range(28):  # by a hand, which is seen on its way
        moved[0] += 0.02
        station.robot.position = moved.copy()
        station.go(1)
    station.go(75)
    assert station.state is SessionState.IDLE
    assert "0.5" in station.reason  # by which it is known that it was moved; where it ends is followed
    assert "from its hold target" in station.reason
    arms = [dim for dim in range(len(STANDS)) if dim not in station.spec.robot.gripper_dims]
    assert np.allclose(station.robot.sent[-1][arms], moved[arms], atol=0.05)
    station.close()


def test_cameras_that_send_nothing_are_named(tmp_path: Path) -> None:
    station = Station(stubbed(tmp_path))
    station.robot.cameras.remove("cam_left_wrist")
    station.go(10)
    assert station.state is SessionState.DISCONNECTED
    assert station.reason == "no picture has arrived from cam_left_wrist"
    sequence = station.coordinator.session.sequence
    station.go(30)
    assert station.coordinator.session.sequence == sequence  # told once: nothing grows stale by it
    station.shared.set_estop(EStop.LATCHED)
    station.go(10)
    told = station.coordinator.snapshot()["state_is"]
    assert (told["latched"], told["connected"]) == (True, False)
    station.close()


def test_a_recording_without_a_run_that_fails_is_over_and_a_run_may_begin(tmp_path: Path) -> None:
    station = Station(stubbed(tmp_path)).ready()
    station.command("record_start")
    station.go(5)
    station.robot.picture = lambda number: np.zeros((2, 2, 3), np.uint8)  # a camera that changes its size
    station.go(5)
    assert station.events("recording_failed")
    assert station.coordinator.runs.last_episode["status"] == "failed"
    with pytest.raises(SetupError, match="no recording is open"):
        station.command("record_stop")
    station.command("run")
    station.go(3)
    assert station.state is SessionState.RUNNING
    station.close()


def restarted(station: Station, process: str) -> None:
    """As the supervisor says it."""
    station.shared.set_generation(process, station.shared.generation(process) + 1)
    station.go(3)


def test_the_death_of_control_closes_a_recording_without_a_run_and_a_run_records_its_own(
    tmp_path: Path,
) -> None:
    station = Station(stubbed(tmp_path)).ready()
    alone = station.command("record_start").data["episode"]
    station.go(5)
    restarted(station, "control")
    assert (station.state, station.media.recording) == (SessionState.IDLE, False)
    ended = station.coordinator.runs.last_episode
    assert (ended["uuid"], ended["status"]) == (alone, "interrupted")
    assert ended["reason"] == "the process control died and was restarted: set up again"
    station.ready()
    own = station.command("run").data["episode"]
    station.go(5)
    assert station.state is SessionState.RUNNING
    assert station.stop().manifest["uuid"] == own
    station.close()


def test_the_death_of_the_guard_leaves_a_recording_without_a_run_open_until_it_is_stopped(
    tmp_path: Path,
) -> None:
    station = Station(stubbed(tmp_path)).ready()
    alone = station.command("record_start").data["episode"]
    station.go(5)
    restarted(station, "guard")
    assert (station.state, station.media.recording) == (SessionState.IDLE, True)
    station.ready()
    with pytest.raises(SetupError, match="a recording without a run is open: record stop first"):
        station.command("run")
    station.command("record_stop")
    station.go(3)
    ended = station.coordinator.runs.last_episode
    assert (ended["uuid"], ended["status"]) == (alone, "finished")
    station.command("run")
    station.go(5)
    assert station.stop().frames > 0
    station.close()


def test_a_process_that_was_restarted_and_says_nothing_yet_is_not_told_to_be_silent_since_the_machine_started(
    tmp_path: Path,
) -> None:
    station = Station(stubbed(tmp_path)).running(180)  # longer than the recorder may be silent
    station.shared.beat("media", 0.0)  # as the supervisor does before it starts one anew
    beat = station.shared.beat
    station.shared.beat = lambda name, now: None if name == "media" else beat(name, now)
    station.go(3)
    assert station.reason == "no sign of life from the process media since it was restarted"
    station.shared.beat = beat
    station.close()


def test_resume_is_refused_under_an_id_of_its_own_while_a_process_is_starting(tmp_path: Path) -> None:
    station = Station(stubbed(tmp_path)).running(180)  # longer than the recorder may be silent
    station.shared.beat("media", 0.0)  # as the supervisor does before it starts one anew
    beat = station.shared.beat
    station.shared.beat = lambda name, now: None if name == "media" else beat(name, now)
    station.go(3)
    refused = station._handle("resume")
    assert (refused.status, refused.id) == (
        "refused",
        "operations.family_starting",
    )  # by which pages ask again
    assert refused.arguments == {"process": "media"}
    station.shared.beat = beat
    station.go(3)
    station.command("resume")
    station.close()


def test_the_snapshot_says_how_the_last_run_ended(tmp_path: Path) -> None:
    station = Station(stubbed(tmp_path, run={"duration_s": 0.5}))
    station.running(30)
    shown = station.coordinator.snapshot()
    assert shown["state"] == "ready"
    assert shown["last_run"]["status"] == "finished"
    assert shown["last_run"]["reason"] == "the run's 0.5 s are over"
    assert shown["run"]["number"] == 0
    station.close()


@pytest.mark.parametrize("how", ["stop", "estop"])
def test_a_media_that_does_not_read_keeps_nobody_from_stopping(tmp_path: Path, how: str) -> None:
    station = Station(stubbed(tmp_path)).running(10)
    station.shared.rings["minutes"].push = lambda payload: False
    if how == "stop":
        station.command("stop")
    else:
        station.guard.press("anna", "a test")
    station.go(10)
    assert station.state is (SessionState.READY if how == "stop" else SessionState.FAULTED)
    assert station.coordinator.run is None
    station.close()


def test_a_query_with_nonsense_is_refused_and_nothing_ends(tmp_path: Path) -> None:
    station = Station(stubbed(tmp_path))
    ack = station.coordinator.handle(Command("1", "events_since", {"number": "seven"}))
    assert ack.status == "refused"
    assert "'seven': must be a whole number" in ack.reason
    station.close()


def test_a_media_that_does_not_read_costs_the_record_and_not_the_station(tmp_path: Path) -> None:
    station = Station(stubbed(tmp_path)).running(10)
    station.shared.rings["minutes"].push = lambda payload: False
    station.media.poll = lambda: None
    station.go(20)
    assert station.state in (SessionState.RUNNING, SessionState.HOLDING)
    assert np.isfinite(station.robot.sent).all()
    station.close()


def test_events_from_before_main_was_there_are_kept_and_nothing_that_was_told_is_acted_on(
    tmp_path: Path,
) -> None:
    station = Station(stubbed(tmp_path)).ready()
    rings, told = station.shared.rings, {"unheard": {"left_arm": "nobody listens"}}
    rings["media_events"].push(encode(Event("source_frozen_cam_high", "the same picture", 0.1)))
    rings["media_events"].push(encode(EpisodeOpened(1, "one", "", "no room")))
    rings["control_events"].push(encode(Event(NO_SUBSCRIBER, "nobody listens", 0.1, data=told)))
    rings["control_events"].push(encode(Event("displaced", "the arm was moved", 0.1)))
    station.restart_coordinator()
    assert [event["kind"] for event in station.coordinator.events.since(0)] == [
        NO_SUBSCRIBER,
        "displaced",
        "source_frozen_cam_high",
    ]
    assert station.coordinator.inbox.unheard == told["unheard"]
    assert station.state is SessionState.DISCONNECTED  # as it begins, until it has looked itself
    assert station.reason == "waiting for the first observation"
    station.close()
