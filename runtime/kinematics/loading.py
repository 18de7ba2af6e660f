"""A backend that is loaded when something is first to be solved, beside whoever goes on meanwhile."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future
from threading import Lock

from runtime.core.errors import RuntimeFault, SetupError
from runtime.core.types import Float64
from runtime.kinematics.base import Forward, IkResult, Kinematics

Make = Callable[[], Kinematics]


class LazyKinematics(Kinematics):
    """The kinematics that `make` makes, once and where `aside` has it done; joints become poses from the start.

    A station whose policy speaks joints starts without a compiler, and never loads one.
    """

    def __init__(
        self,
        forward: Forward,
        make: Make,
        aside: Callable[[Make], Future[Kinematics]],
        compiled: Callable[[], bool] = lambda: True,
    ) -> None:
        """`compiled`: whether `make` would have nothing to compile."""
        self._forward = forward  # until it is there
        self._make, self._aside, self._compiled = make, aside, compiled
        self._made: Future[Kinematics] | None = None
        self._once = Lock()

    def prepare(self) -> bool:
        """Begin to load, where nobody has; whether `solve` would not have to wait for that."""
        return self._start_loading().done()

    def compile(self) -> Future[Kinematics] | None:
        """Begin to compile what a run could need; None where there is nothing to compile, and nothing is loaded."""
        if self._made is None and self._compiled():
            return None
        return self._start_loading()

    def forward(self, q: Float64) -> Float64:
        """Poses [..., arms, 7] for joint vectors [..., D]; KinematicsError for another width. Waits for nothing."""
        made = self._made
        if made is None or not made.done() or made.exception() is not None:
            return self._forward.forward(q)
        return made.result().forward(q)

    def solve(
        self,
        targets: Float64,
        seed: Float64,
        dt: float | None = None,
        anchor: Float64 | None = None,
        anchor_row: int = 0,
    ) -> IkResult:
        """As the backend's, once it is there; SetupError where it cannot be made."""
        return self._start_loading().result().solve(targets, seed, dt, anchor, anchor_row)

    def _start_loading(self) -> Future[Kinematics]:
        with self._once:
            if self._made is None:
                self._made = self._aside(self._result)
            return self._made

    def _result(self) -> Kinematics:
        try:
            return self._make()
        except RuntimeFault:
            raise
        except Exception as error:  # of a compiler or a library: it must not end the coordinator
            raise SetupError(f"kinematics cannot be made: {type(error).__name__}: {error}") from error
