"""Our robot and teleoperator for LeRobot, against the contract that its commands rely on, without LeRobot and torch."""

from __future__ import annotations

import importlib
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from evaweb_robot import StationError

import runtime
from runtime.clients.robot_server.session import SessionError
from tests.processes import eventually
from tests.runtime.integrations.served_station import NAMES, ServedStation, served

FOLDER = Path(runtime.__file__).parent / "integrations"


class Base:
    """What LeRobot's Robot and Teleoperator do themselves."""

    def __init__(self, config: Any) -> None:
        self.id = config.id


class BaseConfig:
    """A config with LeRobot's registry."""

    registered: dict[str, type]
    id: str | None = None

    def __post_init__(self) -> None:
        """LeRobot's own checks."""

    @classmethod
    def register_subclass(cls, name: str) -> Any:
        def register(config: type) -> type:
            cls.registered[name] = config
            return config

        return register


@pytest.fixture
def lerobot(monkeypatch: pytest.MonkeyPatch) -> dict[str, type]:
    """Names and places of LeRobot's classes as our plug-ins import them; the configs that they register."""
    registered: dict[str, type] = {}
    config = type("Config", (BaseConfig,), {"registered": registered})
    already = type("DeviceAlreadyConnectedError", (ConnectionError,), {})
    absent = type("DeviceNotConnectedError", (ConnectionError,), {})
    contents: dict[str, dict[str, Any]] = {
        "lerobot": {},
        "lerobot.robots": {},
        "lerobot.robots.config": {"RobotConfig": config},
        "lerobot.robots.robot": {"Robot": Base},
        "lerobot.teleoperators": {},
        "lerobot.teleoperators.config": {"TeleoperatorConfig": config},
        "lerobot.teleoperators.teleoperator": {"Teleoperator": Base},
        "lerobot.utils": {},
        "lerobot.utils.errors": {
            "DeviceAlreadyConnectedError": already,
            "DeviceNotConnectedError": absent,
        },
    }
    for name, content in contents.items():
        module = ModuleType(name)
        vars(module).update(content)
        monkeypatch.setitem(sys.modules, name, module)
    for name in ("lerobot_robot_evaweb", "lerobot_teleoperator_evaweb"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    return registered


@pytest.fixture
def station() -> Iterator[ServedStation]:
    with served() as made:
        yield made


def device(lerobot: dict[str, type], kind: str, url: str, **settings: Any) -> Any:
    """The device as LeRobot makes it: by its registered type, and by its config's name without `Config`."""
    module = importlib.import_module(f"lerobot_{kind}_evaweb")
    config = lerobot["evaweb"]
    return getattr(module, config.__name__.removesuffix("Config"))(config(url=url, **settings))


@pytest.mark.parametrize("kind", ["robot", "teleoperator"])
def test_lerobot_finds_a_distribution_by_its_name_which_is_that_of_its_module(kind: str) -> None:
    name = f"lerobot_{kind}_evaweb"
    project = tomllib.loads((FOLDER / name / "pyproject.toml").read_text())
    assert (project["project"]["name"], project["tool"]["setuptools"]["py-modules"]) == (name, [name])
    assert (FOLDER / name / f"{name}.py").exists()


def test_its_features_are_known_before_it_is_connected(
    lerobot: dict[str, type], station: ServedStation
) -> None:
    robot = device(lerobot, "robot", station.url)
    actions = {f"{name}.pos": float for name in NAMES}
    assert robot.action_features == actions
    assert robot.observation_features == {**actions, "cam_high": (4, 6, 3)}
    assert (robot.is_connected, robot.is_calibrated, len(robot.cameras)) == (False, True, 1)
    assert station.begun == []


def test_it_observes_acts_and_ends_with_the_connection(
    lerobot: dict[str, type], station: ServedStation
) -> None:
    robot = device(lerobot, "robot", station.url, task="fold it", driver="person")
    robot.connect()
    assert station.begun == [{"task": "fold it", "seed": None, "driver": "person"}]
    observation = robot.get_observation()
    assert observation.keys() == robot.observation_features.keys()
    assert type(observation["arm.joint0.pos"]) is float
    assert observation["cam_high"].shape == (4, 6, 3)
    action = {"arm.gripper.pos": np.float32(0.5), "arm.joint0.pos": np.array(0.25)}
    assert robot.send_action(action) == {"arm.joint0.pos": 0.25, "arm.gripper.pos": 0.5}
    assert station.rows == [[0.25, 0.5]]
    assert robot.get_observation()["cam_high"][0, 0, 0] == 1
    with pytest.raises(KeyError, match=r"the action lacks arm\.gripper\.pos"):
        robot.send_action({"arm.joint0.pos": 0.0})
    with pytest.raises(ConnectionError, match="is connected"):
        robot.connect()
    robot.disconnect()
    eventually(lambda: station.closed == 1, "the session is closed")
    for call in (robot.get_observation, lambda: robot.send_action(action)):
        with pytest.raises(ConnectionError, match="not connected"):
            call()


def test_a_robot_with_lerobots_names_has_lerobots_numbers_too(
    lerobot: dict[str, type], station: ServedStation
) -> None:
    station.description["lerobot"] = [["pan.pos", np.pi / 180, 0.0], ["gripper.pos", -0.01, 1.0]]
    robot = device(lerobot, "robot", station.url)
    robot.connect()
    assert list(robot.action_features) == ["pan.pos", "gripper.pos"]
    robot.send_action({"pan.pos": 90.0, "gripper.pos": 25.0})
    np.testing.assert_allclose(station.rows, [[np.pi / 2, 0.75]], rtol=1e-6)
    observed = robot.get_observation()
    np.testing.assert_allclose([observed["pan.pos"], observed["gripper.pos"]], [90.0, 25.0], rtol=1e-5)
    leader = device(lerobot, "teleoperator", station.url)
    leader.connect()
    np.testing.assert_allclose(list(leader.get_action().values()), [90 / np.pi, 50.0], rtol=1e-6)


def test_a_station_that_stops_ends_the_loop_and_the_way_home_that_follows(
    lerobot: dict[str, type], station: ServedStation
) -> None:
    robot = device(lerobot, "robot", station.url)
    robot.connect()
    station.over = SessionError("the station is faulted: e-stop by anna", is_over=True)
    for _ in range(3):
        with pytest.raises(StationError, match="e-stop by anna"):
            robot.send_action(dict.fromkeys(robot.action_features, 0.0))
    assert station.rows == []


def test_a_teleoperator_reads_what_is_commanded_and_else_what_is_measured(
    lerobot: dict[str, type], station: ServedStation
) -> None:
    leader = device(lerobot, "teleoperator", station.url)
    with pytest.raises(ConnectionError, match="not connected"):
        leader.get_action()
    leader.connect()
    assert leader.get_action() == {"arm.joint0.pos": 0.5, "arm.gripper.pos": 0.5}
    assert leader.feedback_features == {}
    assert station.begun == []
    with pytest.raises(ValueError, match="source = 'planned'; allowed: commanded, measured"):
        device(lerobot, "teleoperator", station.url, source="planned")
