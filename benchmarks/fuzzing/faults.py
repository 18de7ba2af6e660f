"""Encoder faults: each is a function that returns faulty readings in place of the true `joints` [D].

`since` is the number of samples since the fault began.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from runtime.core.types import Float64

Fault = Callable[[np.random.Generator, Float64, int], Float64]


def _zeros(rng: np.random.Generator, joints: Float64, since: int) -> Float64:
    return np.zeros_like(joints)


def _dead(rng: np.random.Generator, joints: Float64, since: int) -> Float64:
    return np.where(rng.permutation(len(joints)) < 2, 0.0, joints)


def _spike(rng: np.random.Generator, joints: Float64, since: int) -> Float64:
    return joints if since else joints + rng.uniform(-1.5, 1.5, len(joints))


def _beyond(rng: np.random.Generator, joints: Float64, since: int) -> Float64:
    return joints + np.where(rng.permutation(len(joints)) == 0, 9.0, 0.0)


def _noise(rng: np.random.Generator, joints: Float64, since: int) -> Float64:
    return joints + rng.normal(0.0, 1.0, len(joints))


def _swapped(rng: np.random.Generator, joints: Float64, since: int) -> Float64:
    swapped = joints.copy()
    swapped[[0, 1, 2]] = joints[[2, 0, 1]]
    return swapped


def _missing(rng: np.random.Generator, joints: Float64, since: int) -> Float64:
    return np.full_like(joints, np.nan)


FAULTS: dict[str, Fault] = {
    "zeros": _zeros,
    "dead": _dead,
    "spike": _spike,
    "beyond": _beyond,
    "noise": _noise,
    "swapped": _swapped,
    "missing": _missing,
}
# They keep a value: the reading at their begin, or a random one.
KEPT = ("frozen", "stuck")
