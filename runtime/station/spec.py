"""A deployment with its robot: what is known of a station before anything is connected."""

from __future__ import annotations

import json
import logging
from collections.abc import Collection
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING

import numpy as np

import robots
from robots import Robot
from runtime.config import loader
from runtime.config.loader import Resolved
from runtime.config.schema import Deployment
from runtime.core.clock import Clock
from runtime.core.errors import ConfigurationError, RuntimeFault
from runtime.core.plugins import variants
from runtime.ipc.shared_state import SharedStateLayout
from runtime.motion.timeline import DimensionKinds
from runtime.safety.limits import Limits

# What a process does not make it does not load: these are imported where they are made.
if TYPE_CHECKING:
    from runtime.kinematics.base import Kinematics
    from runtime.policies.base import Policy
    from runtime.spaces.conversion import ActionSpaces
    from runtime.spaces.end_effectors import EndEffectors
    from runtime.spaces.published_poses import PosePublisher
    from runtime.teleoperators.base import Leader
    from runtime.transports.base import Capabilities, Source


@dataclass(frozen=True, slots=True)
class StationSpec:
    """A deployment with everything that can be known of it before anything is connected.

    `collecting`: it is set up to collect, so that what is asked is the leader of its [collection].
    """

    resolved: Resolved
    robot: Robot
    collecting: bool = field(default=False, kw_only=True)

    @property
    def deployment(self) -> Deployment:
        return self.resolved.deployment

    @property
    def rate(self) -> float:
        """Control ticks per second."""
        return self.deployment.control.rate or self.robot.control_rate

    @property
    def fps(self) -> float:
        """Rows of the dataset grid per second."""
        return self.deployment.recording.fps or self.rate

    @property
    def transport(self) -> ModuleType:
        return variants("runtime.transports")[self.deployment.transport.kind]

    @property
    def strategy(self) -> ModuleType:
        return variants("runtime.strategies")[self.deployment.strategy.kind]

    @property
    def policy(self) -> ModuleType:
        return variants("runtime.policies")[self.deployment.policy.kind]

    def new_policy(self, clock: Clock) -> Policy:
        """The policy, not yet connected; raises RuntimeFault where it does not fit the robot, or cannot be made."""
        from runtime.policies.tunnel.policy import through_tunnel

        if self.collecting:
            return self._teleoperation(clock)
        settings = self.deployment.policy
        try:
            made: Policy = self.policy.build(settings, self.robot, clock, self.rate)
            return through_tunnel(made, settings)
        except RuntimeFault:
            raise
        except Exception as error:  # of a policy's own code: it must not end coordinator
            logging.getLogger(__name__).exception("the policy's own code failed")
            raise ConfigurationError(
                f"policy {settings.kind!r} cannot be made: {type(error).__name__}: {error}"
            ) from error

    def _teleoperation(self, clock: Clock) -> Policy:
        """The policy that is asked while the operator drives the robot."""
        from runtime.teleoperators.relay import NodeLed, Relay

        wanted = self.deployment.collection
        if wanted is None:
            raise ConfigurationError("this deployment has no [collection]: it says nothing of who leads")
        if wanted.source == "node":
            return NodeLed()
        return Relay(self.leader(clock), self.robot, wanted.mode, wanted.max_age_s, self.rate, clock)

    def leader(self, clock: Clock) -> Leader:
        """The leader of a deployment that relays one, not yet connected."""
        wanted = self.deployment.collection
        if wanted is None or wanted.leader is None:
            raise ConfigurationError("this deployment has no [collection.leader]")
        made: Leader = variants("runtime.teleoperators")[wanted.leader.kind].build(
            wanted.leader, self.robot, clock
        )
        return made

    @property
    def capabilities(self) -> Capabilities:
        found: Capabilities = self.transport.capabilities(self.deployment.transport)
        return found

    @property
    def cameras(self) -> tuple[str, ...]:
        """Keys of the cameras that this deployment has: its own, and the robot's that its transport has."""
        has = {*self._delivered, *self.deployment.cameras}
        return tuple(camera.key for camera in self.robot.cameras if camera.key in has)

    @property
    def _delivered(self) -> tuple[str, ...]:
        """Keys of the cameras that the transport delivers: the robot's, unless it names fewer."""
        named = getattr(self.transport, "cameras", None)
        if named is None:
            return tuple(camera.key for camera in self.robot.cameras)
        fewer: tuple[str, ...] = named(self.deployment.transport, self.robot)
        return fewer

    def source(self, clock: Clock) -> Source:
        """The observations, not yet connected: the transport's, with the cameras of the deployment's own.

        The transport is told of a robot without these: it must not wait for them. What it leaves out itself stays.
        """
        settings, delivered = self.deployment, set(self._delivered)
        own = settings.cameras.keys() & delivered
        robot = replace(self.robot, cameras=tuple(c for c in self.robot.cameras if c.key not in own))
        source: Source = self.transport.source(settings.transport, robot, clock)
        if not settings.cameras:
            return source
        from runtime.cameras.attaching import attached

        return attached(source, settings.cameras, clock)

    @property
    def layout(self) -> SharedStateLayout:
        return SharedStateLayout(self.robot.dim, self.robot.eef_dim, self.cameras)

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
        """Dimensions that do not blend as numbers do: grippers that switch, angles without limits."""
        endless = np.flatnonzero(np.isinf(self.robot.lower) & np.isinf(self.robot.upper))
        return DimensionKinds(self.robot.binary_dims, tuple(endless.tolist()))

    def kinematics(self) -> Kinematics:
        """Forward and inverse kinematics of the robot, compiled or loaded when this returns."""
        settings = self.deployment.kinematics
        made: Kinematics = variants("runtime.kinematics")[settings.kind].build(settings, self.robot)
        return made

    def spaces(self, kinematics: Kinematics | None = None) -> ActionSpaces:
        """The robot's action spaces, with these kinematics of it or with its own."""
        from runtime.spaces.conversion import ActionSpaces

        return ActionSpaces(self.robot, kinematics or self.kinematics(), self.rate)

    def end_effectors(self) -> EndEffectors:
        """Poses of the robot's end effectors by joints: all that processes need that solve nothing."""
        from runtime.kinematics.forward import ChainForward
        from runtime.spaces.end_effectors import EndEffectors

        return EndEffectors(self.robot, ChainForward(self.robot))

    def publication(self) -> PosePublisher | None:
        """Publisher of the poses of a joint command; None where joints alone are published."""
        wanted = self.deployment.publication
        if wanted.space == "joint":
            return None
        from runtime.spaces.pose_rows import PoseRows
        from runtime.spaces.published_poses import PosePublisher

        return PosePublisher(PoseRows(wanted.pose, self.robot, "publication.pose"), self.end_effectors())


def unchecked(resolved: Resolved) -> StationSpec:
    """A deployment with its robot, whose parts are known to fit each other; ConfigurationError for no such robot."""
    settings = resolved.deployment
    try:
        grippers = {
            name: robots.GripperChoice(**given.model_dump()) for name, given in settings.grippers.items()
        }
        robot = robots.load(settings.robot, settings.groups, grippers)
    except robots.RobotError as error:
        raise ConfigurationError(str(error)) from None
    return StationSpec(resolved, robot)


def planned(path: str, unread: Collection[str] = ()) -> StationSpec:
    """The plan of the resolved deployment that a supervisor has checked and wrote there.

    Tables of the packages `unread` stay as they are written, and none of their kinds is loaded.
    """
    return unchecked(loader.resolve(json.loads(Path(path).read_text("utf-8")), {}, path, unread))
