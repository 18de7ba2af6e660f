"""LeRobot's teleoperator `evaweb`: a LeRobot robot follows what a station of EVA Web does.

    lerobot-teleoperate --robot.type=... --teleop.type=evaweb --teleop.url=ws://127.0.0.1:8766/?token=...

It only reads, and needs no lease: a person, a leader arm or a policy drives the station.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from evaweb_robot import Station, StationDescription
from lerobot.teleoperators.config import TeleoperatorConfig
from lerobot.teleoperators.teleoperator import Teleoperator
from lerobot.utils.errors import DeviceAlreadyConnectedError, DeviceNotConnectedError

_SOURCES = ("commanded", "measured")


@TeleoperatorConfig.register_subclass("evaweb")
@dataclass(kw_only=True)
class EvaLeaderConfig(TeleoperatorConfig):
    """Address of the station's robot server ($EVAWEB_ROBOT_URL if not given).

    `source` is "commanded" (measured while nothing is commanded) or "measured".
    """

    url: str = ""
    source: str = "commanded"

    def __post_init__(self) -> None:
        if self.source not in _SOURCES:
            raise ValueError(f"source = {self.source!r}; allowed: {', '.join(_SOURCES)}")


class EvaLeader(Teleoperator):
    """Station of EVA Web whose joints are the actions."""

    config_class = EvaLeaderConfig
    name = "evaweb"

    def __init__(self, config: EvaLeaderConfig) -> None:
        super().__init__(config)
        self.config = config
        self._station = Station(config.url, program="lerobot")
        self._description: StationDescription | None = None
        self._is_connected = False

    @property
    def action_features(self) -> dict[str, type]:
        return dict.fromkeys((feature.name for feature in self._describe().features), float)

    @property
    def feedback_features(self) -> dict[str, type]:
        return {}

    @property
    def is_connected(self) -> bool:
        return self._is_connected

    @property
    def is_calibrated(self) -> bool:
        return True

    def connect(self, calibrate: bool = True) -> None:
        if self._is_connected:
            raise DeviceAlreadyConnectedError(f"{self} is connected")
        self._describe()
        self._station.watch()
        self._is_connected = True

    def calibrate(self) -> None:
        """Do nothing: calibration belongs to the station's robot."""

    def configure(self) -> None:
        """Do nothing: configuration belongs to the station."""

    def get_action(self) -> dict[str, float]:
        if not self._is_connected:
            raise DeviceNotConnectedError(f"{self} is not connected")
        joints = self._station.watch()
        row = joints[self.config.source]
        if not np.isfinite(row).all():
            row = joints["measured"]
        action: dict[str, float] = self._describe().to_lerobot(row)
        return action

    def send_feedback(self, feedback: dict[str, Any]) -> None:
        raise NotImplementedError("a station of EVA Web feels no feedback")

    def disconnect(self) -> None:
        self._is_connected = False
        self._station.close()

    def _describe(self) -> StationDescription:
        if self._description is None:
            self._description = self._station.describe()
        return self._description
