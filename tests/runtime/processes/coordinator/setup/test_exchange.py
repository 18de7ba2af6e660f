"""What a set-up may change: another policy, another task, a bench laid out anew; in whole stations in lockstep."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import pytest

from runtime.benches.schema import load_schema
from runtime.config import loader
from runtime.core.errors import ConfigurationError, SetupError
from runtime.ipc.session_state import SessionState
from tests.runtime.lockstep_station import Station, on_time, stubbed

OTHER = {"amplitude": 0.1}  # of the mock policy, whose default is 0.2
BENCH = {"id": "reset-1", "seed": 7, "positions": {"block": [0.1, 0.3, 45.0]}}


def simulated(folder: Path, **settings: Any) -> Station:
    return Station(stubbed(folder, simulated=True, **settings))


# --- the policy --------------------------------------------------------------------------------------------


def test_another_policy_takes_the_place_of_the_former_which_is_closed_first(tmp_path: Path) -> None:
    station = Station(stubbed(tmp_path)).ready()
    station.ready(policy=OTHER)
    former, other = station.policies
    assert former.calls == ["connect", "reset", "infer", "infer", "close"]
    assert other.calls == ["connect", "reset", "infer", "infer"]
    station.command("run")
    station.go(20)
    assert other.calls.count("infer") > 3
    assert former.calls[-1] == "close"
    station.close()
    assert other.calls[-1] == "close"


def test_a_policy_whose_module_cannot_be_loaded_is_refused_by_name_and_the_station_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "runtime.policies.starvla", None)
    station = Station(stubbed(tmp_path)).ready()
    with pytest.raises(SetupError, match=r"'starvla' cannot be loaded: .*starvla.py: ModuleNotFoundError"):
        station.command("setup", policy={"kind": "starvla", "url": "ws://127.0.0.1:1"})
    station.command("run")
    station.go(20)
    assert station.state is SessionState.RUNNING
    station.close()


def test_the_same_policy_is_kept_and_connected_anew(tmp_path: Path) -> None:
    station = Station(stubbed(tmp_path)).ready(policy={"amplitude": 0.2})
    station.ready(policy={"kind": "mock"})
    assert station.policies == [station.policy]
    assert station.policy.calls.count("connect") == 2
    assert "close" not in station.policy.calls
    station.close()


def test_a_set_up_that_names_none_takes_the_deployments_own_again(tmp_path: Path) -> None:
    station = Station(stubbed(tmp_path, policy={"period_s": 5.0}))
    station.ready(policy=OTHER)
    assert station.coordinator.spec.deployment.policy.period_s == 5.0  # merged over the deployment's own
    station.ready(policy={"horizon": 20})
    assert station.coordinator.spec.deployment.policy.amplitude == 0.2  # not over what was set up before
    station.ready()
    assert station.coordinator.spec.resolved == station.spec.resolved
    assert len(station.policies) == 4
    station.close()


REFUSED = {
    "an unknown setting": (
        {"policy": {"amplitud": 0.1}},
        r"setup: policy\.amplitud = 0\.1: unknown key \(did you mean amplitude\?\); allowed here: amplitude",
    ),
    "a setting out of bounds": ({"policy": {"amplitude": 2.0}}, r"setup: policy\.amplitude = 2\.0: "),
    "an unknown kind": (
        {"policy": {"kind": "telepathy"}},
        r"setup: policy\.kind = 'telepathy': must be one of 'external', 'gr00t', 'lerobot', 'mock', 'none', 'openpi'",
    ),
    "an address that is none": (
        {"policy": {"kind": "openpi", "url": "http://there"}},
        r"setup: policy\.url = 'http://there': ",
    ),
    "a key that is no argument": (
        {"plicy": OTHER},
        r"setup: plicy = .*allowed here: bench, checkpoint, collect, least, policy",
    ),
    "a bench where there is none": (
        {"policy": OTHER, "bench": {"seed": 1}},
        "bench with seed 1: the transport is not declared simulated; allowed: no bench, or a node",
    ),
}


@pytest.mark.some(3)
@pytest.mark.parametrize(("arguments", "sentence"), REFUSED.values(), ids=REFUSED.keys())
def test_a_refused_set_up_leaves_everything_as_it_was(
    tmp_path: Path, arguments: dict[str, Any], sentence: str
) -> None:
    station = Station(stubbed(tmp_path)).ready(task="first", checkpoint={"id": 1, "name": "A"})
    before, calls = station.coordinator.spec, list(station.policy.calls)
    with pytest.raises(SetupError, match=sentence):
        station.command("setup", **arguments)
    assert station.state is SessionState.READY
    assert station.coordinator.spec is before
    assert station.coordinator.inference.policy is station.policy
    assert station.policy.calls == calls
    assert station.policies == [station.policy]
    assert station.coordinator.snapshot()["checkpoint"] == {"id": 1, "name": "A"}
    station.command("run")
    station.go(10)
    assert station.state is SessionState.RUNNING
    station.close()


def test_a_policy_that_does_not_fit_the_robot_is_refused_before_the_former_is_closed(tmp_path: Path) -> None:
    station = Station(stubbed(tmp_path)).ready()
    station.stubs.unfit = ConfigurationError("policy.cameras names nose")
    with pytest.raises(SetupError, match=r"policy\.cameras names nose"):
        station.command("setup", policy=OTHER)
    assert station.coordinator.inference.policy is station.policy
    assert "close" not in station.policy.calls
    station.close()


def test_a_policy_whose_own_code_fails_is_refused_and_ends_nothing(tmp_path: Path) -> None:
    station = Station(stubbed(tmp_path)).ready()
    station.stubs.unfit = ZeroDivisionError("0 / 0")
    with pytest.raises(SetupError, match="policy 'mock' cannot be created: ZeroDivisionError: 0 / 0"):
        station.command("setup", policy=OTHER)
    assert (station.state, station.coordinator.inference.policy) == (SessionState.READY, station.policy)
    station.close()


def test_the_manifest_says_what_was_really_used(tmp_path: Path) -> None:
    station = Station(stubbed(tmp_path)).ready(policy=OTHER, task="fold", checkpoint={"id": 7, "name": "B"})
    station.command("run")
    station.go(20)
    manifest = station.stop().manifest
    expected = loader.apply_changes(station.spec.resolved, {"policy": OTHER, "task": "fold"}, "test")
    assert manifest["configuration"] == expected.tree
    assert manifest["configuration_hash"] == expected.digest != station.spec.resolved.digest
    assert manifest["task"] == "fold"
    assert manifest["checkpoint"] == {"id": 7, "name": "B"}
    station.ready()
    station.command("run")
    station.go(20)
    manifest = station.stop().manifest
    assert manifest["configuration_hash"] == station.spec.resolved.digest
    assert (manifest["task"], manifest["checkpoint"]) == ("stack the cups", {})
    station.close()


def test_the_policy_is_given_the_task_of_the_set_up(tmp_path: Path) -> None:
    prompts: list[str] = []

    def rows(observation: Any, number: int) -> Any:
        prompts.append(observation.prompt)
        return on_time(observation, number)

    station = Station(stubbed(tmp_path, rows)).ready(task="fold the towel")
    station.ready()
    assert prompts == ["fold the towel"] * 2 + ["stack the cups"] * 2
    station.close()


def test_figures_of_the_former_policy_are_not_the_new_ones(tmp_path: Path) -> None:
    station = Station(stubbed(tmp_path)).running(20)
    assert station.coordinator.snapshot()["policy"]["answers"] > 0
    station.stop()
    station.ready(policy=OTHER)
    assert station.coordinator.snapshot()["policy"]["answers"] == 0
    station.close()


def test_a_failed_set_up_can_be_made_good_by_another_policy(tmp_path: Path) -> None:
    station = Station(stubbed(tmp_path, absent="no server there: start it"))
    station.prepare(policy=OTHER)
    assert (station.state, station.reason) == (SessionState.IDLE, "no server there: start it")
    station.stubs.absent = ""  # somebody starts it
    station.ready(policy={"amplitude": 0.3})
    assert [policy.calls[0] for policy in station.policies[1:]] == ["connect", "connect"]
    assert station.policies[1].calls[-1] == "close"
    station.close()


def test_an_open_recording_keeps_the_policy_that_its_manifest_names(tmp_path: Path) -> None:
    station = Station(stubbed(tmp_path)).ready()
    station.command("record_start")
    station.go(2)
    with pytest.raises(SetupError, match=r"a recording .* is open: record stop first"):
        station.command("setup", policy=OTHER)
    station.command("setup")  # as it is, it may be set up again
    station.reach(SessionState.READY)
    station.command("record_stop")
    station.ready(policy=OTHER)
    station.close()


# --- runs --------------------------------------------------------------------------------------------------


def test_a_run_is_told_its_trial_and_its_operator_and_answers_with_its_episode(tmp_path: Path) -> None:
    station = Station(stubbed(tmp_path)).ready()
    ack = station.command(
        "run", trial={"id": 12, "scene": {"name": "cups"}}, operator="anna", duration_s=30.0
    )
    station.go(10)
    episode = station.stop()
    assert ack.data["episode"] == episode.manifest["uuid"]
    assert episode.manifest["trial"] == {"id": 12, "scene": {"name": "cups"}}
    assert (episode.manifest["operator"], episode.manifest["duration_s"]) == ("anna", 30.0)
    station.close()


def test_a_run_without_arguments_has_the_deployments_operator_and_limit(tmp_path: Path) -> None:
    station = Station(stubbed(tmp_path, operator="ben", run={"duration_s": 20.0})).ready()
    station.command("run")
    station.go(10)
    assert station.coordinator.snapshot()["run"]["duration_s"] == 20.0
    manifest = station.stop().manifest
    assert (manifest["operator"], manifest["duration_s"], manifest["trial"]) == ("ben", 20.0, {})
    station.close()


def test_the_limit_of_a_run_is_its_own(tmp_path: Path) -> None:
    station = Station(stubbed(tmp_path, run={"duration_s": 20.0})).ready()
    station.command("run", duration_s=0.5)
    station.reach(SessionState.READY, 1.0)
    assert station.reason == "the run's 0.5 s are over"
    assert station.coordinator.snapshot()["run"]["duration_s"] is None
    station.close()


def test_a_run_that_is_not_recorded_has_no_episode(tmp_path: Path) -> None:
    station = Station(stubbed(tmp_path, recording={"enabled": False})).ready()
    assert station.command("run").data["episode"] == ""
    station.close()


def test_a_recording_alone_answers_with_its_episode_too(tmp_path: Path) -> None:
    station = Station(stubbed(tmp_path)).ready()
    episode = station.command("record_start").data["episode"]
    station.go(5)
    station.command("record_stop")
    station.go(3)
    assert station.episode().manifest["uuid"] == episode != ""
    station.close()


# --- a simulated bench -------------------------------------------------------------------------------------


def test_the_bench_is_laid_out_after_homing_and_before_the_policy_is_asked(tmp_path: Path) -> None:
    station = simulated(tmp_path, setup={"home": True})
    station.prepare(bench=BENCH)
    assert station.state is SessionState.READY
    assert station.events("setup")[1:] == [
        "going to the pose",
        "resetting the bench",
        "warming up the policy",
        "idle",
    ]
    assert station.robot.told == [("scene_reset", BENCH)]
    assert station.coordinator.snapshot()["truth"]["reset"] == "reset-1"
    station.close()


def test_a_bench_without_an_id_is_given_one_and_the_answer_says_which(tmp_path: Path) -> None:
    station = simulated(tmp_path)
    station.reach(SessionState.IDLE)
    first = station.command("setup", bench={"seed": 7}).data["bench"]
    station.reach(SessionState.READY)
    second = station.command("setup", bench={"seed": 7}).data["bench"]
    station.reach(SessionState.READY)
    assert first != second != ""
    assert [data["id"] for _, data in station.robot.told] == [first, second]
    station.close()


def test_a_word_that_is_lost_is_said_again(tmp_path: Path) -> None:
    station = simulated(tmp_path)
    station.robot.deaf = 3
    station.ready(bench=BENCH)
    assert station.robot.told == [("scene_reset", BENCH)] * 4
    station.close()


def test_a_set_up_without_a_bench_leaves_it_alone(tmp_path: Path) -> None:
    station = simulated(tmp_path).ready(bench=BENCH)
    station.ready()
    assert len(station.robot.told) == 1
    station.command("home")
    station.reach(SessionState.READY)
    assert len(station.robot.told) == 1
    station.close()


def test_the_id_of_the_last_reset_is_refused_because_it_would_change_nothing(tmp_path: Path) -> None:
    station = simulated(tmp_path).ready(bench=BENCH)
    with pytest.raises(SetupError, match=r"bench\.id = 'reset-1': the bench was reset under this id already"):
        station.command("setup", bench=BENCH)
    assert station.state is SessionState.READY
    station.close()


def test_a_layout_that_the_bench_does_not_accept_is_refused_before_anything_is_asked(tmp_path: Path) -> None:
    station = simulated(tmp_path).ready(bench=BENCH)
    told = len(station.robot.told)
    with pytest.raises(SetupError, match=r"bench\.positions: cup: unknown object; allowed: plate, block"):
        station.command("setup", bench={"seed": 1, "positions": {"cup": [0.0, 0.3]}})
    assert len(station.robot.told) == told
    station.close()


def test_a_layout_has_to_fit_the_bench_of_the_transport(tmp_path: Path) -> None:
    station = simulated(tmp_path, bench="sorting").ready(
        bench={"seed": 1, "positions": {"red_1": [-0.21, 0.2, 0]}}
    )
    with pytest.raises(SetupError, match=r"bench\.positions: block: unknown object; allowed: blue_bin"):
        station.command("setup", bench=BENCH)
    with pytest.raises(
        SetupError, match="laid out for the simulated bench 'tabletop'; this station has 'sorting'"
    ):
        station.command("setup", bench={"seed": 2, "of": "tabletop"})
    other, own = load_schema("tabletop").digest, load_schema("sorting").digest
    for named, said in (("tabletop", "has 'sorting'$"), ("sorting", "whose bench.toml is another one")):
        with pytest.raises(SetupError, match=said):
            station.command("setup", bench={"seed": 2, "of": named, "schema_digest": other})
    station.prepare(bench={"seed": 3, "of": "/a/copy/of/it", "schema_digest": own})
    assert not {"of", "schema_digest"} & station.robot.told[-1][1].keys()  # they are not the node's
    station.close()


def test_factors_are_asked_for_checked_and_confirmed(tmp_path: Path) -> None:
    station = simulated(tmp_path).ready(bench={"seed": 1, "factors": {"light": 0.5}})
    assert station.robot.told[-1][1]["factors"] == {"light": 0.5}
    with pytest.raises(SetupError, match=r"bench\.positions: factors\.light = 9.*allowed: a number from"):
        station.command("setup", bench={"seed": 2, "factors": {"light": 9}})
    station.robot.simulates_factors = False
    station.prepare(bench={"seed": 3, "factors": {"light": 0.5}})
    assert station.reason == (
        "the node reset the bench without the factors (light): it does not simulate them"
    )
    station.close()


def test_a_bench_that_is_not_reset_in_time_ends_the_set_up(tmp_path: Path) -> None:
    station = simulated(tmp_path)
    station.robot.deaf = 1000
    station.prepare(bench=BENCH)
    assert station.state is SessionState.IDLE
    assert station.reason == (
        "the bench was not reset within 3 s: the node reports no ground truth of a bench; does it simulate one?"
    )
    assert 10 <= len(station.robot.told) <= 16
    station.close()


def test_what_the_node_refused_is_the_reason(tmp_path: Path) -> None:
    station = simulated(tmp_path)
    station.robot.deaf = 1000
    station.robot.truth = {"reset": "", "milestones": {}, "success": False}
    station.robot.faults = lambda: {  # type: ignore[method-assign]
        "node_refused.scene_reset": len(station.robot.told),
        "node_refused.limits": 3,
    }
    station.prepare(bench=BENCH)
    assert station.reason == "the bench was not reset within 3 s: the robot refused it (scene_reset)"
    station.robot.faults = dict  # type: ignore[method-assign]
    station.prepare(bench=BENCH)
    assert station.reason == "the bench was not reset within 3 s: the node does not answer to it"
    station.close()


def test_a_sink_that_takes_no_words_ends_the_set_up_at_once(tmp_path: Path) -> None:
    station = simulated(tmp_path)
    station.robot.wordless = True
    before = station.clock.now()
    station.prepare(bench=BENCH)
    assert station.state is SessionState.IDLE
    assert station.reason == (
        "the bench cannot be reset: this transport takes no control words; 'scene_reset' was to be sent"
    )
    assert station.clock.now() - before < 2.0
    station.close()


def test_a_reset_can_be_cancelled(tmp_path: Path) -> None:
    station = simulated(tmp_path)
    station.robot.deaf = 1000
    station.reach(SessionState.IDLE)
    station.command("setup", bench=BENCH)
    station.go(15)
    assert station.coordinator.setup.stage.value == "resetting the bench"
    station.command("stop")
    said = len(station.robot.told)
    station.go(30)
    assert (station.state, len(station.robot.told)) == (SessionState.IDLE, said)
    station.close()


def test_what_the_bench_says_at_the_end_of_a_run_is_in_the_episode_and_among_the_events(
    tmp_path: Path,
) -> None:
    station = simulated(tmp_path).ready(bench=BENCH)
    station.command("run")
    station.go(20)
    milestones = {"grasped": True, "placed": True}
    station.robot.truth = {"reset": "reset-1", "milestones": milestones, "success": True}
    station.go(1)
    episode = station.stop()
    told = [event for event in episode.events if event["kind"] == "truth"]
    assert [event["data"]["milestones"] for event in told] == [milestones]
    assert told[0]["data"]["episode"] == episode.manifest["uuid"]
    assert told[0]["text"] == "the simulated bench says: success"
    assert station.events("truth") == ["the simulated bench says: success"]
    assert episode.manifest["bench"] == BENCH
    station.close()


def test_when_milestones_were_first_reached_is_told_in_seconds_of_the_run(tmp_path: Path) -> None:
    def says(**milestones: bool) -> None:
        station.robot.truth = {"reset": "reset-1", "milestones": milestones, "success": False}

    station = simulated(tmp_path).ready(bench=BENCH)
    says(grasped=True, placed=False)  # by whatever was before the run
    station.command("run")
    station.go(30)
    says(grasped=False, placed=True)
    station.go(15)
    station.command("halt")
    station.go(60)  # held time is none of the run
    says(grasped=True, placed=True, lifted=True)
    station.go(15)
    station.command("resume")
    station.go(15)
    told = next(event for event in station.stop().events if event["kind"] == "truth")["data"]["reached"]
    assert told["grasped"] < 0.3
    assert 1.0 <= told["placed"] < 1.3
    assert 1.5 <= told["lifted"] < 1.8  # as soon as it goes on
    station.close()


def test_the_snapshot_says_what_is_set_up(tmp_path: Path) -> None:
    station = simulated(tmp_path)
    station.reach(SessionState.IDLE)
    shown = station.coordinator.snapshot()
    assert (shown["task"], shown["checkpoint"], shown["truth"]) == ("stack the cups", {}, {})
    station.ready(task="fold", checkpoint={"id": "c-1", "name": "A"}, bench=BENCH)
    shown = station.coordinator.snapshot()
    assert (shown["task"], shown["checkpoint"]) == ("fold", {"id": "c-1", "name": "A"})
    assert (shown["simulated"], shown["truth"]["seed"]) == (True, 7)
    assert "url" not in str(shown["policy"])
    facts = shown["facts"]
    assert facts["joint_names"] == list(station.spec.robot.joint_names)
    assert facts["home"] == station.spec.robot.poses["home"].tolist()
    assert (facts["rate"], facts["cameras"]) == (30.0, list(station.spec.cameras))
    station.close()


def test_a_real_bench_is_shown_as_such(tmp_path: Path) -> None:
    station = Station(stubbed(tmp_path)).ready()
    assert station.coordinator.snapshot()["simulated"] is False
    station.close()
