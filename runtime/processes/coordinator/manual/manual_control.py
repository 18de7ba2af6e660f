"""Manual control of the robot: motions, grippers, and previews of a target."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from typing import Any

import numpy as np

from runtime.core.errors import RuntimeFault
from runtime.core.sentences import Pattern
from runtime.core.types import Float64
from runtime.ipc.command_arguments import AimRequest, GripperRequest, MoveRequest, read
from runtime.ipc.shared_state import SharedState
from runtime.processes.coordinator.control_queue import ControlQueue
from runtime.processes.coordinator.manual.grippers import Grippers
from runtime.processes.coordinator.manual.targets import Targets, aim_to_dict
from runtime.processes.coordinator.runs import Runs
from runtime.processes.coordinator.setup.sequence import first_action
from runtime.station.spec import StationSpec

log = logging.getLogger(__name__)
_MOVES_NO_ROBOT = Pattern("manual.moves_no_robot", "{what}: transport {transport!r} moves no robot")


class ManualControl:
    """Motions within limits and workspace boxes, and locks of grippers; refusals are RuntimeFault."""

    def __init__(
        self, spec: StationSpec, shared: SharedState, orders: ControlQueue, runs: Runs, targets: Targets
    ) -> None:
        self._plan = spec
        self._shared_state = shared
        self._orders = orders
        self._runs = runs
        self._targets = targets
        self.grippers = Grippers(spec)
        status = shared.control.read()
        if bytes(status["behaviour"]):  # a predecessor that died may have locked some
            self.grippers.lock(np.array(status["locked"], np.float64))

    def prepare(self) -> None:
        """Start to load in the background the kinematics that jogs need."""
        self._targets.prepare()

    def require_robot(self, what: str) -> None:
        """Raise RuntimeFault if the transport moves no robot; `what` names the request in the message."""
        if not self._plan.capabilities.moves_robot:
            kind = self._plan.deployment.transport.kind
            raise RuntimeFault(_MOVES_NO_ROBOT(what=what, transport=kind))

    def is_loading(self, arguments: Mapping[str, Any]) -> bool:
        """Return True if a target with these arguments needs kinematics that are still loading.

        The first call starts to load them.
        """
        ready = self._targets.prepare()
        return not ready and arguments.get("jog") is not None

    def aim(self, arguments: Mapping[str, Any]) -> dict[str, Any]:
        """Return a preview of a target; nothing moves."""
        start = self.commanded()
        aim = self._targets.aim(read("aim", AimRequest, arguments), start)
        away = first_action(aim.joints, start, self._plan)["distance"]
        return aim_to_dict(aim, self._plan, away, self._targets.duration(start, aim.joints))

    def move(self, asked: MoveRequest) -> dict[str, Any]:
        """Move to a target on a limited path, within the open run."""
        start = self.commanded()
        goal = self._targets.motion_goal(asked, start)
        self._runs.move(goal, asked.speed)
        return {"duration_s": self._targets.duration(start, goal, asked.speed)}

    def check_motion(self, what: str, goal: Float64) -> Float64:
        """Return `goal` [D], a policy's action, with grippers clipped to their travel, if the path to it is allowed.

        `what` names the motion in messages.

        Raises:
            RuntimeFault: the path is not allowed.
        """
        self.require_robot(what)
        limits = self._plan.limits
        goal = np.where(limits.grippers, np.clip(goal, limits.lower, limits.upper), goal)
        return self._targets.check_motion(what, goal, self.commanded())

    def move_gripper(self, asked: GripperRequest, free: bool) -> dict[str, Any]:
        """Open, close, lock or unlock grippers; `free`: no policy moves the arms now."""
        self.require_robot("gripper")
        grip = self.grippers.plan_request(asked, self.commanded(), free)
        self.lock(grip.locks)
        if grip.goal is not None:
            self._runs.move(grip.goal, 1.0)
        return self.status()

    def status(self) -> dict[str, Any]:
        """Return the command and the lock of each gripper."""
        return {"grippers": self.grippers.status(self.commanded())}

    def stop_grippers(self) -> None:
        """Stop grippers: a gripper on its way to its lock is locked where it is."""
        locks = self.grippers.settled_locks(self.commanded())
        if not np.array_equal(locks, self.grippers.locks, equal_nan=True):
            try:
                self.lock(locks)
            except RuntimeFault as error:  # a stop must not fail for it
                log.error("a gripper goes on to its lock: %s", error)

    def unlock(self) -> None:
        """Unlock all grippers."""
        self.lock(np.full(self._plan.robot.dim, np.nan))

    def lock(self, locks: Float64) -> None:
        """Lock grippers at these values [D], NaN: unlocked."""
        self._orders.lock_grippers(locks)
        self.grippers.lock(locks)

    def commanded(self) -> Float64:
        """Return the commanded position of the robot [D], or the measured one if it is not engaged."""
        status = self._shared_state.control.read()
        joints = status["commanded"] if status["engaged"] else self._shared_state.observation.read()["qpos"]
        return np.array(joints, np.float64)
