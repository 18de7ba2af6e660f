"""A pair of hands for tests: moves an arm over the tabletop by inverse kinematics."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

import robots
from robots import Group, Robot
from robots.rotations import quaternion_of_matrix
from runtime.core.types import Float64
from runtime.kinematics.compiled import CompiledKinematics
from runtime.simulation.bench.arm_frames import arm_frames
from runtime.simulation.bench.bench import tip_in_world
from runtime.simulation.bench.block_table import BlockTable, ResetRequest
from runtime.simulation.bench.plant import Plant
from runtime.simulation.bench.tabletop import Tabletop

ROBOT = robots.load_robot("agilex_piper")
KINEMATICS = CompiledKinematics(ROBOT)
LEFT, RIGHT = ROBOT.arms
READY = ROBOT.poses["ready"]
RATE = 30
OPEN, SHUT = 0.1, 0.0
POSITIONS = {"block": [-0.15, 0.2, 20.0], "plate": [-0.2, 0.36]}


class SimulatedOperator:
    """A tabletop with its robot; `yaw` is that of the jaws [rad], `tilt` [rad] outwards from straight down."""

    def __init__(
        self,
        seed: int = 1,
        arm: Group = LEFT,
        blocks: int = 1,
        make: Callable[[Robot, int, int], BlockTable] = Tabletop,
    ) -> None:
        assert arm.gripper_dim is not None
        side = 1.0 if arm is LEFT else -1.0
        self.arm = arm
        self.gripper = arm.gripper_dim
        self.table = make(ROBOT, 0, blocks)
        positions = {name: [side * place[0], *place[1:]] for name, place in POSITIONS.items()}
        self.table.reset(ResetRequest(f"reset {seed}", seed, positions))
        self.plant = Plant(ROBOT, start=READY)

    @property
    def truth(self) -> dict[str, Any]:
        return self.table.truth()

    @property
    def block(self) -> tuple[float, float, float, float]:
        """x, y, z, yaw of the task's block."""
        x, y, z, yaw = self.truth["blocks"][0]
        return x, y, z, yaw

    @property
    def jaws(self) -> float:
        return float(self.plant.q[self.gripper])

    def commands(self, target: Float64, seconds: float) -> None:
        self.plant.target = target
        for _ in range(round(seconds * RATE)):
            self.table.advance(self.plant, 1 / RATE)

    def goes(self, x: float, y: float, z: float, yaw: float, tilt: float = 0.0, seconds: float = 1.0) -> None:
        """Fingertips to a place in the world; the gripper's command stays."""
        target = self._joints(tip(np.array([x, y, z]), yaw, tilt, self.arm))
        target[self.gripper] = self.plant.target[self.gripper]
        self.commands(target, seconds)

    def jaws_go(self, opening: float, seconds: float = 0.6) -> None:
        target = self.plant.target.copy()
        target[self.gripper] = opening
        self.commands(target, seconds)

    def closes_on_block(
        self, turn: float = 0.0, aside: float = 0.0, height: float = 0.02, tilt: float = 0.0
    ) -> None:
        """Down over the block with open jaws, and close; `aside` past its end, `turn` from its side."""
        x, y, _, yaw = self.block
        yaw += turn
        self.goes(x, y, 0.09, yaw, max(tilt, 0.1))
        x, y = (x, y) + aside * tip_in_world(ROBOT, self.arm, self.plant.q)[:2, 0]
        self.goes(x, y, 0.09, yaw, max(tilt, 0.1))
        self.goes(x, y, height, yaw, tilt)
        self.jaws_go(SHUT)

    def lifts(self) -> None:
        """Straight up, as the hand is."""
        raised = tip_in_world(ROBOT, self.arm, self.plant.q)
        raised[2, 3] = 0.07
        target = self._solved(raised, self.plant.q)
        target[self.gripper] = self.plant.target[self.gripper]
        self.commands(target, 1.0)

    def places(self) -> None:
        """Over the plate, down, open, up."""
        x, y = self.truth["plate"]
        yaw = self.block[3]
        self.goes(x, y, 0.08, yaw, 0.1)
        self.goes(x, y, 0.036, yaw)
        self.jaws_go(OPEN)
        self.lifts()

    def _joints(self, goal: Float64) -> Float64:
        """Of the ways in which jaws and a square are parallel, the one nearest to how the jaws are now."""
        ways = [goal @ about_z(quarter * math.pi / 2) for quarter in range(4)]
        start = READY.copy()
        dims = self.arm.joint_dims
        away = goal[:2, 3] - self.arm.mount[:2]
        start[dims] = [math.atan2(-away[0], away[1]), 1.6, -1.0, 0.0, 1.0, 0.0]
        there = tip_in_world(ROBOT, self.arm, self.plant.q)[:2, 1]
        best = max(ways, key=lambda way: float(way[:2, 1] @ there))
        return self._solved(best, start)

    def _solved(self, goal: Float64, start: Float64) -> Float64:
        assert self.arm.tip is not None
        index = ROBOT.arms.index(self.arm)
        eef = (
            np.linalg.inv(arm_frames(ROBOT)[self.arm.name].frame(start)) @ goal @ np.linalg.inv(self.arm.tip)
        )
        targets = KINEMATICS.forward(start)[None]
        targets[0, index] = [*eef[:3, 3], *quaternion_of_matrix(eef[:3, :3])]
        solved = KINEMATICS.solve(targets, start)
        assert solved.reached[0, index], f"{goal[:3, 3]} is out of reach"
        q = self.plant.target.copy()
        q[self.arm.joint_dims] = solved.q[0, self.arm.joint_dims]
        return q


def tip(place: Float64, yaw: float, tilt: float, arm: Group) -> Float64:
    """Fingertips at a place, jaws along `yaw`, leaning away from the arm's foot by `tilt`."""
    away = (place - arm.mount[:3])[:2]
    away /= np.linalg.norm(away)
    down = np.array([*(math.sin(tilt) * away), -math.cos(tilt)])
    across = np.array([math.cos(yaw), math.sin(yaw), 0.0])
    across -= (across @ down) * down
    across /= np.linalg.norm(across)
    goal = np.eye(4)
    goal[:3, :3] = np.column_stack([np.cross(across, down), across, down])
    goal[:3, 3] = place
    return goal


def about_z(angle: float) -> Float64:
    turned = np.eye(4)
    turned[:2, :2] = [[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]]
    return turned
