"""Smoothness of a movement: SPARC, the spectral arc length (Balasubramanian et al. 2015)."""

from __future__ import annotations

from collections.abc import Sequence

from evaweb.statistics.base import StatisticsError

CUT_OFF = 10.0  # [Hz] higher frequencies are not movement
_AMPLITUDE = 0.05  # share of the largest amplitude; lower ones at either end are noise
_PADDING = 4  # exponent: the spectrum has 2^4 times the next power of two samples


def sparc(speed: Sequence[float], rate: float) -> float:
    """Return SPARC of a `speed` profile sampled at `rate` [Hz]; in practice at most 0, closer to 0 is smoother.

    It does not depend on amplitude and duration of the movement.

    Raises:
        StatisticsError: If there are fewer than two samples, one is not finite, or nothing moved.
    """
    import numpy as np

    profile = np.asarray(speed, dtype=float)
    if profile.ndim != 1 or profile.size < 2:
        raise StatisticsError(
            f"a speed profile of shape {profile.shape}; allowed: at least 2 samples in a row"
        )
    if not rate > 0:
        raise StatisticsError(f"rate = {rate} Hz; allowed: above 0")
    if not np.isfinite(profile).all():
        raise StatisticsError("a speed profile with numbers that are not finite")
    size = 2 ** (int(np.ceil(np.log2(profile.size))) + _PADDING)
    spectrum = np.abs(np.fft.fft(profile, size))
    if spectrum.max() == 0:
        raise StatisticsError("nothing moved: smoothness is not defined")
    spectrum /= spectrum.max()
    frequency = np.arange(size) * rate / size
    within = frequency <= CUT_OFF
    frequency, spectrum = frequency[within], spectrum[within]
    loud = np.flatnonzero(spectrum >= _AMPLITUDE)
    frequency, spectrum = frequency[loud[0] : loud[-1] + 1], spectrum[loud[0] : loud[-1] + 1]
    if frequency.size < 2:
        raise StatisticsError("the speed profile is shorter than its slowest movement")
    steps = np.diff(frequency) / (frequency[-1] - frequency[0])
    return -float(np.hypot(steps, np.diff(spectrum)).sum())
