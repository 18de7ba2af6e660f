"""LeRobot's robot `evaweb`: a station of EVA Web, for `lerobot-record`, `lerobot-teleoperate` and `lerobot-rollout`.

    lerobot-teleoperate --robot.type=evaweb --robot.url=ws://127.0.0.1:8766/?token=... --teleop.type=...

Every row passes the station's limits and is in its record, also as it was executed. A station that stops, e.g. by its
e-stop, ends the loop: every further call raises.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from evaweb_robot import Station, StationDescription
from lerobot.robots.config import RobotConfig
from lerobot.robots.robot import Robot
from lerobot.utils.errors import DeviceAlreadyConnectedError, DeviceNotConnectedError

_DRIVERS = ("policy", "person")


@RobotConfig.register_subclass("evaweb")
@dataclass(kw_only=True)
class EvaStationConfig(RobotConfig):
    """Address of the station's robot server ($EVAWEB_ROBOT_URL if not given), and the instruction of its episodes.

    `driver` is "policy", or "person" with a teleoperator: the station's episodes are demonstrations.
    """

    url: str = ""
    task: str = ""
    driver: str = "policy"

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.driver not in _DRIVERS:
            raise ValueError(f"driver = {self.driver!r}; allowed: {', '.join(_DRIVERS)}")


class EvaStation(Robot):
    """Station of EVA Web. `connect` **drives it to its start pose** and begins a run, `disconnect` ends it."""

    config_class = EvaStationConfig
    name = "evaweb"

    def __init__(self, config: EvaStationConfig) -> None:
        super().__init__(config)
        self.config = config
        self._station = Station(config.url, program="lerobot")
        self._description: StationDescription | None = None
        self._has_run = False

    @property
    def cameras(self) -> dict[str, tuple[int, int]]:
        """Height and width of the pictures by camera; LeRobot counts them."""
        return dict(self._describe().cameras)

    @property
    def observation_features(self) -> dict[str, Any]:
        pictures = {camera: (height, width, 3) for camera, (height, width) in self.cameras.items()}
        return {**self.action_features, **pictures}

    @property
    def action_features(self) -> dict[str, type]:
        return dict.fromkeys((feature.name for feature in self._describe().features), float)

    @property
    def is_connected(self) -> bool:
        return self._has_run

    @property
    def is_calibrated(self) -> bool:
        return True

    def connect(self, calibrate: bool = True) -> None:
        if self._has_run:
            raise DeviceAlreadyConnectedError(f"{self} is connected")
        self._describe()
        self._station.begin(self.config.task, driver=self.config.driver)
        self._has_run = True

    def calibrate(self) -> None:
        """Do nothing: calibration belongs to the station's robot."""

    def configure(self) -> None:
        """Do nothing: configuration belongs to the station."""

    def get_observation(self) -> dict[str, Any]:
        self._require_connection()
        observation = self._station.observe()
        return {**self._describe().to_lerobot(observation.joints), **observation.pictures}

    def send_action(self, action: dict[str, Any]) -> dict[str, Any]:
        """Send the targets of all joints; the station's record has what it clipped of them."""
        self._require_connection()
        self._station.act(self._describe().from_lerobot(action))
        return {name: float(action[name]) for name in self.action_features}

    def disconnect(self) -> None:
        self._has_run = False
        self._station.close()

    def _require_connection(self) -> None:
        if not self._has_run:
            raise DeviceNotConnectedError(f"{self} is not connected")

    def _describe(self) -> StationDescription:
        if self._description is None:
            self._description = self._station.describe()
        return self._description
