from __future__ import annotations

import platform
import subprocess
import sys

import pytest

_ROUNDS = """
import resource, sys
from runtime.core import process_limits as heap
if sys.argv[1] == "keep":
    assert heap.keep_freed_memory()
pieces = lambda: [bytearray(b"x") * 900_000 for _ in range(6)]
for _ in range(3):
    pieces()
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
for _ in range(50):
    pieces()
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


def faults(how: str) -> int:
    done = subprocess.run([sys.executable, "-c", _ROUNDS, how], capture_output=True, text=True, check=True)
    return int(done.stdout)


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="the setting is glibc's")
def test_pictures_that_come_and_go_are_given_memory_that_the_process_has() -> None:
    kept, given_back = faults("keep"), faults("plain")
    assert given_back > 50 * 200  # a picture has 220 pages
    assert kept < given_back / 20
