import fcntl
import logging
import os
import subprocess
import sys
import threading

import pytest

from runtime.core import logs as log
from tests.processes import PATIENCE_S

PIPE_SIZE = 1031  # F_SETPIPE_SZ
STUCK = """
import logging, sys
from runtime.core import logs as log
log.configure_logging("main")
for number in range(5000):
    logging.info("line %d of a process whose terminal has stopped", number)
print("went on", flush=True)
"""


@pytest.fixture
def pipe():
    """A pipe of one page that nobody reads unless the test does."""
    reading, writing = os.pipe()
    fcntl.fcntl(writing, PIPE_SIZE, 4096)
    ends = {"reading": reading, "writing": writing}
    yield ends
    for end in ends.values():
        os.close(end)


def lines_on(descriptor):
    made = log.NonBlockingHandler(descriptor)
    made.setFormatter(logging.Formatter("%(levelname)s %(message)s"))
    return made


def record(text, *arguments):
    return logging.LogRecord("x", logging.INFO, "here.py", 7, text, arguments, None)


def test_a_line_is_written_by_a_thread_and_flush_waits_for_it(pipe):
    lines = lines_on(pipe["writing"])
    lines.handle(record("arm %s", "left"))
    lines.flush()
    assert os.read(pipe["reading"], 4096) == b"INFO arm left\n"


def test_a_terminal_that_takes_nothing_stops_nobody_and_what_was_dropped_is_counted(pipe):
    lines = lines_on(pipe["writing"])
    for number in range(3 * log.LINES_KEPT):
        lines.handle(record("line %d %s", number, "x" * 100))  # 300 kB into a pipe of 4
    read = b""
    while lines._queue.qsize():  # somebody looks again
        read += os.read(pipe["reading"], 65536)
    lines.handle(record("the end"))
    while not read.endswith(b"the end\n"):
        read += os.read(pipe["reading"], 65536)
    shown = [line for line in read.split(b"\n") if b"dropped" in line]
    assert shown[0].endswith(b" lines were dropped: not read in time)")
    assert sum(int(line.split()[0].strip(b"(")) for line in shown) > log.LINES_KEPT


def test_a_line_that_cannot_be_made_is_named_and_the_next_one_comes(pipe):
    lines = lines_on(pipe["writing"])
    lines.handle(record("%d", "no number"))
    lines.handle(record("next"))
    lines.flush()
    wrong, following = os.read(pipe["reading"], 4096).splitlines()
    assert wrong.startswith(b"here.py:7: cannot be logged: ")
    assert following == b"INFO next"


def test_a_terminal_that_is_gone_does_not_end_the_thread():
    reading, writing = os.pipe()
    os.close(reading)
    lines = lines_on(writing)
    lines.handle(record("nobody hears this"))
    lines.flush()
    reading, moved = os.pipe()
    os.dup2(moved, writing)
    lines.handle(record("but this"))
    lines.flush()
    assert os.read(reading, 4096) == b"(1 lines were dropped: not read in time)\nINFO but this\n"
    for end in (reading, writing, moved):
        os.close(end)


def test_a_process_with_a_stuck_terminal_goes_on_and_ends():
    child = subprocess.Popen(
        [sys.executable, "-c", STUCK], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    assert child.stdout.readline() == "went on\n"
    assert child.wait(PATIENCE_S) == 0  # although nobody has read its log
    child.stdout.close()
    child.stderr.close()


def python(code, **environment):
    return subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        env={**os.environ, **environment},
    )


def test_everything_that_was_logged_is_there_when_the_process_has_ended():
    done = python(
        "import logging; from runtime.core import logs; logs.configure_logging('media'); logging.info('last words')"
    )
    assert done.stderr.endswith("media      INFO    last words\n")


def test_the_level_is_that_of_the_environment():
    code = (
        "import logging; from runtime.core import logs; logs.configure_logging('x'); "
        "logging.info('a'); logging.error('b')"
    )
    assert "ERROR   b" in python(code, EVA_LOG_LEVEL="WARNING").stderr
    assert "INFO    a" not in python(code, EVA_LOG_LEVEL="WARNING").stderr


def test_the_error_that_ends_a_process_is_logged_with_its_traceback():
    done = python(
        "from runtime.core import logs as log; log.configure_logging('main'); raise ValueError('so it ends')"
    )
    assert done.returncode == 1
    assert "CRITICAL this process ends" in done.stderr
    assert done.stderr.endswith("ValueError: so it ends\n")


def test_the_thread_of_a_process_that_turns_real_time_stays_in_the_ordinary_class():
    code = (
        "import os, threading; from runtime.core import logs as log; log.configure_logging('control')\n"
        "os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(10))\n"
        "(thread,) = [t for t in threading.enumerate() if t.name == 'log']\n"
        "print(os.sched_getscheduler(0) == os.SCHED_FIFO, os.sched_getscheduler(thread.native_id))"
    )
    done = python(code)
    if "PermissionError" in done.stderr:
        pytest.skip("this machine permits no real-time class")
    assert done.stdout.split() == ["True", str(os.SCHED_OTHER)]


def test_no_stack_of_later_threads_is_smaller_for_it(pipe):
    before = threading.stack_size()
    lines_on(pipe["writing"])
    assert threading.stack_size() == before
