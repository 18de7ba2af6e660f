"""Loops that only sleep, for comparison: `python -m benchmarks.sleeper HOW HZ SECONDS [PRIORITY]`.

"rest" is the common method: sleep for the rest of the period since the last wake-up. "deadlines" sleeps until absolute
deadlines, as the control process does, and with PRIORITY in the real-time scheduling class of that process. The loops
do no work, so that their lateness is caused by the machine alone.
"""

from __future__ import annotations

import json
import sys
import time

from runtime.core import realtime
from runtime.core.clock import MonotonicClock


def main() -> None:
    """Run a loop and print a line of JSON: scheduling class, and time, step and lateness of each wake-up [s]."""
    how, rate, seconds = sys.argv[1], float(sys.argv[2]), float(sys.argv[3])
    scheduling = realtime.enter_realtime(int(sys.argv[4])) if len(sys.argv) > 4 else "ordinary"
    loop = {"rest": _sleep, "deadlines": _deadlines}[how]
    woke, steps, late = loop(1.0 / rate, seconds)
    print(json.dumps({"scheduling": scheduling, "woke": woke, "steps": steps, "late": late}))


def _sleep(period: float, seconds: float) -> tuple[list[float], list[int], list[float]]:
    """Sleep repeatedly, each time for the rest of the period since the last wake-up.

    Returns:
        Times of the wake-ups [s], numbers of the wake-ups, and no lateness, because there are no deadlines.
    """
    woke = [time.monotonic()]
    end = woke[0] + seconds
    while woke[-1] < end:
        started = woke[-1]
        time.sleep(max(0.0, period - (time.monotonic() - started)))
        woke.append(time.monotonic())
    return woke, list(range(len(woke))), []


def _deadlines(period: float, seconds: float) -> tuple[list[float], list[int], list[float]]:
    """Sleep repeatedly until start + n * period; missed deadlines are skipped.

    Returns:
        Times of the wake-ups [s], numbers n of their deadlines, and lateness of the wake-ups [s].
    """
    clock = MonotonicClock()
    woke: list[float] = []
    steps: list[int] = []
    late: list[float] = []
    start, n = clock.now() + period, 0
    while n * period < seconds:
        deadline = start + n * period
        clock.sleep_until(deadline)
        now = clock.now()
        n += max(0, int((now - deadline) / period))
        woke.append(now)
        steps.append(n)
        late.append(now - deadline)
        n += 1
    return woke, steps, late


if __name__ == "__main__":
    main()
