"""Environment variables of a station's processes.

Secrets of the web are removed. Secrets of the station itself are read from variables whose names the deployment states.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path

import runtime
from runtime.core.errors import ConfigurationError, SetupError

# Session key, access to database, broker and object store, hub login: no station uses them.
WEB_ONLY = frozenset(
    (
        *("EVA_SECRET_KEY", "DATABASE_URL", "REDIS_URL", "DJANGO_SUPERUSER_PASSWORD"),
        *("PGPASSWORD", "PGPASSFILE", "PGSERVICEFILE"),
        *("EVA_STORE_KEY", "EVA_STORE_SECRET"),
        *("HF_TOKEN", "HUGGING_FACE_HUB_TOKEN", "HF_TOKEN_PATH"),
    )
)
_JUDGES = "EVA_JUDGE_"  # prefix of automatic judges' keys, which only the worker uses
# For ssh: agent, Kerberos tickets, language and session.
_OF_SSH = frozenset(
    (
        *("HOME", "USER", "LOGNAME", "SHELL", "PATH", "TZ", "TMPDIR", "XDG_RUNTIME_DIR"),
        *("SSH_AUTH_SOCK", "SSH_AGENT_PID", "KRB5CCNAME", "KRB5_CONFIG", "LANG", "LANGUAGE"),
    )
)
_BLAS_THREADS = ("OPENBLAS_NUM_THREADS", "GOTO_NUM_THREADS", "OMP_NUM_THREADS")  # the first set applies


def without_web_secrets(given: Mapping[str, str]) -> dict[str, str]:
    """Return the environment without the variables that only the web may have."""
    return {name: value for name, value in given.items() if not _web_alone(name)}


def _web_alone(name: str) -> bool:
    return name in WEB_ONLY or name.startswith(_JUDGES)


def program_environment(given: Mapping[str, str]) -> dict[str, str]:
    """Return the environment for programs that must start quickly and must not disturb control.

    Variables in `given` take precedence. BLAS gets one thread: a robot's matrices are small, and idle threads spin.
    Pydantic does not search all installed packages for plug-ins, which takes a twelfth of a process's start.
    """
    blas = {} if any(name in given for name in _BLAS_THREADS) else {_BLAS_THREADS[0]: "1"}
    return {"PYDANTIC_DISABLE_PLUGINS": "__all__", **blas, **given}


def foreign_python_environment() -> dict[str, str]:
    """Return the environment for programs that run in another Python environment than this one.

    They see the package runtime, and no other package of this environment, whose versions may conflict with theirs.

    Raises:
        SetupError: The folder for that in the temporary folder belongs to somebody else.
    """
    package = Path(runtime.__file__).resolve().parent
    name = hashlib.sha256(str(package).encode()).hexdigest()[:12]
    folder = Path(tempfile.gettempdir()) / f"eva-programs-{os.getuid()}" / name
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    for part in (folder.parent, folder):
        if part.is_symlink() or part.stat().st_uid != os.getuid():
            raise SetupError(
                f"{part} belongs to somebody else; allowed: remove it, or set TMPDIR to another folder"
            )
    with contextlib.suppress(FileExistsError):
        (folder / "runtime").symlink_to(package)
    given = without_web_secrets(os.environ)
    given.pop("PYTHONHOME", None)  # of another Python
    return given | {"PYTHONPATH": str(folder), "PYTHONNOUSERSITE": "1"}


def ssh_environment() -> dict[str, str]:
    """Return the variables for an ssh process, whose configuration may forward all variables that it has."""
    return {
        name: value for name, value in os.environ.items() if name in _OF_SSH or name.startswith("LC_")
    } | {"SSH_ASKPASS_REQUIRE": "never"}


def restart_without_web_secrets() -> None:
    """Re-execute this program without the web's secrets, if it has any, as the same process.

    Otherwise they could be read in /proc during its whole life, and every child would inherit them.
    """
    environment = without_web_secrets(os.environ)
    if len(environment) < len(os.environ):
        os.execve(sys.executable, [sys.executable, *sys.orig_argv[1:]], environment)


def read_secret(key: str, name: str) -> str:
    """Return the value of the variable `name`, to which `key` of a deployment refers.

    Raises:
        ConfigurationError: the variable is not set, or belongs to the web.
    """
    if _web_alone(name):
        raise ConfigurationError(
            f"{key} names {name}, which is the web's and never a station's; allowed: a variable of its own, "
            "such as EVA_POLICY_KEY"
        )
    value = os.environ.get(name)
    if not value:
        raise ConfigurationError(f"{key} names {name}, which is not set in the environment")
    return value
