"""The whole suite, as `make test` runs it: what stands other load side by side, whole labs by twos, then doubts again.

Whole labs run in real time, and another job on the machine can make one late. A file in which a test failed is run
once more, alone, and what it then says counts; a test that passed only then is named as unsteady. A defect fails twice.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

_CACHE = Path(".pytest_cache/v/cache/lastfailed")
_AGAIN = 6  # more files than these are no accident of the machine's load
_TESTS_FAILED = 1  # pytest's exit code; any other but 0 is no verdict about tests
# A third of the tests' time is waiting: one more of them at a time than there are cores.
_SIDE_BY_SIDE = (
    "-n",
    str((os.cpu_count() or 1) + 1),
    "--dist",
    "loadfile",
    "-m",
    "not alone",
    "--cache-clear",
)
_ALONE = ("-n", "2", "--dist", "loadfile", "-m", "alone")  # a lab waits for half of its time
Run = Callable[[Sequence[str]], int]


def whole(run: Run, failed: Callable[[], list[str]], tell: Callable[[str], None]) -> int:
    """The exit code of the suite; `run` runs pytest so, `failed` are the ids of what failed since."""
    codes = [run(_SIDE_BY_SIDE), run(_ALONE)]
    worst = max(codes)
    if worst != _TESTS_FAILED:
        return worst
    first = failed()
    files = sorted({test.split("::")[0] for test in first})
    if not 0 < len(files) <= _AGAIN:
        tell(f"tests failed in {len(files)} files: more than {_AGAIN} are not run again")
        return worst
    tell(f"once more, alone, the files of what failed: {' '.join(files)}")
    code = run(files)
    if code == 0:
        tell("unsteady (failed, and passed when run again alone): " + " ".join(first))
    return code


def _pytest(arguments: Sequence[str]) -> int:
    code = subprocess.call([sys.executable, "-m", "pytest", *arguments])
    return code if code >= 0 else 128 - code  # ended by a signal


def _failed() -> list[str]:
    return sorted(json.loads(_CACHE.read_text())) if _CACHE.exists() else []


if __name__ == "__main__":
    sys.exit(whole(_pytest, _failed, lambda said: print(f"\n=== {said} ===", flush=True)))
