"""A leader as a source of actions: where it is becomes a few equal rows, asked for like any policy's.

So that what a person wants takes the same way as what a policy wants: timeline, locks, safety, record.
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
    "{who} has said nothing for {seconds:.2f} s, allowed {allowed:g} (collection.max_age_s){because}",
)
_SAID_NOTHING = Pattern("leader.said_nothing", "{who} has said nothing{because}")
_JOINTS_SHAPE = Pattern("leader.joints_shape", "the observation has joints of shape {shape}")
_NODE_LEADER = fixed("leader.node_leader", "the node's own leader")
_NODE_DRIVES = fixed(
    "leader.node_drives",
    "the node drives the robot by its own leader: there is nothing to ask",
)

FollowMode = Literal["absolute", "relative"]
_FOUND_S = 5.0  # for a leader to say something when the station is set up
_LOOK_S = 0.02
_SPARE_ROWS = 2  # beyond the age limit: silence is told by its age, not by starvation


class LeaderPolicy(Policy):
    """Follows a leader: to where it is ("absolute"), or by as much as it moved since the engagement ("relative").

    The engagement is the first question after a reset, or after the robot was held: what the leader did meanwhile is
    not caught up. Grippers are absolute in either; joints of groups that the leader does not have stay where the robot
    had them then. That is where they were told to be, if they stand within `steady_error` of it: from where they are
    read, gravity would lower the arm at each engagement.
    """

    uses_images = False

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
        self._last: Float64 | None = None  # where the leader was at the question before
        self._wanted: Float64 = np.zeros(robot.dim)

    def connect(self) -> PolicyInfo:
        """Listen, and wait for the leader to say where it is; PolicyLostError where it does not."""
        self.leader.connect()
        deadline = self._clock.now() + _FOUND_S
        while self.leader.latest_pose is None:
            if self._clock.now() > deadline:
                raise PolicyLostError(self.leader_problem() or _SAYS_NOTHING(who=self.leader.name))
            self._clock.sleep_until(self._clock.now() + _LOOK_S)
        return PolicyInfo(self.leader.name, action_space="joint")

    def leader_problem(self) -> str:
        """Why the leader cannot be followed just now, "" where it can."""
        newest, why = self.leader.latest_pose, self.leader.problem
        because = _BECAUSE(why=why) if why else ""
        if newest is None:
            return _SAID_NOTHING(who=self.leader.name, because=because)
        age = self._clock.now() - newest.arrived
        if age > self._max_age:
            return _SILENT(who=self.leader.name, seconds=age, allowed=self._max_age, because=because)
        return ""

    def infer(self, observation: Observation, conditioning: Conditioning | None = None) -> ActionChunk:
        """Rows float32 [H, D], all equal; PolicyLostError where the leader is silent for too long."""
        if observation.qpos.shape != (self._dim,):
            raise PolicyError(_JOINTS_SHAPE(shape=list(observation.qpos.shape)))
        pose = self._pose()
        if self._last is None:
            self._wanted = self._engaged_at(np.asarray(observation.qpos, np.float64), observation.commanded)
        target = self._follow(pose)
        return ActionChunk(np.tile(target, (self._rows, 1)).astype(np.float32))

    def first_goal(self, qpos: Float64, commanded: Float64 | None) -> Float64 | None:
        """First goal of a robot at `qpos` that is told to be at `commanded` [D], None where it is told nothing.

        None if the leader is silent, or leads from where it is.
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
        newest, why = self.leader.latest_pose, self.leader_problem()
        if newest is None or why:
            raise PolicyLostError(why)
        return newest

    def _follow(self, pose: LeaderPose) -> Float64:
        joints, last = pose.joints, self._last
        self._last = joints
        has = ~np.isnan(joints)
        placed = has & (self._grippers if self.mode == "relative" else True)
        if last is not None:
            # Step by step, so that an angle that wraps can be turned on and on.
            moved = np.nan_to_num(difference(joints, last, self._endless))
            self._wanted = self._wanted + np.where(placed, 0.0, moved)
        self._wanted = np.where(placed, joints, self._wanted)
        return self._wanted

    def reset(self) -> None:
        """The next question engages anew."""
        self._last = None

    def resume(self) -> None:
        """The robot was held, or not seen: so it does after that."""
        self.reset()

    def close(self) -> None:
        self.leader.close()


class NodeDrivenPolicy(Policy):
    """The robot's own node reads the leader and drives: nobody is asked here, what it applied is recorded."""

    is_queried = False
    uses_images = False

    def connect(self) -> PolicyInfo:
        return PolicyInfo(_NODE_LEADER)

    def infer(self, observation: Observation, conditioning: Conditioning | None = None) -> ActionChunk:
        raise PolicyError(_NODE_DRIVES)

    def reset(self) -> None:
        """Nothing to forget."""

    def close(self) -> None:
        """Nothing to release."""
