"""Kinematics whose backend is loaded in the background on first use."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future
from threading import Lock

from runtime.core.errors import RuntimeFault, SetupError
from runtime.core.types import Float64
from runtime.kinematics.base import Forward, IkResult, Kinematics

Make = Callable[[], Kinematics]


class LazyKinematics(Kinematics):
    """Kinematics with a backend that is built in the background on first use; `forward` works at once.

    `make` builds the backend and is called at most once; `aside` calls a function in the background and returns its
    future. A station with a policy in joint space starts without a compiler and never loads one.
    """

    def __init__(
        self,
        forward: Forward,
        make: Make,
        aside: Callable[[Make], Future[Kinematics]],
        compiled: Callable[[], bool] = lambda: True,
    ) -> None:
        """Store the functions, without calling any of them.

        Args:
            forward: Forward kinematics that are used until the backend is loaded.
            make: Builds the backend.
            aside: Calls a function in the background and returns its future.
            compiled: Returns True if `make` would have nothing to compile.
        """
        self._forward = forward  # used until the backend is loaded
        self._make, self._aside, self._compiled = make, aside, compiled
        self._made: Future[Kinematics] | None = None
        self._once = Lock()

    def prepare(self) -> bool:
        """Start to load the backend, if that was not done yet; return True if `solve` would not have to wait for it."""
        return self._start_loading().done()

    def compile(self) -> Future[Kinematics] | None:
        """Start to compile everything that a run may need; return None, without loading anything, if all is
        compiled.
        """
        if self._made is None and self._compiled():
            return None
        return self._start_loading()

    def forward(self, q: Float64) -> Float64:
        """Return poses [..., arms, 7] for joint vectors [..., D], without waiting for the backend.

        Raises:
            KinematicsError: The joint vectors have another width.
        """
        future = self._made
        if future is None or not future.done() or future.exception() is not None:
            return self._forward.forward(q)
        return future.result().forward(q)

    def solve(
        self,
        targets: Float64,
        seed: Float64,
        dt: float | None = None,
        anchor: Float64 | None = None,
        anchor_row: int = 0,
    ) -> IkResult:
        """Solve with the backend, after waiting for it.

        Raises:
            SetupError: The backend cannot be built.
        """
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
        except Exception as error:  # of a compiler or library; the coordinator must survive it
            raise SetupError(f"kinematics cannot be created: {type(error).__name__}: {error}") from error
