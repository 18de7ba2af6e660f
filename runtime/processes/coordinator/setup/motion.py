"""A motion of ours that a set-up waits for: sent to control, awaited there, then by the arm itself."""

from __future__ import annotations

import numpy as np

from runtime.core.clock import Clock
from runtime.core.errors import SetupError
from runtime.core.sentences import Pattern
from runtime.core.types import Float64
from runtime.ipc.messages import Event
from runtime.ipc.shared_state import SharedState
from runtime.motion.timeline import difference
from runtime.motion.trajectories import Trajectory
from runtime.processes.coordinator.control_queue import ControlQueue
from runtime.processes.coordinator.path_check import PathCheck
from runtime.station.spec import StationSpec

_GOING = Pattern("motion.going", "going to {where}")
_NOT_COME = Pattern("motion.not_come", "control has not come to {where} within {seconds:.1f} s")
_NOT_ARRIVED = Pattern(
    "motion.not_arrived",
    "the arm did not arrive: {joint} is {distance:.2f} rad from {where}; is it blocked, or is another "
    "program commanding it?",
)

_SETTLE_S = 2.0  # for the arm to follow the last target of a motion
_ARRIVED_RAD = 0.1


class SetupMotion:
    """One motion at a time; `where` names its goal in sentences."""

    def __init__(self, spec: StationSpec, orders: ControlQueue, shared: SharedState, clock: Clock) -> None:
        self._plan = spec
        self._orders = orders
        self._shared_state = shared
        self._clock = clock
        self._ways = PathCheck(spec)

    def start(self, goal: Float64, where: str) -> None:
        """Have control go to `goal` [D]; RuntimeFault, and nothing moves, where the way there is not free."""
        self._ways.check(_GOING(where=where), self._start(), goal)
        self._goal, self._where = goal, where
        self._allowed = self._motion_time() + _SETTLE_S
        self._since = self._clock.now()
        self._order = self._orders.send_order("motion", goal=np.array(goal, np.float64))

    def require_progress(self) -> None:
        """SetupError where control should have been there by now."""
        if self._clock.now() - self._since > self._allowed:
            raise SetupError(_NOT_COME(where=self._where, seconds=self._allowed))

    def is_sent(self, event: Event) -> bool:
        """True if `event` says that control has sent the end of this motion: then the arm is waited for."""
        over = event.kind == "motion_done" and event.data.get("order") == self._order
        if over:
            self._since = self._clock.now()
        return over

    def has_arrived(self) -> bool:
        """True if the arm is there; SetupError, naming the joint, where it does not come."""
        measured = np.array(self._shared_state.observation.read()["qpos"], np.float64)
        limits = self._plan.limits
        away = np.abs(difference(measured, self._goal, self._plan.dims.wrapping))
        error = np.where(limits.position_mask, away, 0.0)
        worst = int(error.argmax())
        if error[worst] <= _ARRIVED_RAD:
            return True
        if self._clock.now() - self._since > _SETTLE_S:
            raise SetupError(
                _NOT_ARRIVED(joint=limits.names[worst], distance=error[worst], where=self._where)
            )
        return False

    def _motion_time(self) -> float:
        """Duration of the motion from where control will start it [s]."""
        safety, limits = self._plan.deployment.safety, self._plan.limits
        velocity = limits.velocity * safety.motion_velocity_scale
        acceleration = safety.motion_acceleration * limits.radian_scale
        return Trajectory(self._start(), self._goal, velocity, acceleration).duration

    def _start(self) -> Float64:
        """Position from which control will start [D]."""
        status = self._shared_state.control.read()
        start = status["commanded"] if status["engaged"] else self._shared_state.observation.read()["qpos"]
        return np.array(start, np.float64)
