"""Says of each seeded mistake whether its tests notice it: `python -m tests.mutants [NAME ...]`.

It works in a copy of the tracked files, as they are now. It ends with 0 where all mutants are killed, with 1 where any
survived, with 2 where it cannot be told: a row that does not fit, tests that fail without a mutant, or did not run.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from tests.mutants.table import MUTANTS, Mutant, misfit

ROOT = Path(__file__).parents[2]
_SHOWN = 15  # last lines of what pytest said, where it has to be read
_PASSED, _FAILED = 0, 1  # exit codes of pytest; any other says nothing of the tests


@dataclass(frozen=True, slots=True)
class Told:
    """Exit code of pytest, its last lines, and how long it took [s]."""

    code: int
    end: str
    seconds: float


def copied(to: Path) -> None:
    """A copy of the tracked files, as they are in the working tree."""
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, check=True).stdout
    for name in filter(None, listed.decode().split("\0")):
        file, there = ROOT / name, to / name
        if file.is_file() or file.is_symlink():  # one that was removed is tracked until that is committed
            there.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(file, there, follow_symlinks=False)
    if (ROOT / "node_modules").is_dir():
        (to / "node_modules").symlink_to(ROOT / "node_modules")


def asked(copy: Path, files: Sequence[str]) -> Told:
    """What pytest says of these files in the copy."""
    command = [sys.executable, "-m", "pytest", "-x", "-q", "-n", "0", "-p", "no:cacheprovider", *files]
    # Processes that tests start elsewhere shall load the copy too, not the tree that is installed.
    paths = os.pathsep.join(filter(None, [str(copy), os.environ.get("PYTHONPATH")]))
    env = {**os.environ, "PYTHONPATH": paths}
    began = time.monotonic()
    done = subprocess.run(
        command, cwd=copy, env=env, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, check=False
    )
    end = "\n".join(done.stdout.splitlines()[-_SHOWN:])
    return Told(done.returncode, end, time.monotonic() - began)


def written(file: Path, content: bytes) -> None:
    """The file with this content, and nothing compiled of another: that is told apart by size and second alone."""
    file.write_bytes(content)
    for compiled in (file.parent / "__pycache__").glob(f"{file.stem}.*.pyc"):
        compiled.unlink()


def with_mutant(copy: Path, mutant: Mutant) -> Told:
    """What its tests say of the mutant; the copy is as it was afterwards."""
    file = copy / mutant.path
    before = file.read_bytes()
    try:
        written(file, before.replace(mutant.old.encode(), mutant.new.encode()))
        return asked(copy, mutant.tests)
    finally:
        written(file, before)


def hunted(copy: Path, mutants: Sequence[Mutant]) -> int:
    """Try them one after the other and say what became of each; the exit code."""
    sound: dict[tuple[str, ...], bool] = {}
    counts = {"killed": 0, "SURVIVED": 0, "not told": 0}
    for mutant in mutants:
        if mutant.tests not in sound:
            told = asked(copy, mutant.tests)
            sound[mutant.tests] = told.code == _PASSED
            if told.code != _PASSED:
                print(f"fails without a mutant: {' '.join(mutant.tests)}\n{told.end}", flush=True)
        if not sound[mutant.tests]:
            counts["not told"] += 1
            print(f"not told          {mutant.name}: its tests fail without it", flush=True)
            continue
        told = with_mutant(copy, mutant)
        fate = {_PASSED: "SURVIVED", _FAILED: "killed"}.get(told.code, "not told")
        counts[fate] += 1
        print(f"{fate:8} {told.seconds:6.1f} s  {mutant.name}", flush=True)
        if fate == "not told":
            print(f"pytest ended with {told.code}\n{told.end}", flush=True)
    print(", ".join(f"{count} {fate}" for fate, count in counts.items()) + f", of {len(mutants)}")
    return 2 if counts["not told"] else 1 if counts["SURVIVED"] else 0


def main(arguments: Sequence[str] | None = None) -> int:
    """Hunt the mutants that are named, or all; the exit code."""
    parser = argparse.ArgumentParser(prog="python -m tests.mutants", description=__doc__)
    parser.add_argument(
        "names", nargs="*", metavar="NAME", help="mutants of tests/mutants/table.py; default: all"
    )
    names = parser.parse_args(arguments).names
    known = {mutant.name: mutant for mutant in MUTANTS}
    chosen = [known[name] for name in names if name in known] if names else list(MUTANTS)
    faults = [
        f"there is no mutant {name}; there are: {', '.join(known)}" for name in names if name not in known
    ]
    faults += [fault for mutant in chosen if (fault := misfit(mutant, ROOT))]
    if faults:
        print("\n".join(faults), file=sys.stderr)
        return 2
    with tempfile.TemporaryDirectory(prefix="eva-mutants-") as folder:
        copy = Path(folder)
        copied(copy)
        return hunted(copy, chosen)


if __name__ == "__main__":
    sys.exit(main())
