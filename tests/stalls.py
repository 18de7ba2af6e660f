"""A measurement that the machine spoilt is no result: stories and labs that failed while it stood still are invalid.

A small process beside the tests notices when it was not run for a while. A story or lab that failed, and in whose file
such a gap lies, is reported as `invalid` with the gap; what became of it is decided by another pytest of its file
alone, in which labs and chains are made anew, at most twice. Nothing else is ever run again.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Generator
from typing import Any

import pytest

GAP_S = 0.5
MOST_TRIES = 3
TRY = "EVA_TESTS_TRY"  # which this is, in the environment of a pytest that runs what was invalid again
_WATCHING = f"""
import json, select, sys, time
gaps, last = [], time.monotonic()
while True:
    asked = select.select([sys.stdin], [], [], 0.02)[0]
    now = time.monotonic()
    if now - last > {GAP_S}:
        gaps.append((last, now))
    last = now
    if asked:
        if not sys.stdin.readline():
            break
        print(json.dumps(gaps), flush=True)
"""

Gap = tuple[float, float]


class Watch:
    """The process that notices gaps; moments are of the monotonic clock [s]."""

    def __init__(self) -> None:
        command = [sys.executable, "-S", "-c", _WATCHING]
        self._process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, start_new_session=True
        )
        self.since(0.0)  # it runs

    @property
    def pid(self) -> int:
        """Its number."""
        return self._process.pid

    def since(self, moment: float) -> Gap | None:
        """The longest gap that ended after `moment`, None where there was none."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write("?\n")
        self._process.stdin.flush()
        gaps: list[Gap] = [(begun, ended) for begun, ended in json.loads(self._process.stdout.readline())]
        return max((gap for gap in gaps if gap[1] >= moment), key=lambda gap: gap[1] - gap[0], default=None)

    def close(self) -> None:
        """End it."""
        self._process.communicate()


class Stalls:
    """The plug-in; a pytest process has one where it has stories or labs."""

    def __init__(self, watch: Watch) -> None:
        self._watch = watch
        self._begun: dict[str, float] = {}  # by file
        self.invalid: dict[str, str] = {}  # by test, the sentence
        self.failed: set[str] = set()
        self._spoilt = 0  # reports of failures that are no result

    def pytest_runtest_logstart(self, nodeid: str) -> None:
        """A file begins with its first test, before that one's fixtures."""
        self._begun.setdefault(file_of(nodeid), time.monotonic())

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_makereport(
        self, item: pytest.Item
    ) -> Generator[None, pytest.TestReport, pytest.TestReport]:
        """Whether what failed is a result."""
        report = yield
        if report.failed:
            alone = any(item.get_closest_marker(mark) for mark in ("story", "lab"))
            gap = self._watch.since(self._begun[file_of(item.nodeid)]) if alone else None
            if gap is None:
                self.failed.add(item.nodeid)
            else:
                self._spoilt += 1
                why = f"the machine stood still for {gap[1] - gap[0]:.1f} s"
                self.invalid[item.nodeid] = vars(report)["stalled"] = why
        return report

    def pytest_report_teststatus(self, report: Any) -> tuple[str, str, str] | None:
        """Counted apart."""
        return ("invalid", "I", "INVALID") if getattr(report, "stalled", "") else None

    def pytest_terminal_summary(self, terminalreporter: pytest.TerminalReporter) -> None:
        """Each is named, with what it failed of."""
        for report in terminalreporter.getreports("invalid"):
            terminalreporter.write_sep("_", report.nodeid)
            terminalreporter.write_line(report.longreprtext)
        for test, why in self.invalid.items():
            terminalreporter.write_line(f"INVALID {test}: {why}")

    @pytest.hookimpl(wrapper=True, tryfirst=True)
    def pytest_sessionfinish(self, session: pytest.Session) -> Generator[None, None, None]:
        """What was only invalid decides nothing: its files are run again, when every lab of this process has ended."""
        yield
        files, this = sorted({file_of(test) for test in self.invalid}), int(os.environ.get(TRY, "1"))
        if not files or this >= MOST_TRIES or session.exitstatus != pytest.ExitCode.TESTS_FAILED:
            return
        print(
            f"\nrun {this + 1} of at most {MOST_TRIES}, of what was invalid: {', '.join(files)}", flush=True
        )
        asked = session.config.option.markexpr or "story or lab"
        command = [sys.executable, "-m", "pytest", "-n", "0", "-m", asked, *files]
        again = subprocess.run(command, env=os.environ | {TRY: str(this + 1)}, check=False)
        # Whatever else ended the session, or failed to be collected, is no matter of the machine.
        whole = not session.shouldstop and not session.shouldfail and session.testsfailed == self._spoilt
        if not self.failed and whole:
            session.exitstatus = again.returncode

    def pytest_unconfigure(self, config: pytest.Config) -> None:
        """Every lab of this process has ended."""
        self._watch.close()


def file_of(nodeid: str) -> str:
    """The file of a test: its chain, and what shares its lab."""
    return nodeid.partition("::")[0]
