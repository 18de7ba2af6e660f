"""`python -m ... | head -1` is no traceback, whatever the command is."""

from __future__ import annotations

import errno
import importlib
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from robots.broken_pipe import EXIT_BROKEN_PIPE, EXIT_WRITE_ERROR, exit_on_broken_pipe
from tests.runtime.datasets.small import record

ROOT = Path(__file__).parents[2]
# What has its own standard output, or none: the processes of a station, of a tunnel, of a benchmark or bench, ROS's.
NOT_OF_A_TERMINAL = {
    "runtime.processes.control.process",
    "runtime.processes.guard.process",
    "runtime.processes.coordinator.process",
    "runtime.processes.media.process",
    "runtime.processes.reception.process",
    "runtime.policies.tunnel.die_with_parent",
    "runtime.transports.ros.rospy_node.__main__",
    "benchmarks.first_chunk",
    "benchmarks.aloha_alone",  # in the benchmark's own environment
    "benchmarks.metaworld_alone",  # in the benchmark's own environment
    "benchmarks.recording_alone",
    "benchmarks.recording_jobs",
    "benchmarks.recording_lerobot",
    "benchmarks.recording_listing",
    "benchmarks.results_pages",
    "benchmarks.sleeper",
    "benchmarks.wires_receiver",
    "evaweb.serving.computations",
    "evaweb.results.reports.recompute.__main__",  # stands alone in a report
    "runtime.benches.host",  # in a bench's own environment
    "runtime.benches.aloha.experts",
    "runtime.benches.metaworld.experts",
    "runtime.standins.trial_starter",
    "runtime.lerobot.host",  # in LeRobot's own environment
}


def programs() -> Iterator[str]:
    """Modules that are run, by name."""
    folders = [ROOT / top for top in ("runtime", "robots", "benchmarks", "evaweb")]
    for path in [ROOT / "manage.py", *(path for folder in folders for path in folder.rglob("*.py"))]:
        if '__name__ == "__main__"' in path.read_text("utf-8"):
            yield ".".join(path.relative_to(ROOT).with_suffix("").parts)


@contextmanager
def nobody_reads(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    read, written = os.pipe()
    os.close(read)
    with os.fdopen(written, "w") as pipe, monkeypatch.context() as patch:
        patch.setattr("sys.stdout", pipe)
        yield
        pipe.write("goes nowhere, and ends nothing")


@pytest.mark.exhaustive
@pytest.mark.parametrize("program", sorted(set(programs()) - NOT_OF_A_TERMINAL))
def test_the_help_of_every_program_may_be_read_in_part(program: str, monkeypatch: pytest.MonkeyPatch) -> None:
    module = importlib.import_module(program)
    name = "manage.py" if program == "manage" else program
    if program in ("runtime.clients.headless", "benchmarks.wires_sender"):  # they have no words of their own
        assert module.main.__wrapped__
        return
    with nobody_reads(monkeypatch), monkeypatch.context() as patch:
        patch.setattr("sys.argv", [name, "--help"])
        assert module.main() == EXIT_BROKEN_PIPE


def test_all_programs_are_known() -> None:
    assert set(programs()) > NOT_OF_A_TERMINAL


@pytest.fixture
def episode(tmp_path: Path) -> Path:
    return record(tmp_path / "episodes", frames=6)


LISTS: list[tuple[str, Callable[[Path], list[str]]]] = [
    ("robots", lambda episode: ["list"]),
    ("runtime.recording", lambda episode: ["show", str(episode)]),
    ("runtime.recording", lambda episode: ["export", str(episode)]),
    ("runtime.datasets", lambda episode: ["publish", str(episode), "--to", str(episode.parents[1] / "set")]),
    ("runtime.datasets", lambda episode: ["check", str(episode.parents[1] / "none")]),
    ("runtime.quality", lambda episode: [str(episode)]),
]


@pytest.mark.exhaustive
@pytest.mark.parametrize(
    ("program", "words"), LISTS, ids=lambda given: given if isinstance(given, str) else ""
)
def test_what_commands_print_may_be_read_in_part(
    program: str, words: Callable[[Path], list[str]], episode: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    main = importlib.import_module(f"{program}.__main__").main
    with nobody_reads(monkeypatch):
        assert main(words(episode)) == EXIT_BROKEN_PIPE


@pytest.mark.exhaustive
@pytest.mark.parametrize(
    "words",
    [["-m", "robots", "list"], ["-m", "runtime.config.reference"], ["manage.py", "help"]],
    ids=lambda words: words[-1],
)
def test_a_process_whose_output_nobody_reads_says_nothing_at_its_end(words: list[str]) -> None:
    read, written = os.pipe()
    os.close(read)
    ended = subprocess.run(
        [sys.executable, *words], cwd=ROOT, stdout=written, stderr=subprocess.PIPE, text=True, check=False
    )
    os.close(written)
    assert (ended.returncode, ended.stderr) == (EXIT_BROKEN_PIPE, "")


@pytest.mark.exhaustive
@pytest.mark.parametrize(
    "words",
    [["-m", "robots", "list"], ["-m", "robots", "--help"], ["manage.py", "help"], ["manage.py", "check"]],
    ids=lambda words: " ".join(words),
)
def test_a_full_disk_behind_standard_output_is_said_in_a_sentence(words: list[str]) -> None:
    with open("/dev/full", "w") as full:
        ended = subprocess.run(
            [sys.executable, *words], cwd=ROOT, stdout=full, stderr=subprocess.PIPE, text=True, check=False
        )
    said = "standard output cannot be written: No space left on device\n"
    assert (ended.returncode, ended.stderr) == (EXIT_WRITE_ERROR, said)


def test_the_full_disk_of_anything_else_is_an_error() -> None:
    @exit_on_broken_pipe
    def main() -> int:
        print("said before")
        raise OSError(errno.ENOSPC, "No space left on device", "/data/episodes")

    with pytest.raises(OSError, match="/data/episodes"):
        main()


def test_the_break_of_any_other_pipe_is_an_error() -> None:
    @exit_on_broken_pipe
    def main() -> int:
        raise BrokenPipeError("the robot has gone")

    with pytest.raises(BrokenPipeError, match="the robot has gone"):
        main()


@pytest.mark.exhaustive
@pytest.mark.parametrize("closed", [">&-", "2>&-", "<&- >&- 2>&-"])
@pytest.mark.parametrize(
    ("words", "code"),
    [
        (["manage.py", "help"], 0),
        (["manage.py", "nonsense"], 1),
        (["-m", "robots", "check", "nobody"], 1),
    ],
    ids=lambda given: " ".join(given) if isinstance(given, list) else "",
)
def test_a_stream_that_was_closed_goes_nowhere(words: list[str], code: int, closed: str) -> None:
    ended = subprocess.run(
        ["sh", "-c", f'exec "$0" "$@" {closed}', sys.executable, *words],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert ended.returncode == code
    assert "Traceback" not in ended.stderr + ended.stdout
    if closed == "2>&-" and code:
        assert ended.stdout == ""


def test_what_is_opened_takes_no_number_of_a_stream_and_children_have_them_too() -> None:
    program = (
        "import os, subprocess, sys; from robots.broken_pipe import exit_on_broken_pipe\n"
        "@exit_on_broken_pipe\n"
        "def main():\n"
        "    child = 'import os; [os.fstat(number) for number in range(3)]'\n"
        "    return subprocess.run([sys.executable, '-c', child]).returncode or 10 * (os.open('.', 0) > 2)\n"
        "sys.exit(main())"
    )
    words = ["sh", "-c", 'exec "$0" "$@" <&- >&- 2>&-', sys.executable, "-c", program]
    assert subprocess.run(words, cwd=ROOT, check=False).returncode == 10


def test_a_command_without_standard_output_ends_as_it_would(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.stdout", None)
    assert exit_on_broken_pipe(lambda: 3)() == 3
