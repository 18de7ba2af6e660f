"""Python environments of benches with programs of their own: `python -m runtime.benches.environments BENCH` makes one.

An environment is a folder of the data folder, named by the bench and by its requirements and Python version, so that a
bench whose requirements change gets another one. With further arguments, a Python file of the bench's folder is run in
it: `python -m runtime.benches.environments metaworld experts.py --port 0`.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from importlib.metadata import distributions
from pathlib import Path
from typing import Any

from robots.broken_pipe import exit_on_broken_pipe
from runtime.benches.schema import bench_folder, load_schema
from runtime.core.environment import foreign_python_environment, without_web_secrets
from runtime.core.errors import RuntimeFault, SetupError

FOLDER = "environments"  # below the data folder
_OURS = ("numpy", "pyzmq", "msgpack")  # which the host of a program needs


class UnusableEnvironment(SetupError):
    """Error for a bench that needs no environment, or whose environment is absent or cannot be made."""


def environment_of(bench: str) -> Path:
    """Return the folder of the bench's environment, which may not exist yet.

    Raises:
        UnusableEnvironment: If the bench does not exist, or has no program of its own.
    """
    program = load_schema(bench).program
    if program is None:
        raise UnusableEnvironment(f"the bench {bench} has no program of its own, and needs no environment")
    folder = bench_folder(bench).resolve()
    content = (folder / program.requirements).read_bytes() + sys.version.split()[0].encode()
    data = Path(os.environ.get("EVA_DATA_DIR") or "data").expanduser().absolute()
    return data / FOLDER / f"{folder.name}-{hashlib.sha256(content).hexdigest()[:12]}"


def require_python(bench: str) -> Path:
    """Return the Python of the bench's environment.

    Raises:
        UnusableEnvironment: If the environment has not been made.
    """
    python = environment_of(bench) / "bin" / "python"
    if not python.exists():
        raise UnusableEnvironment(
            f"the environment of the bench {bench} is not installed ({python.parent.parent}); make it by "
            f"python -m runtime.benches.environments {bench}"
        )
    return python


def describe_program(bench: str) -> dict[str, Any]:
    """Return the manifest's entry about the bench's own program: digest of its files, and packages of its environment.

    Without a bench, or without a program of its own, it is {}.
    """
    program = load_schema(bench).program if bench else None
    if program is None:
        return {}
    packages: dict[str, str] = {}
    for place in environment_of(bench).glob("lib/python*/site-packages"):
        packages |= {found.name: found.version for found in distributions(path=[str(place)])}
    return {"bench_program": {"content": program.content, "packages": dict(sorted(packages.items()))}}


def make_environment(bench: str) -> Path:
    """Make the bench's environment if it does not exist, and return its folder.

    Raises:
        UnusableEnvironment: If its packages cannot be installed; nothing is left behind then.
    """
    folder = environment_of(bench)
    if (folder / "bin" / "python").exists():
        return folder
    program = load_schema(bench).program
    assert program is not None
    folder.parent.mkdir(parents=True, exist_ok=True)
    # Made aside and renamed when it is complete: its python finds itself, and pip is run as a module of it.
    made = Path(tempfile.mkdtemp(prefix=f".{folder.name}-", dir=folder.parent))
    try:
        _run([sys.executable, "-m", "venv", str(made)])
        requirements = bench_folder(bench).resolve() / program.requirements
        _run([str(made / "bin" / "python"), "-m", "pip", "install", *_OURS, "-r", str(requirements)])
        made.chmod(0o755)
        made.rename(folder)
    except OSError as error:
        if (folder / "bin" / "python").exists():  # another program has made it meanwhile
            return folder
        raise UnusableEnvironment(
            f"the environment of the bench {bench} cannot be made at {folder}: {error}"
        ) from error
    finally:
        shutil.rmtree(made, ignore_errors=True)
    return folder


def program_variables(bench: str) -> dict[str, str]:
    """Return the environment variables for programs of the bench.

    Raises:
        SetupError: If the folder for that in the temporary folder belongs to somebody else.
    """
    program = load_schema(bench).program
    assert program is not None, bench
    return foreign_python_environment() | program.variables


def _run(command: Sequence[str]) -> None:
    # Packages may run code at their installation, and what PYTHONPATH shows would count as installed.
    left_out = ("PYTHONPATH", "PYTHONHOME")
    variables = {
        name: value for name, value in without_web_secrets(os.environ).items() if name not in left_out
    }
    done = subprocess.run(command, check=False, stdout=sys.stderr, env=variables)
    if done.returncode:
        raise UnusableEnvironment(f"{' '.join(command)} ended with {done.returncode}")


@exit_on_broken_pipe
def main(arguments: Sequence[str] | None = None) -> int:
    """Make the environment of a bench, and print its folder."""
    parser = argparse.ArgumentParser(
        prog="python -m runtime.benches.environments",
        description="Make the Python environment of a bench with a program of its own.",
    )
    parser.add_argument("bench", help="its name, or the path of its folder")
    parser.add_argument(
        "program",
        nargs=argparse.REMAINDER,
        help="a Python file of its folder, and its arguments: it is run instead",
    )
    options = parser.parse_args(arguments)
    try:
        if options.program:
            python, (file, *further) = require_python(options.bench), options.program
            command = [str(python), str(bench_folder(options.bench).resolve() / file), *further]
            sys.stdout.flush()
            os.execve(python, command, program_variables(options.bench))
        print(make_environment(options.bench))
    except (RuntimeFault, OSError) as error:
        print(error, file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
