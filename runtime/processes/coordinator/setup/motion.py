"""Generated motion of a set-up: it is sent to control, which reports its end; then the arm must arrive."""

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
_NOT_COME = Pattern("motion.not_come", "control did not reach {where} within {seconds:.1f} s")
_NOT_ARRIVED = Pattern(
    "motion.not_arrived",
    "the arm did not arrive: {joint} is {distance:.2f} rad from {where}; is it blocked, or is another "
    "program commanding it?",
)

_SETTLE_S = 2.0  # [s] for the arm to follow the last target of a motion
_ARRIVED_RAD = 0.1


class SetupMotion:
    """Generated motion of a set-up, one at a time; messages name its goal by the argument `where`."""

    def __init__(self, spec: StationSpec, orders: ControlQueue, shared: SharedState, clock: Clock) -> None:
        self._plan = spec
        self._orders = orders
        self._shared_state = shared
        self._clock = clock
        self._ways = PathCheck(spec)

    def start(self, goal: Float64, where: str) -> None:
        """Send the motion to `goal` [D] to control.

        Raises:
            RuntimeFault: the path is not free; nothing moves.
        """
        self._ways.check(_GOING(where=where), self._start(), goal)
        self._goal, self._where = goal, where
        self._allowed = self._motion_time() + _SETTLE_S
        self._since = self._clock.now()
        self._order = self._orders.send_order("motion", goal=np.array(goal, np.float64))

    def require_progress(self) -> None:
        """Raise SetupError if control should have finished the motion by now."""
        if self._clock.now() - self._since > self._allowed:
            raise SetupError(_NOT_COME(where=self._where, seconds=self._allowed))

    def is_sent(self, event: Event) -> bool:
        """Return True if `event` reports that control has sent the whole motion.

        The time in which the arm must arrive then begins.
        """
        over = event.kind == "motion_done" and event.data.get("order") == self._order
        if over:
            self._since = self._clock.now()
        return over

    def has_arrived(self) -> bool:
        """Return True if the arm has arrived.

        Raises:
            SetupError: the arm has not arrived in time; the message names the joint.
        """
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
        """Return how long the whole motion takes, from its start position to the goal [s]."""
        safety, limits = self._plan.deployment.safety, self._plan.limits
        velocity = limits.velocity * safety.motion_velocity_scale
        acceleration = safety.motion_acceleration * limits.radian_scale
        return Trajectory(self._start(), self._goal, velocity, acceleration).duration

    def _start(self) -> Float64:
        """Return the position from which control will start [D]."""
        status = self._shared_state.control.read()
        start = status["commanded"] if status["engaged"] else self._shared_state.observation.read()["qpos"]
        return np.array(start, np.float64)
