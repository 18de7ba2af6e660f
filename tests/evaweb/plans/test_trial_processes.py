"""Trials are forks of a process that has loaded what all need, and are what they are in a fresh process."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest

from evaweb.core.errors import EvaError
from evaweb.plans.trial_processes import TrialProcess, TrialProcesses
from runtime.recording.reader import open_episode
from tests.processes import alive, eventually
from tests.sources import ROOT

SERVED = "openpi --robot agilex_piper --port 0"


def arguments(folder: Path, *more: str) -> list[str]:
    own = ("--set", f'data_dir="{folder}"', "--set", "recording.min_free_bytes=0", "--serve", SERVED)
    return ["deployments/tabletop.toml", "--lifeline", *own, "--width", "64", "--height", "48", *more]


def orders(seed: int, seconds: float) -> bytes:
    bench = {"id": f"b{seed}", "seed": seed, "positions": None}
    setup = {"task": "put the block on the plate", "policy": {"delay_ms": 80}, "bench": bench}
    run = {"mode": "continuous", "duration_s": seconds, "trial": {}}
    return json.dumps({"setup": setup, "run": run}).encode() + b"\n"


@pytest.fixture
def processes() -> Iterator[TrialProcesses]:
    made = TrialProcesses()
    yield made
    made.close()


def started(processes: TrialProcesses, folder: Path, seed: int = 3, seconds: float = 1.0) -> TrialProcess:
    folder.mkdir(parents=True, exist_ok=True)
    process = processes.start(arguments(folder), folder / "log")
    process.input.write(orders(seed, seconds))
    process.input.flush()
    return process


def rows(answer: bytes) -> Any:
    result = json.loads(answer)
    assert result["episode"]["status"] == "finished"
    return open_episode(Path(result["episode"]["path"])).rows.to_pydict()


def test_forked_trials_record_what_a_fresh_process_records_whatever_ran_before_or_runs_beside(
    processes: TrialProcesses, tmp_path: Path
) -> None:
    def forked(name: str, seed: int) -> Any:
        process = started(processes, tmp_path / name, seed)
        try:
            answer, code = process.output.read(), process.wait()
        finally:
            process.close()
        assert code == 0, (tmp_path / name / "log").read_text()
        return rows(answer)

    alone = [part for part in arguments(tmp_path / "fresh") if part != "--lifeline"]
    fresh = subprocess.run(
        [sys.executable, "-m", "runtime.standins.trial", *alone],
        cwd=ROOT,
        input=orders(3, 1.0),
        stdout=subprocess.PIPE,
        check=True,
    )
    with ThreadPoolExecutor(2) as pool:
        first, other = pool.map(forked, ("first", "other"), (3, 4))
    again = forked("again", 3)
    assert first == again == rows(fresh.stdout) != other


def test_what_is_wrong_with_a_trial_is_its_own_to_say(processes: TrialProcesses, tmp_path: Path) -> None:
    for wrong, words in (
        (["absent.toml"], "absent.toml"),
        (["a.toml", "--nonsense"], "unrecognized arguments"),
    ):
        log = tmp_path / "log"
        log.unlink(missing_ok=True)
        process = processes.start([*arguments(tmp_path)[1:], *wrong], log)
        process.input.write(orders(3, 1.0))
        process.input.flush()
        assert (process.output.read(), process.wait()) == (b"", 2)
        process.close()
        assert words in log.read_text()


def pid_of(process: TrialProcess) -> int:
    assert process._process is not None
    fields = Path(f"/proc/self/fdinfo/{process._process}").read_text().splitlines()
    return int(next(line for line in fields if line.startswith("Pid:")).split()[1])


def test_a_trial_can_be_killed_and_ends_with_its_input(processes: TrialProcesses, tmp_path: Path) -> None:
    killed, left = (started(processes, tmp_path / name, seconds=3000.0) for name in ("killed", "left"))
    killed.kill()
    assert killed.wait() == -signal.SIGKILL
    killed.close()
    pid = pid_of(left)
    assert alive(pid)
    left.close()
    assert not alive(pid)


def test_the_end_of_the_starter_is_told_and_the_next_trial_has_another(
    processes: TrialProcesses, tmp_path: Path
) -> None:
    process = started(processes, tmp_path / "first", seconds=3000.0)
    pid = pid_of(process)
    assert processes._starter is not None
    os.kill(processes._starter.pid, signal.SIGKILL)
    assert process.wait() == -1
    process.close()
    eventually(lambda: not alive(pid), "the trial ends with its input")
    again = started(processes, tmp_path / "again")
    assert (again.output.read() != b"", again.wait()) == (True, 0)
    again.close()


def test_a_starter_that_hangs_is_ended(
    processes: TrialProcesses, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("evaweb.plans.trial_processes.START_S", 0.5)
    fifo = tmp_path / "hangs.toml"
    os.mkfifo(fifo)  # nobody ever writes it
    with pytest.raises(EvaError, match="no process of a trial can be started"):
        processes.start([str(fifo), *arguments(tmp_path)[1:]], tmp_path / "log")
    monkeypatch.undo()
    again = started(processes, tmp_path / "again")
    assert (again.output.read() != b"", again.wait()) == (True, 0)
    again.close()
