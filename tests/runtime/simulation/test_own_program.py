"""A bench with a program of its own gets a policy's rows as they are, one step for each, and nothing else."""

from __future__ import annotations

import sys
from concurrent.futures import wait
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import robots
from runtime.benches.environments import _run as run_aside
from runtime.benches.environments import describe_program, environment_of, make_environment
from runtime.benches.host import Host
from runtime.benches.interface import Moment, Refusal
from runtime.benches.schema import load_schema
from runtime.config import loader
from runtime.core.clock import VirtualClock
from runtime.core.errors import ConfigurationError, SetupError
from runtime.ipc.session_state import SessionState
from runtime.policies.base import PolicyInfo
from runtime.processes.coordinator.inference.runners import ThreadRunner
from runtime.processes.coordinator.setup.sequence import check_info
from runtime.processes.lockstep.lockstep import LockstepRun
from runtime.processes.lockstep.lockstep import run as run_in_lockstep
from runtime.recording.bench_truth import truth_changes
from runtime.recording.reader import open_episode
from runtime.simulation import environments
from runtime.simulation.bench.bench import BenchError
from runtime.simulation.bench.block_table import ResetRequest
from runtime.simulation.bench.plant import Plant
from runtime.simulation.node import parser as node_parser
from runtime.simulation.own_program import ProgramEnvironment
from runtime.standins import lockstep
from runtime.station.checks import check_deployment
from tests.runtime.lockstep_station import column
from tests.runtime.simulation.toy_bench import BENCH, PROGRAM, deployment, make_toy


@pytest.fixture
def toy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("EVA_DATA_DIR", str(tmp_path / "data"))
    return make_toy(tmp_path / "toy")


def run(path: Path, task: str = "seven", seconds: float = 5.0) -> LockstepRun:
    spec, clock = check_deployment(loader.load(path)), VirtualClock()
    bench = ("--robot", str(path.parent / "toy"), "--bench", spec.capabilities.bench)
    options = node_parser().parse_args([*bench, "--width", "32", "--height", "24"])
    around = environments.make_environment(spec.robot, options)
    orders = {
        "setup": {"bench": {"id": "b1", "seed": 5, "choices": {"task": task}}},
        "run": {"mode": "continuous", "duration_s": seconds, "trial": {}},
    }
    over = lockstep.success_detector(spec, around, clock)
    peers = lockstep.in_process_peers(spec, clock, around, options)
    return run_in_lockstep(spec, 10.0, peers, clock, over, orders)


def truth_of(events: list[dict[str, Any]]) -> dict[str, Any]:
    return next(event["data"] for event in reversed(events) if event["kind"] == "truth")


def test_each_row_is_one_step_and_reaches_the_bench_to_the_bit(toy: Path, tmp_path: Path) -> None:
    done = run(deployment(toy, tmp_path))
    assert (str(done.state), done.reason) == ("ready", "the simulated bench is over: success")
    truth = truth_of(done.events)
    assert truth["steps"] == done.episode["rows"] == 7  # no standing tick, and none after the success
    assert truth["reached"] == {"begun": 0.05, "done": 0.35}
    assert (truth["success"], truth["benchmark"], truth["choices"]) == (True, True, {"task": "seven"})
    episode = open_episode(Path(done.episode["path"]))
    raw, sent = column(episode.raw, "action")[:7], column(episode.rows, "action")
    np.testing.assert_array_equal(sent, raw)
    assert len(np.unique(raw, axis=0)) == 7
    seen = truth_changes(episode.rows)
    assert [(row, truth["observation"][0]) for row, truth in seen] == [(row, row) for row in range(7)]
    np.testing.assert_allclose([truth["observation"][1:] for _, truth in seen[1:]], raw[:-1], atol=1e-4)
    np.testing.assert_array_equal(np.float32(truth["observation"][1:]), np.float32(raw[-1]))
    assert episode.manifest["configuration"]["lockstep"]["benchmark"] is True
    content = load_schema(str(toy)).program
    assert content is not None
    assert episode.manifest["bench_program"] == {"content": content.content, "packages": {}}


@pytest.mark.parametrize("paced", [True, False])
def test_a_served_station_makes_the_same_steps_and_records_the_same_rows(
    toy: Path, tmp_path: Path, paced: bool
) -> None:
    alone = open_episode(Path(run(deployment(toy, tmp_path)).episode["path"]))
    served = lockstep.station(
        deployment(toy, tmp_path), [], VirtualClock(), "--width", "32", "--height", "24", paced=paced
    )
    try:
        served.connect()
        coordinator = served.coordinator

        def until(reached: Any, what: str) -> None:
            for _ in range(50_000):
                served.poll()
                if reached():
                    return
            raise AssertionError(f"{what}: {coordinator.session.state}: {coordinator.session.reason}")

        until(lambda: coordinator.session.state is SessionState.IDLE, "idle")
        served.command("setup", bench={"id": "b2", "seed": 5, "choices": {"task": "seven"}})
        until(lambda: coordinator.session.state is SessionState.READY, "ready")
        served.command("run", mode="continuous", trial={})
        until(lambda: coordinator.runs.last_episode, "an episode")
        again = open_episode(Path(coordinator.runs.last_episode["path"]))
    finally:
        served.close()
    for name in ("action", "bench", "qpos"):
        assert again.rows.column(name).to_pylist() == alone.rows.column(name).to_pylist(), name


@pytest.mark.parametrize("paced", [False, True])
def test_a_policy_that_answers_before_it_is_waited_for_makes_no_tick_stand_still(
    toy: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, paced: bool
) -> None:
    submit = ThreadRunner.submit

    def answered(runner: ThreadRunner, call: Any) -> Any:
        wait([future := submit(runner, call)])
        return future

    monkeypatch.setattr(ThreadRunner, "submit", answered)
    test_a_served_station_makes_the_same_steps_and_records_the_same_rows(toy, tmp_path, paced)


def test_benchmark_mode_resamples_no_rows(toy: Path, tmp_path: Path) -> None:
    spec = check_deployment(loader.load(deployment(toy, tmp_path), []))
    check_info(PolicyInfo("fits", rate=spec.rate), spec, continues=False)
    with pytest.raises(SetupError, match=r"at 10 Hz \(policy.action_rate\), and the control rate is 20 Hz"):
        check_info(PolicyInfo("slow", rate=10.0), spec, continues=False)


def test_the_benchs_own_end_ends_the_run_and_is_no_success(toy: Path, tmp_path: Path) -> None:
    done = run(deployment(toy, tmp_path), "never")
    assert done.reason == "the simulated bench is over: 20 steps"
    truth = truth_of(done.events)
    assert (truth["steps"], truth["success"], truth["reached"]) == (20, False, {"begun": 0.05})


@pytest.mark.parametrize(
    ("task", "words"),
    [
        ("refused", "the bench cannot be reset: the bench's program: task = 'refused': not today"),
        ("fourth", "choices.task = 'fourth'; allowed: seven, three, never, refused, crash, text"),
    ],
)
def test_what_the_bench_refuses_fails_the_set_up(toy: Path, tmp_path: Path, task: str, words: str) -> None:
    with pytest.raises(SetupError) as refused:
        run(deployment(toy, tmp_path), task)
    assert words in str(refused.value)


def environment(toy: Path) -> ProgramEnvironment:
    options = node_parser().parse_args(
        ["--robot", str(toy), "--bench", str(toy), "--width", "8", "--height", "6"]
    )
    return ProgramEnvironment(robots.load_robot(toy), options)


def moved(around: ProgramEnvironment, plant: Plant, *row: float) -> None:
    plant.row = np.array(row) if row else None
    around.move(plant, 0.05)


def test_without_a_row_its_time_stands_still_and_after_its_end_nothing_moves(toy: Path) -> None:
    around, plant = environment(toy), Plant(robots.load_robot(toy))
    try:
        around.reset(ResetRequest("x", 3, choices={"task": "three"}))
        for row in ((0.1, 0.2), (), (0.3, 0.4), (), (0.5, 0.6), (0.7, 0.8)):
            moved(around, plant, *row)
        assert around.truth()["steps"] == 3
        np.testing.assert_array_equal(plant.q, np.float32([0.5, 0.6]))
        np.testing.assert_array_equal(around.state_vector(), [3, *np.float64(np.float32([0.5, 0.6]))])
        assert around.pictures(0, 0.0, plant.q)["cam_only"][0, 0].tolist() == [3, 0, 30]  # BGR
        around.reset(ResetRequest("x", 3, choices={"task": "three"}))  # the same again: no reset
        assert around.truth()["steps"] == 3
        around.reset(ResetRequest("y", 4))
        assert (around.truth()["steps"], around.truth()["over"]) == (0, "")
        with pytest.raises(BenchError, match="positions or factors of 'Counting', which has none"):
            around.reset(ResetRequest("z", 4, positions={"block": [0, 0, 0]}))
    finally:
        around.close()


def test_a_program_that_ends_is_named_with_its_last_words(toy: Path) -> None:
    around, plant = environment(toy), Plant(robots.load_robot(toy))
    try:
        around.reset(ResetRequest("x", 3, choices={"task": "crash"}))
        with pytest.raises(SetupError, match=r"the bench's program has ended: .*out of memory"):
            moved(around, plant, 0.1, 0.2)
    finally:
        around.close()
    broken = environment(toy)
    try:
        with pytest.raises(BenchError, match="could not convert string to float"):
            broken.reset(ResetRequest("x", 3, choices={"task": "text"}))
    finally:
        broken.close()


@pytest.mark.parametrize(
    ("program", "words"),
    [
        ("import nothing_of_that_name\n", "has ended: .*nothing_of_that_name"),
        (
            PROGRAM.replace("dim, observation, milestones", "observation, dim, milestones"),
            "dim = 3; expected: 2",
        ),
        (
            PROGRAM.replace('("cam_only",)', '("cam_other",)'),
            "cameras = .'cam_other'.; expected: .'cam_only'.",
        ),
    ],
)
def test_a_program_that_does_not_start_or_fit_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, program: str, words: str
) -> None:
    monkeypatch.setenv("EVA_DATA_DIR", str(tmp_path / "data"))
    with pytest.raises(SetupError, match=words):
        environment(make_toy(tmp_path / "toy", program))


def test_it_ends_with_who_started_it(toy: Path) -> None:
    around = environment(toy)
    process = around._process._process
    assert process is not None
    around.close()
    around.close()
    assert process.poll() is not None


def test_an_environment_that_is_not_there_is_asked_for_and_a_failed_one_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("EVA_DATA_DIR", str(tmp_path / "data"))
    toy = make_toy(tmp_path / "toy")
    (toy / "requirements.txt").write_text(f"{tmp_path}/absent.whl\n")
    with pytest.raises(SetupError, match=f"is not installed .* python -m runtime.benches.environments {toy}"):
        environment(toy)
    monkeypatch.setattr("runtime.benches.environments._OURS", ())
    with pytest.raises(SetupError, match=r"pip install .* ended with 1"):
        make_environment(str(toy))
    assert not list(environment_of(str(toy)).parent.glob(f"{environment_of(str(toy)).name}*"))
    assert not list(environment_of(str(toy)).parent.glob(".*"))
    with pytest.raises(SetupError, match="no program of its own"):
        environment_of("tabletop")
    assert describe_program("tabletop") == describe_program("") == {}


def test_packages_are_installed_without_our_packages_and_secrets(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("PYTHONPATH", "PYTHONHOME", "EVA_SECRET_KEY"):
        monkeypatch.setenv(name, sys.prefix)
    seen = "PYTHONPATH PYTHONHOME EVA_SECRET_KEY"
    run_aside(
        [sys.executable, "-c", f"import os, sys; sys.exit(len(os.environ.keys() & set({seen!r}.split())))"]
    )


class One:
    dim, observation, milestones, cameras = 1, 0, ("done",), ()

    def reset(self, seed: int, choices: Any) -> Moment:
        return Moment(np.zeros(1), None, {"done": False})

    def step(self, row: Any) -> Moment:
        if row[0] > 1:
            raise Refusal(f"too far{50_000 * '!'}" if row[0] > 2 else "too far")
        return Moment(row, None, {"done": True}, "success")

    def observe(self, width: int, height: int) -> dict[str, Any]:
        return {}


def test_a_host_counts_steps_refuses_those_after_the_end_and_survives_its_bench() -> None:
    host = Host(One())
    assert "has not been reset" in host.answer({"do": "step", "row": np.zeros(1)})["error"]
    assert "observation" not in host.answer({"do": "reset", "seed": 1, "choices": {}})
    assert host.answer({"do": "step", "row": np.float32([2])}) == {"error": "too far"}
    assert len(host.answer({"do": "step", "row": np.float32([3])})["error"]) == 500
    assert host.answer({"do": "step", "row": np.float32([1])})["steps"] == 1
    assert host.answer({"do": "step", "row": np.float32([1])}) == {"error": "no step is possible: success"}
    assert host.answer({"do": "reset"})["error"].startswith("KeyError")
    assert "its last reset failed" in host.answer({"do": "step", "row": np.float32([1])})["error"]
    assert host.answer({"do": "reset", "seed": 1, "choices": {}})["steps"] == 0
    assert "allowed: ready, describe, reset, step, observe" in host.answer({"do": "look"})["error"]


def test_a_schema_with_a_program_has_no_layout_and_its_digest_has_the_program(
    toy: Path, tmp_path: Path
) -> None:
    schema = load_schema(str(toy))
    assert schema.objects == {}
    assert list(schema.choice_problems({"task": "three", "colour": "red"})) == [
        "choices.colour: unknown choice; allowed: task"
    ]
    other = make_toy(tmp_path / "other", PROGRAM + "\n# changed\n")
    assert load_schema(str(other)).digest != schema.digest
    whole = make_toy(tmp_path / "whole")
    assert load_schema(str(whole)).digest == schema.digest
    load_schema.cache_clear()
    (whole / "parts").mkdir()
    (whole / "parts" / "physics.py").write_text("G = 9.81\n")
    assert load_schema(str(whole)).digest != schema.digest
    for change, words in (
        (('when = "reported"', 'when = "held"'), "milestones.done.when = 'held'; allowed: \"reported\""),
        (('usual = "seven"', 'usual = "eight"'), "usual = 'eight'"),
        (('success = ["done"]', 'success = ["gone"]'), "success = ['gone']; allowed: done, begun"),
        (("[program]", "area = [0, 1, 0, 1]\n[program]"), "area: the bench's own program decides on these"),
        (('file = "bench.py"', 'file = "absent.py"'), "absent.py is not in"),
    ):
        folder = tmp_path / words[:9].replace(" ", "").replace("'", "")
        folder.mkdir()
        (folder / "bench.toml").write_text(BENCH.replace(*change))
        with pytest.raises(SetupError) as refused:
            load_schema(str(folder))
        assert words in str(refused.value)


@pytest.mark.parametrize(
    ("assignment", "words"),
    [
        ('strategy.kind="async"', "strategy.kind = 'async' with lockstep.benchmark = true"),
        ("safety.report_only=false", "safety.report_only = False"),
        ("lockstep.delay_ticks=1", "lockstep.delay_ticks = 1"),
        ("transport.simulated=false", "transport.simulated = False"),
        ('policy={kind="openpi", delay_ms=80}', "policy.delay_ms = 80.0"),
    ],
)
def test_benchmark_mode_refuses_what_would_change_or_delay_rows(
    toy: Path, tmp_path: Path, assignment: str, words: str
) -> None:
    with pytest.raises(ConfigurationError) as refused:
        check_deployment(loader.load(deployment(toy, tmp_path), [assignment]))
    assert words in str(refused.value)


def test_benchmark_mode_is_not_for_robots_whose_numbers_are_changed_nor_for_real_time(
    toy: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from runtime.__main__ import main

    path = deployment(toy, tmp_path)
    with pytest.raises(SetupError, match="are binary grippers, whose numbers are changed"):
        check_deployment(loader.load(path, ['robot="r1_lite"', 'transport.bench="tabletop"']))
    assert main([str(path)]) == 1
    assert "a station in real time does not wait for its policy" in capsys.readouterr().err
