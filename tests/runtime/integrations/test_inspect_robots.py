"""Our embodiment, by inspect-robots itself: its conformance check and its evaluation loop."""

from __future__ import annotations

import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import runtime
from runtime.clients.robot_server.session import SessionError
from tests.runtime.integrations.served_station import NAMES, ServedStation, served

pytest.importorskip("inspect_robots")

from inspect_robots.conformance import check_embodiment
from inspect_robots.errors import ConfigError, EmbodimentFault
from inspect_robots.eval import eval as evaluate
from inspect_robots.policy import PolicyConfig, PolicyInfo
from inspect_robots.scene import Scene
from inspect_robots.spaces import ActionSemantics, Box, ObservationSpace
from inspect_robots.task import Task
from inspect_robots.types import Action, ActionChunk
from inspect_robots_evaweb import EvaStation, make_embodiment

SCENE = Scene(id="fold", instruction="fold the cloth")


class Raising:
    """A policy that closes the gripper, one row after the other."""

    def __init__(self, after: Any = None) -> None:
        space = Box(
            shape=(len(NAMES),),
            semantics=ActionSemantics(control_mode="joint_pos", gripper="continuous"),
        )
        observed = ObservationSpace(cameras=(), state_keys=frozenset({"joint_pos"}))
        self.info = PolicyInfo(
            name="raising", action_space=space, observation_space=observed, control_hz=100.0
        )
        self.config = PolicyConfig()
        self.acts = 0
        self._after = after

    def reset(self, scene: Any) -> None:
        pass

    def act(self, observation: Any) -> ActionChunk:
        self.acts += 1
        if self._after is not None and self.acts == 3:
            self._after()
        row = observation.state["joint_pos"] + [0.0, -0.01]
        return ActionChunk(actions=[Action(row)], control_hz=100.0)


@pytest.fixture
def station() -> Iterator[ServedStation]:
    with served() as made:
        yield made


def run(station: ServedStation, folder: Path, policy: Raising, epochs: int = 1) -> Any:
    task = Task(name="fold", scenes=(SCENE,), scorer="episode_length", max_steps=5, epochs=epochs)
    (log,) = evaluate(task, policy, EvaStation(url=station.url), log_dir=str(folder), seed=7)
    return log


def test_it_conforms(station: ServedStation) -> None:
    embodiment = EvaStation(url=station.url)
    report = check_embodiment(embodiment.info)
    assert [issue for issue in report.issues if issue.severity == "error"] == []
    info = embodiment.info
    assert info.action_space.semantics.dim_labels == NAMES
    assert info.action_space.semantics.max_step == (0.02, 0.04)
    assert np.isfinite(info.action_space.low).all()
    assert (info.control_hz, info.is_simulated, info.environment_id) == (100.0, True, "bench-7")
    embodiment.close()


def test_every_trial_of_an_evaluation_is_a_run_with_its_instruction_and_seed(
    station: ServedStation, tmp_path: Path
) -> None:
    log = run(station, tmp_path, Raising(), epochs=2)
    assert log.status == "success"
    assert log.stats.total_steps == len(station.rows) == 10
    assert [begun["task"] for begun in station.begun] == ["fold the cloth"] * 2
    assert len({begun["seed"] for begun in station.begun}) == 2


def test_a_person_who_stops_the_station_ends_the_trial_and_its_estop_the_evaluation(
    station: ServedStation, tmp_path: Path
) -> None:
    def stop() -> None:
        station.over = SessionError("stopped by anna", is_over=True, is_stopped=True)

    assert run(station, tmp_path, Raising(stop)).samples[0].termination_reasons == ("operator_end",)
    station.over = SessionError("e-stop by anna", is_over=True)
    with pytest.raises(EmbodimentFault, match="e-stop by anna"):
        EvaStation(url=station.url).reset(SCENE)


def test_what_it_cannot_use_is_named_before_anything_moves(station: ServedStation) -> None:
    station.description["cameras"] = {"cam_high": None}
    with pytest.raises(ConfigError, match="bench-7 has no picture of cam_high yet"):
        make_embodiment(url=station.url)
    with pytest.raises(ConfigError, match="options port of the embodiment evaweb; allowed: url"):
        make_embodiment(port=8766)
    assert station.begun == []


def test_inspect_robots_finds_it_by_its_entry_point() -> None:
    folder = Path(runtime.__file__).parent / "integrations" / "inspect_robots_evaweb"
    project = tomllib.loads((folder / "pyproject.toml").read_text())
    groups = project["project"]["entry-points"]
    assert groups == {
        "inspect_robots.embodiments": {"evaweb": f"{make_embodiment.__module__}:make_embodiment"}
    }
