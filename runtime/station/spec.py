"""Station spec: a deployment with its robot, known before anything is connected."""

from __future__ import annotations

import json
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from pydantic import TypeAdapter

import robots
from robots import Robot
from runtime.benches.schema import load_schema
from runtime.config import loader
from runtime.config.loader import Resolved
from runtime.config.schema import Deployment
from runtime.core.errors import ConfigurationError
from runtime.core.plugins import variants
from runtime.ipc.shared_state import SharedStateLayout
from runtime.motion.timeline import DimensionKinds
from runtime.safety.limits import Limits
from runtime.transports.base import Capabilities

CAPABILITIES = TypeAdapter(Capabilities)
"""Conversion of capabilities to and from JSON, because only the supervisor queries the transport for them."""


@dataclass(frozen=True, slots=True)
class StationSpec:
    """Deployment with its robot, and what is known about both before anything is connected.

    All attributes are plain values. If `collecting`, the station is set up to collect demonstrations, and the leader in
    the deployment's [collection] takes the place of the policy.
    """

    resolved: Resolved
    robot: Robot
    capabilities: Capabilities  # of the transport
    cameras: tuple[str, ...]  # keys of its own cameras, and of the robot's that its transport delivers
    collecting: bool = False

    @property
    def deployment(self) -> Deployment:
        return self.resolved.deployment

    @property
    def rate(self) -> float:
        """Control rate [Hz]."""
        return self.deployment.control.rate or self.robot.control_rate

    @property
    def fps(self) -> float:
        """Rows of the dataset grid per second [Hz]."""
        return self.deployment.recording.fps or self.rate

    @property
    def layout(self) -> SharedStateLayout:
        bench = self.capabilities.bench
        program = load_schema(bench).program if bench else None
        return SharedStateLayout(
            self.robot.dim,
            self.robot.eef_dim,
            self.cameras,
            vector=program.observation if program else 0,
        )

    @property
    def limits(self) -> Limits:
        robot = self.robot
        grippers, binary = [False] * robot.dim, [False] * robot.dim
        for dim in robot.gripper_dims:
            grippers[dim] = True
        for dim in robot.binary_dims:
            binary[dim] = True
        return Limits(
            robot.joint_names,
            robot.lower,
            robot.upper,
            robot.velocity,
            np.array(grippers),
            np.array(binary),
            robot.speed_dims,
        )

    @property
    def dims(self) -> DimensionKinds:
        """Dimensions that cannot be blended like numbers: binary grippers, angles without limits."""
        endless = np.flatnonzero(np.isinf(self.robot.lower) & np.isinf(self.robot.upper))
        return DimensionKinds(self.robot.binary_dims, tuple(endless.tolist()))


def delivered_cameras(settings: Deployment, robot: Robot) -> tuple[str, ...]:
    """Return the keys of the cameras that the transport delivers.

    These are all cameras of the robot, unless the transport names fewer.
    """
    named = getattr(variants("runtime.transports")[settings.transport.kind], "cameras", None)
    if named is None:
        return tuple(camera.key for camera in robot.cameras)
    fewer: tuple[str, ...] = named(settings.transport, robot)
    return fewer


def build_spec(resolved: Resolved, capabilities: Capabilities | None = None) -> StationSpec:
    """Return the spec of a deployment whose parts are known to fit each other.

    The transport is queried for `capabilities` if they are not given.

    Raises:
        ConfigurationError: There is no such robot.
        SetupError: The transport lacks a package that it needs.
    """
    settings = resolved.deployment
    try:
        grippers = {
            name: robots.GripperChoice(**choice.model_dump()) for name, choice in settings.grippers.items()
        }
        robot = robots.load_robot(settings.robot, settings.groups, grippers)
    except robots.RobotError as error:
        raise ConfigurationError(str(error)) from None
    has = {*delivered_cameras(settings, robot), *settings.cameras}
    cameras = tuple(camera.key for camera in robot.cameras if camera.key in has)
    if capabilities is None:
        capabilities = variants("runtime.transports")[settings.transport.kind].capabilities(
            settings.transport
        )
    return StationSpec(resolved, robot, capabilities, cameras)


def load_checked_spec(path: str, capabilities: str, unread: Collection[str] = ()) -> StationSpec:
    """Load the spec that a supervisor has checked: the resolved deployment from a file, capabilities as JSON.

    Tables of the packages in `unread` stay plain tables, and the modules of their kinds are not loaded.
    """
    resolved = loader.resolve_deployment(json.loads(Path(path).read_text("utf-8")), {}, path, unread)
    return build_spec(resolved, CAPABILITIES.validate_json(capabilities))
