"""Grippers by hand: open, close, lock where they are, give back; beside whatever moves the arms."""

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

_REACHED = 1e-3  # of its travel: a gripper that is so near to its lock is there


@dataclass(frozen=True, slots=True)
class GripperPlan:
    """Result of a request: locks float64 [D] (NaN: free), and the goal of a motion, None for none.

    A goal float64 [D] is NaN for all that stays where it is.
    """

    locks: Float64
    goal: Float64 | None


class Grippers:
    """The locks in force, and what requests make of them."""

    def __init__(self, spec: StationSpec) -> None:
        self._groups = [group for group in spec.robot.groups if group.gripper is not None]
        self._robot = spec.robot.name
        self._limits = spec.limits
        self._switches = binary_grippers_of(spec.robot)
        self.locks: Float64 = np.full(spec.robot.dim, np.nan)

    def plan_request(self, request: GripperRequest, commanded: Float64, free: bool) -> GripperPlan:
        """`free`: nothing else moves the arms, so that a gripper can be moved; else opening and closing lock it there.

        `commanded` [D] is where the robot was told to be. Raises RuntimeFault where it has no such gripper.
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
        """Locks [D] are in force, NaN where a gripper is free."""
        self.locks = locks

    def settled_locks(self, commanded: Float64) -> Float64:
        """The locks float64 [D], those that a gripper is still on its way to moved to where it was told to be."""
        commanded = snap_grippers(self._switches, commanded, commanded)
        travel = self._limits.upper - self._limits.lower
        away = np.abs(self.locks - commanded) > _REACHED * travel  # NaN, what is free, is not
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
        """For a snapshot: where each one was told to be [D], and whether it is locked."""
        return {
            group.name: {
                "locked": not bool(np.isnan(self.locks[group.gripper_dim])),
                "at": float(commanded[group.gripper_dim]),
            }
            for group in self._groups
        }
