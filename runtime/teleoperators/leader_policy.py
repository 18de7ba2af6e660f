"""Leader as a policy: its pose becomes a chunk of equal rows, requested like a policy's chunk.

A person's motion thereby uses the same path as a policy's: timeline, locks, safety and recording.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Literal

import numpy as np

from runtime.core.clock import Clock
from runtime.core.errors import PolicyError, PolicyLostError
from runtime.core.sentences import Pattern, fixed
from runtime.core.types import ActionChunk, Conditioning, Float64, Observation
from runtime.motion.timeline import difference
from runtime.policies.base import Policy, PolicyInfo
from runtime.teleoperators.base import Leader, LeaderPose

if TYPE_CHECKING:
    from robots import Robot

_BECAUSE = Pattern("leader.because", ": {why}")
_SAYS_NOTHING = Pattern("leader.says_nothing", "{who} says nothing")
_SILENT = Pattern(
    "leader.silent",
    "{who}: last message {seconds:.2f} s ago; allowed: {allowed:g} s (collection.max_age_s){because}",
)
_SAID_NOTHING = Pattern("leader.said_nothing", "{who}: no message yet{because}")
_JOINTS_SHAPE = Pattern("leader.joints_shape", "the observation has joints of shape {shape}")
_NODE_LEADER = fixed("leader.node_leader", "the node's own leader")
_NODE_DRIVES = fixed(
    "leader.node_drives",
    "the node drives the robot by its own leader: there is nothing to ask",
)

FollowMode = Literal["absolute", "relative"]
_LOOK_S = 0.02  # polling period [s]
_SPARE_ROWS = 2  # rows beyond the age limit: silence is reported by its age, not by starvation


class LeaderPolicy(Policy):
    """Policy that follows a leader: to its pose ("absolute"), or by its motion since the engagement ("relative").

    The engagement is the first request after a reset or a hold; motion of the leader before it has no effect. Grippers
    are absolute in both modes.

    Joints of groups that the leader lacks remain where they were at the engagement. That is their commanded position if
    it is within `steady_error` of the measured position, otherwise the measured position. Starting from the measured
    position in every case would let gravity lower the arm at each engagement.
    """

    uses_images = False
    is_person = True

    def __init__(
        self,
        leader: Leader,
        robot: Robot,
        mode: FollowMode,
        max_age: float,
        rate: float,
        clock: Clock,
        steady_error: float,
    ) -> None:
        self.leader = leader
        self._steady_error = steady_error
        self.mode = mode
        self._max_age = max_age
        self._rows = math.ceil(max_age * rate) + _SPARE_ROWS
        self._clock = clock
        self._dim = robot.dim
        self._grippers = np.isin(np.arange(robot.dim), robot.gripper_dims)
        self._endless = tuple(np.flatnonzero(np.isinf(robot.lower) & np.isinf(robot.upper)).tolist())
        self._last: Float64 | None = None  # joints of the leader at the previous request
        self._wanted: Float64 = np.zeros(robot.dim)

    def connect(self) -> PolicyInfo:
        """Start to listen and wait for the leader's first pose. Raises PolicyLostError if none arrives in time."""
        self.leader.connect()
        begun = self._clock.now()
        while self.leader.latest_pose is None:
            if self._clock.now() - begun > self.leader.start_s:
                raise PolicyLostError(self.leader_problem() or _SAYS_NOTHING(who=self.leader.name))
            self._clock.sleep_until(self._clock.now() + _LOOK_S)
        return PolicyInfo(self.leader.name, action_space="joint")

    def leader_problem(self) -> str:
        """Return why the leader cannot be followed now, "" if it can."""
        newest, problem = self.leader.latest_pose, self.leader.problem
        because = _BECAUSE(why=problem) if problem else ""
        if newest is None:
            return _SAID_NOTHING(who=self.leader.name, because=because)
        age = self._clock.now() - newest.arrived
        if age > self._max_age:
            return _SILENT(who=self.leader.name, seconds=age, allowed=self._max_age, because=because)
        return ""

    def infer(self, observation: Observation, conditioning: Conditioning | None = None) -> ActionChunk:
        """Return equal rows float32 [H, D]. Raises PolicyLostError if the leader has been silent for too long."""
        if observation.qpos.shape != (self._dim,):
            raise PolicyError(_JOINTS_SHAPE(shape=list(observation.qpos.shape)))
        pose = self._pose()
        if self._last is None:
            self._wanted = self._engaged_at(np.asarray(observation.qpos, np.float64), observation.commanded)
        target = self._follow(pose)
        return ActionChunk(np.tile(target, (self._rows, 1)).astype(np.float32))

    def first_goal(self, qpos: Float64, commanded: Float64 | None) -> Float64 | None:
        """Return the joints [D] to approach before following starts.

        None if the leader is silent, or following is relative.

        Args:
            qpos: Measured joints of the robot [D].
            commanded: Commanded position [D], None if there is none.
        """
        if self.mode == "relative" or self.leader_problem():
            return None
        joints = self._pose().joints
        return np.where(np.isnan(joints), self._engaged_at(qpos, commanded), joints)

    def _engaged_at(self, qpos: Float64, commanded: Float64 | None) -> Float64:
        if commanded is None:
            return qpos.copy()
        off = np.abs(difference(commanded, qpos, self._endless))
        return np.where(off <= self._steady_error, commanded, qpos)

    def _pose(self) -> LeaderPose:
        newest, problem = self.leader.latest_pose, self.leader_problem()
        if newest is None or problem:
            raise PolicyLostError(problem)
        return newest

    def _follow(self, pose: LeaderPose) -> Float64:
        joints, last = pose.joints, self._last
        self._last = joints
        has = ~np.isnan(joints)
        placed = has & (self._grippers if self.mode == "relative" else True)
        if last is not None:
            # Incrementally, so that a joint without limits can be turned any number of times.
            moved = np.nan_to_num(difference(joints, last, self._endless))
            self._wanted = self._wanted + np.where(placed, 0.0, moved)
        self._wanted = np.where(placed, joints, self._wanted)
        return self._wanted

    def reset(self) -> None:
        """Forget the engagement, so that the next request engages the leader anew."""
        self._last = None

    def resume(self) -> None:
        """Begin a new engagement of the leader at the next request.

        This is needed because the robot was held, or because there were no observations.
        """
        self.reset()

    def close(self) -> None:
        self.leader.close()


class NodeDrivenPolicy(Policy):
    """Policy of a robot whose own node follows the leader: nothing is requested, the node's actions are recorded."""

    is_queried = False
    uses_images = False

    def connect(self) -> PolicyInfo:
        return PolicyInfo(_NODE_LEADER)

    def infer(self, observation: Observation, conditioning: Conditioning | None = None) -> ActionChunk:
        raise PolicyError(_NODE_DRIVES)

    def reset(self) -> None:
        """Do nothing, because there is no state."""

    def close(self) -> None:
        """Do nothing, because there is no connection."""
