"""On PYTHONPATH: disables the measures of runtime.core.realtime that EVA_WITHOUT lists.

Only the control process and the loop of benchmarks.sleeper are affected. Only for benchmarks.measures: the runtime
itself has no such switch.
"""

import os
import sys


def _take_away(names: list[str]) -> None:
    from runtime.core import realtime

    nothing = {
        "fifo": ("_fifo", lambda *given: ""),
        "slice": ("_short_slice", lambda libc: False),
        "lock": ("_locked_memory", lambda *given: False),
        "gc": ("_quiet_gc", lambda: None),
        "timers": ("_fine_timers", lambda libc: None),
    }
    for name in names:
        setattr(realtime, *nothing[name])


if {"runtime.processes.control.process", "benchmarks.sleeper"} & set(sys.orig_argv):
    _take_away(os.environ["EVA_WITHOUT"].split(","))
