"""Leader interface: a device that the operator moves and whose joints the robot follows."""

from __future__ import annotations

import threading
from abc import ABC, abstractmethod
from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from runtime.core.clock import Clock
from runtime.core.errors import CodecError
from runtime.core.types import Float64

if TYPE_CHECKING:
    from collections.abc import Mapping

    from robots import Robot

_RATE_WINDOW = 40  # number of arrivals
_SILENT_S = 2.0  # [s]; after that the rate is 0


@dataclass(frozen=True, slots=True)
class LeaderPose:
    """Pose of the leader: `joints` float64 [D] in the robot's order and units, NaN for joints that it lacks."""

    joints: Float64
    arrived: float  # arrival on our monotonic clock, or capture if that is known [s]


class Leader(ABC):
    """One leader. A thread receives its messages; its newest pose can be read without waiting."""

    def __init__(self, robot: Robot, clock: Clock) -> None:
        self._robot = robot
        self._clock = clock
        self._lock = threading.Lock()
        self._newest: LeaderPose | None = None
        self._arrivals: deque[float] = deque(maxlen=_RATE_WINDOW)
        self._refused = ""

    @property
    @abstractmethod
    def name(self) -> str:
        """Kind and address of the leader, for messages."""

    @property
    def start_s(self) -> float:
        """Time from `connect` beyond which a leader without a first pose counts as absent [s]."""
        return 5.0

    @abstractmethod
    def connect(self) -> None:
        """Start to listen; a leader that starts later is connected then. Raises RuntimeFault."""

    @abstractmethod
    def close(self) -> None:
        """Stop listening. Safe to call twice."""

    @property
    def latest_pose(self) -> LeaderPose | None:
        """Newest pose of the leader; None if no pose has arrived since `connect`."""
        with self._lock:
            return self._newest

    @property
    def rate(self) -> float:
        """Poses per second [Hz]; 0 if there was none for 2 s."""
        with self._lock:
            times = list(self._arrivals)
        if len(times) < 2 or self._clock.now() - times[-1] > _SILENT_S:
            return 0.0
        return (len(times) - 1) / max(times[-1] - times[0], 1e-9)

    @property
    def problem(self) -> str:
        """Reason why the newest message could not be used, "" if it could."""
        with self._lock:
            return self._refused

    def _forget(self) -> None:
        with self._lock:
            self._newest, self._refused = None, ""
            self._arrivals.clear()

    def _set_pose(self, joints: Float64, arrived: float) -> None:
        with self._lock:
            self._newest, self._refused = LeaderPose(joints, arrived), ""
            self._arrivals.append(arrived)

    def _refuse(self, reason: str) -> None:
        with self._lock:
            self._refused = reason


def joints_from_state(state: Mapping[str, object], robot: Robot) -> Float64:
    """Return the joints [D] of the groups in `state`, NaN for absent groups.

    Raises CodecError if they do not fit the robot.
    """
    names = [group.name for group in robot.groups]
    unknown = [str(name) for name in state if name not in names]
    if unknown or not state:
        raise CodecError(
            f"the leader's groups are {', '.join(map(str, state)) or 'none'}; {robot.name} has {', '.join(names)}"
        )
    parts = []
    for group in robot.groups:
        group_state = state.get(group.name)
        part = np.full(group.dof, np.nan) if group_state is None else np.asarray(group_state, np.float64)
        if part.shape != (group.dof,):
            raise CodecError(
                f"the leader's {group.name} has the shape {list(part.shape)}; expected [{group.dof}]"
            )
        if group_state is not None and not np.isfinite(part).all():
            raise CodecError(f"the leader's {group.name} is {part.tolist()}; expected finite numbers")
        parts.append(part)
    return np.concatenate(parts)
