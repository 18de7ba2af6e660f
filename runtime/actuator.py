"""Where commands leave: the last one sent, how fast it was moving, how it comes to a stand."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from runtime.behaviour import Target
from runtime.errors import RuntimeFault
from runtime.motion import Brake
from runtime.page import EStop, Page
from runtime.safety import SafetySettings
from runtime.transports.base import Sink
from runtime.types import Float64, RobotCommand


@dataclass(frozen=True, slots=True)
class TickSettings:
    """What a tick goes by; times in seconds."""

    period: float
    velocity: Float64  # [D] of motions of ours
    lower: Float64  # [D] joint limits
    upper: Float64
    grippers: NDArray[np.bool_]  # [D] dimensions in a unit of their own
    binary: NDArray[np.bool_]  # [D] dimensions that switch and have no velocity
    reach: Float64  # [D] what one rad of acceleration is in the dimension's own unit
    safety: SafetySettings
    heartbeat_timeout: float
    starvation_hold: float


@dataclass(frozen=True, slots=True)
class Sent:
    """What became of one tick: what was wanted, and float64 [D] of what left, None where nothing did."""

    time: float  # our monotonic clock [s]
    target: Target | None = None
    executed: Float64 | None = None
    notes: tuple[str, ...] = ()
    refused: bool = False


class Actuator:
    """Sends commands and remembers them; only an engaged one knows where the robot was told to be.

    A restarted control goes on from the last command of its predecessor, at rest.
    """

    def __init__(self, page: Page, sink: Sink, settings: TickSettings, clock: Callable[[], float]) -> None:
        self._page = page
        self._sink = sink
        self._settings = settings
        self._clock = clock
        before = page.control.read()
        self.engaged = bool(before["engaged"])
        self.commanded: Float64 = np.array(before["commanded"], np.float64)
        self.velocity: Float64 = np.zeros(page.layout.dim)
        self._last_planned = float("-inf")

    def engage(self, measured: Float64) -> None:
        """Take the robot over where it stands: from now on something is sent on every tick.

        The grippers of a robot that was engaged before keep their command: closing on an object, they measure
        wider than they were told, and would let go.
        """
        keep = self._settings.grippers & self.engaged
        self.commanded = np.where(keep, self.commanded, measured)
        self.velocity = np.zeros(len(measured))
        self.engaged = True

    def elapsed(self, planned: float) -> float:
        """Time since the last tick as limits may use it: half a period to 1.5 periods."""
        period = self._settings.period
        return float(min(max(planned - self._last_planned, period * 0.5), 1.5 * period))

    def ticked(self, planned: float) -> None:
        """The tick planned for `planned` is over, whether it sent anything or not."""
        self._last_planned = planned

    def brake(self) -> Brake:
        """A stop from the last commanded velocity, as hard as needed to stay within the joint limits."""
        bounds, speed = self._settings, self.velocity
        ahead = np.where(speed > 0, bounds.upper - self.commanded, self.commanded - bounds.lower)
        needed = speed * speed / (2.0 * np.maximum(ahead, 1e-9))
        softest = bounds.safety.brake_acceleration * bounds.reach
        rate = np.clip(needed, softest, np.maximum(softest, bounds.safety.acceleration * bounds.reach))
        return Brake(self.commanded.copy(), speed.copy(), rate, bounds.lower, bounds.upper)

    def tell(self, word: str, data: Mapping[str, Any]) -> str:
        """Pass a control word on to the node, unless the e-stop is pressed; why it was not, "" where it was."""
        if self._page.estop is not EStop.CLEAR:
            return f"{word} is not passed on to the node while the e-stop is not known to be clear"
        try:
            self._sink.tell(word, data)
        except RuntimeFault as error:
            return str(error)
        return ""

    def send(
        self, step: int, planned: float, target: Target, action: Float64, notes: tuple[str, ...] = ()
    ) -> Sent:
        """Send `action`, which is what safety made of `target`."""
        now = self._clock()
        if self._page.estop is EStop.LATCHED and target.source != "estop":
            # Pressed since this tick looked: the next one takes over, this one repeats the last command.
            action, notes = self.commanded, ("e-stop pressed within the tick",)
        self._sink.send(RobotCommand(action.astype(np.float32), step, now))
        velocity = (action - self.commanded) / self.elapsed(planned)
        self.velocity = np.where(self._settings.binary, 0.0, velocity)
        self.commanded = action
        return Sent(now, target, action, notes)
