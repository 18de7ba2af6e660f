"""Manual control of grippers: open, close, lock and unlock, also while the arms move."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from robots.robot import Group
from runtime.core.errors import RuntimeFault
from runtime.core.sentences import Pattern
from runtime.core.types import Float64
from runtime.ipc.command_arguments import GripperRequest
from runtime.spaces.binary_grippers import binary_grippers_of, snap_grippers
from runtime.station.spec import StationSpec

_NO_SUCH_ARM = Pattern("grippers.no_such_arm", "gripper: arm = {arm!r}; {robot} has grippers on {names}")

_REACHED = 1e-3  # share of its travel within which a gripper has reached its lock


@dataclass(frozen=True, slots=True)
class GripperPlan:
    """Result of a request: locks float64 [D] (NaN: unlocked), and the goal of a motion, or None.

    A goal is float64 [D], NaN for dimensions that do not move.
    """

    locks: Float64
    goal: Float64 | None


class Grippers:
    """Grippers of a station, with their present `locks` [D].

    It also plans the requests to open, close, lock or unlock grippers.
    """

    def __init__(self, spec: StationSpec) -> None:
        self._groups = [group for group in spec.robot.groups if group.gripper is not None]
        self._robot = spec.robot.name
        self._limits = spec.limits
        self._switches = binary_grippers_of(spec.robot)
        self.locks: Float64 = np.full(spec.robot.dim, np.nan)

    def plan_request(self, request: GripperRequest, commanded: Float64, free: bool) -> GripperPlan:
        """Return new locks and motion for a request; `commanded` [D] is the commanded position.

        If `free`, nothing else moves the arms, and opening or closing is a motion. A gripper that was locked is then
        locked at the end of this motion. If not `free`, opening or closing locks the gripper at its open or closed
        position, without a motion.

        Raises:
            RuntimeFault: the robot has no such gripper.
        """
        chosen = self._chosen(request.arm)
        commanded = snap_grippers(self._switches, commanded, commanded)
        locks, goal = self.locks.copy(), np.full(len(commanded), np.nan)
        for group in chosen:
            dim, gripper = group.gripper_dim, group.gripper
            assert dim is not None
            assert gripper is not None
            if request.action == "unlock":
                locks[dim] = np.nan
            elif request.action == "lock":
                locks[dim] = commanded[dim]
            else:
                goal[dim] = gripper.open if request.action == "open" else gripper.close
                if not free or not np.isnan(locks[dim]):
                    locks[dim] = goal[dim]
        moves = free and request.action in ("open", "close")
        return GripperPlan(locks, goal if moves else None)

    def lock(self, locks: Float64) -> None:
        """Set the locks [D], NaN: unlocked."""
        self.locks = locks

    def settled_locks(self, commanded: Float64) -> Float64:
        """Return the locks float64 [D] with which all grippers stay where they are.

        A lock that its gripper has not reached is replaced by the commanded position.
        """
        commanded = snap_grippers(self._switches, commanded, commanded)
        travel = self._limits.upper - self._limits.lower
        away = np.abs(self.locks - commanded) > _REACHED * travel  # NaN (unlocked) compares as False
        return np.where(away, commanded, self.locks)

    def _chosen(self, name: str | None) -> list[Group]:
        if name is None and self._groups:
            return self._groups
        chosen = [group for group in self._groups if group.name == name]
        if not chosen:
            names = ", ".join(group.name for group in self._groups) or "none"
            raise RuntimeFault(_NO_SUCH_ARM(arm=name, robot=self._robot, names=names))
        return chosen

    def status(self, commanded: Float64) -> dict[str, Any]:
        """Return for a snapshot the commanded position of each gripper, and whether it is locked."""
        return {
            group.name: {
                "locked": not bool(np.isnan(self.locks[group.gripper_dim])),
                "at": float(commanded[group.gripper_dim]),
            }
            for group in self._groups
        }
