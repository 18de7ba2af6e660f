"""An arm that stands below its command, as gravity and a payload make it: servos with a steady load."""

from __future__ import annotations

from typing import Any

import numpy as np

from runtime.core.types import Float64
from runtime.ipc.shared_state import EStop
from tests.runtime.tick_bench import PERIOD, Bench

SUBSTEP_S = 1e-3
SAGS = 1.0  # [rad/s]
STIFFNESS, DAMPING = 900.0, 60.0  # [1/s2], [1/s]: critically damped, a lag of 67 ms


class Compliant(Bench):
    """Servos with a proportional and a derivative part under a steady load; they stand `error` below their command.

    Its node holds it where it stands until it is told otherwise. Nothing passes `wall` [D].
    """

    def __init__(self, error: float | Float64 = 0.05, noise: float = 0.0, **given: Any) -> None:
        self.error = np.broadcast_to(np.asarray(error, float), 2).copy()
        self.wall = np.full(2, np.inf)
        self.true, self.speed = np.zeros(2), np.zeros(2)
        self.node = self.error.copy()
        self.limp: Float64 | None = None  # [D] where it sags to, whatever it is told, while its drive is off
        self.course: list[Float64] = []
        self._random, self._noise = np.random.default_rng(1), noise
        super().__init__({"kind": "naive"}, **given)

    def observe(self, **changes: Any) -> None:
        read = self.true + self._noise * self._random.standard_normal(2)
        super().observe(**{"qpos": read.astype(np.float32), **changes})

    def move(self, seconds: float) -> None:
        told = self.sent[-1] if len(self.sent) else self.node
        if self.limp is not None:
            self.true = self.true + np.clip(self.limp - self.true, -SAGS * seconds, SAGS * seconds)
            self.speed = np.zeros(2)
            seconds = 0.0
        for _ in range(round(seconds / SUBSTEP_S)):
            push = STIFFNESS * (told - self.error - self.true) - DAMPING * self.speed
            self.speed = self.speed + push * SUBSTEP_S
            self.true = self.true + self.speed * SUBSTEP_S
            self.speed[self.true > self.wall] = 0.0
            self.true = np.minimum(self.true, self.wall)
        self._measured = self.true.copy()
        self.course.append(self.true.copy())

    def seconds(self, seconds: float) -> Compliant:
        """Let so much time pass."""
        self.run(round(seconds / PERIOD))
        return self

    def stop(self) -> Compliant:
        """Press the e-stop."""
        self.shared.set_estop(EStop.LATCHED)
        return self

    def release(self) -> Compliant:
        """Release it."""
        self.shared.set_estop(EStop.CLEAR)
        return self


def standing(error: float | Float64 = 0.05, **given: Any) -> Compliant:
    """At 0 for three seconds, told by a motion."""
    bench = Compliant(error, **given)
    bench.say("motion", goal=np.zeros(2))
    return bench.seconds(3.0)
