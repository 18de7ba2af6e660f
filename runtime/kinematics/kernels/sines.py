"""Sine and cosine of several angles at once, by polynomials that the compiler can vectorise."""

from __future__ import annotations

import math

import numpy as np

from runtime.core.types import Float64
from runtime.kinematics.kernels.compilation import device_function

# A quarter turn in three parts, the first two of 33 bits, so that multiples of them are exact (Cody and Waite
# 1980).
_QUARTERS = 2 / math.pi
_FIRST = float.fromhex("0x1.921fb544p+0")
_SECOND = float.fromhex("0x1.0b4611a6p-34")
_THIRD = float.fromhex("0x1.3198a2e037073p-69")
# Minimax polynomials for an eighth of a turn to either side, with an error below 1e-16 (those of fdlibm).
_S1, _S2, _S3 = -1.66666666666666324348e-01, 8.33333333332248946124e-03, -1.98412698298579493134e-04
_S4, _S5, _S6 = 2.75573137070700676789e-06, -2.50507602534068634195e-08, 1.58969099521155010221e-10
_C1, _C2, _C3 = 4.16666666666666019037e-02, -1.38888888888741095749e-03, 2.48015872894767294178e-05
_C4, _C5, _C6 = -2.75573143513906633035e-07, 2.08757232129817482790e-09, -1.13596475577881948265e-11


@device_function
def compute_sincos(turns: Float64) -> None:
    """Write sines and cosines of row 0 of `turns` [3, N] [rad] to rows 1 and 2; within 2e-16 up to 1e5 rad."""
    for index in range(turns.shape[1]):
        angle = turns[0, index]
        quarters = np.floor(angle * _QUARTERS + 0.5)
        rest = ((angle - quarters * _FIRST) - quarters * _SECOND) - quarters * _THIRD
        square = rest * rest
        sine = _S3 + square * (_S4 + square * (_S5 + square * _S6))
        sine = rest + rest * square * (_S1 + square * (_S2 + square * sine))
        cosine = _C3 + square * (_C4 + square * (_C5 + square * _C6))
        cosine = 1 - 0.5 * square + square * square * (_C1 + square * (_C2 + square * cosine))
        turn = quarters - 4 * np.floor(0.25 * quarters)  # 0, 1, 2 or 3 quarters
        swapped = turn == 1.0 or turn == 3.0
        of_sine, of_cosine = (cosine, sine) if swapped else (sine, cosine)
        turns[1, index] = -of_sine if turn >= 2.0 else of_sine
        turns[2, index] = -of_cosine if turn == 1.0 or turn == 2.0 else of_cosine
