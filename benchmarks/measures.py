"""Effect of each of the measures by which the control process ticks punctually.

The benchmark `loop` runs at one rate, each time with other measures of runtime.core.realtime disabled. The bare loop
for comparison runs without the same measures.
"""

from __future__ import annotations

from benchmarks.loop import case
from benchmarks.report import Figure, Report

SECONDS = 20.0
_RATE = 200.0
# Disabled measures; without the real-time class control requests a short time slice, without both it is ordinary.
_VARIANTS = ("", "lock", "gc", "fifo", "fifo,timers", "fifo,gc", "fifo,slice", "fifo,slice,lock,gc,timers")


def measure(seconds: float) -> Report:
    """Measure `lateness_*_ms.WITHOUT`, `missed_ticks.WITHOUT`, and `waited_ms.WITHOUT`.

    The last is the time that control waits for a processor, per second.
    """
    figures, rows = [], []
    for without in _VARIANTS:
        row = case(_RATE, seconds, [], without)
        rows.append({"without": without, **row})
        name = f"without_{without.replace(',', '_')}" if without else "all"
        late = row["lateness_ms"]
        figures += [Figure(f"lateness_{q}_ms.{name}", value, "ms") for q, value in late.items()]
        figures += [
            Figure(f"missed_ticks.{name}", row["missed"], ""),
            Figure(f"ratio_to_bare_loop.{name}", row["ratio"], ""),
            Figure(f"waited_ms.{name}", row["scheduled"]["waited_ms"], "ms/s"),
            Figure(f"faults_per_s.{name}", row["scheduled"]["minor_faults"], "1/s"),
            Figure(f"other_cpu_percent.{name}", row["cpu_percent"]["others"], "%"),
        ]
    return Report("measures", figures, rows)
