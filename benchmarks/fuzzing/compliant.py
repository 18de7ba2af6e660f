"""Arm with a steady error under load: while it holds, nothing that happens may move it."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from tests.runtime.compliant import Compliant, standing
from tests.runtime.tick_bench import wave

_HAPPENINGS = 14
_STILL = 2e-3  # [rad] movement that encoder noise may cause
_LARGEST = 0.095  # [rad] steady error; more counts as released, by `safety.steady_error`


def once(seed: int) -> list[str]:
    """Return the violations in the scenario of `seed`, as sentences."""
    rng = np.random.default_rng(seed)
    bench = standing(
        rng.uniform(-_LARGEST, _LARGEST, 2), noise=float(rng.choice([0.0, 1e-4])), following_error=0.5
    )
    run, violations = 0, []
    for _ in range(_HAPPENINGS):
        if rng.random() < 0.4:
            run += 1
            _move(bench, rng, run)
        name = str(rng.choice(list(_AT_REST)))
        stood = bench.true.copy()
        _AT_REST[name](bench)
        moved = float(np.abs(np.array(bench.course[-60:]) - stood).max())
        if moved > _STILL:
            violations.append(f"seed {seed}: {name} moves an arm that stands by {moved:.4f} rad")
    return violations


def _move(bench: Compliant, rng: np.random.Generator, run: int) -> None:
    """Move elsewhere, by a motion or by chunks, sometimes stopped on the way; then hold for two seconds."""
    commanded = np.array(bench.status["commanded"], np.float64)
    if rng.random() < 0.5:
        bench.say("motion", goal=rng.uniform(-0.8, 0.8, 2), speed=1.0)
    else:
        amplitude = 0.5 if commanded[0] < 0.0 else -0.5
        bench.say("follow", run=run)
        bench.chunk(run, commanded + wave(60, amplitude), run=run)
    bench.seconds(float(rng.uniform(0.2, 1.5)))
    if rng.random() < 0.5:
        bench.stop().seconds(2.0)
        bench.release()
    else:
        bench.say("hold", run=run)
    bench.seconds(2.0)


def _restart(bench: Compliant) -> None:
    bench.stop().seconds(0.5)
    bench.tick = bench.new_tick()
    bench.seconds(1.5)
    bench.release()


def _miss_joints(bench: Compliant) -> None:
    bench.feed = False
    bench.seconds(0.8)
    bench.feed = True
    bench.seconds(1.2)


def _press(bench: Compliant) -> None:
    bench.stop().seconds(1.7)
    bench.release().seconds(0.3)


def _hold(bench: Compliant) -> None:
    bench.say("hold", run=0)
    bench.seconds(2.0)


def _go_nowhere(bench: Compliant) -> None:
    bench.say("motion", goal=np.array(bench.status["commanded"], np.float64))
    bench.seconds(2.0)


_AT_REST: dict[str, Callable[[Compliant], None]] = {
    "an e-stop": _press,
    "a control that is restarted under it": _restart,
    "joints that are missing": _miss_joints,
    "a hold": _hold,
    "a motion to where it is": _go_nowhere,
}
