"""Environment variables of a station: none of the web's, secrets by their names alone."""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping

from runtime.core.errors import ConfigurationError

# What signs sessions, opens the database, broker and store, and logs in at the hub: no station has a use for it.
WEB_ONLY = frozenset(
    (
        *("EVA_SECRET_KEY", "DATABASE_URL", "REDIS_URL", "DJANGO_SUPERUSER_PASSWORD"),
        *("PGPASSWORD", "PGPASSFILE", "PGSERVICEFILE"),
        *("EVA_STORE_KEY", "EVA_STORE_SECRET"),
        *("HF_TOKEN", "HUGGING_FACE_HUB_TOKEN", "HF_TOKEN_PATH"),
    )
)
_JUDGES = "EVA_JUDGE_"  # begins the names of keys of automatic judges, which the worker alone asks
# For ssh: its agent, its tickets, its language, and where it finds itself.
_OF_SSH = frozenset(
    (
        *("HOME", "USER", "LOGNAME", "SHELL", "PATH", "TZ", "TMPDIR", "XDG_RUNTIME_DIR"),
        *("SSH_AUTH_SOCK", "SSH_AGENT_PID", "KRB5CCNAME", "KRB5_CONFIG", "LANG", "LANGUAGE"),
    )
)
_BLAS_THREADS = ("OPENBLAS_NUM_THREADS", "GOTO_NUM_THREADS", "OMP_NUM_THREADS")  # the first one given counts


def without_web_secrets(given: Mapping[str, str]) -> dict[str, str]:
    """An environment without what is the web's alone."""
    return {name: value for name, value in given.items() if not _web_alone(name)}


def _web_alone(name: str) -> bool:
    return name in WEB_ONLY or name.startswith(_JUDGES)


def program_environment(given: Mapping[str, str]) -> dict[str, str]:
    """An environment for programs that start quickly and are still beside control, where it says nothing else.

    One thread of BLAS: a robot's matrices are small, and more threads spin where they wait. No look for plug-ins of
    pydantic among all installed packages, a twelfth of the start of a process.
    """
    blas = {} if any(name in given for name in _BLAS_THREADS) else {_BLAS_THREADS[0]: "1"}
    return {"PYDANTIC_DISABLE_PLUGINS": "__all__", **blas, **given}


def ssh_environment() -> dict[str, str]:
    """Variables of ours that an ssh gets: its configuration may tell it to send on whatever it has."""
    return {
        name: value for name, value in os.environ.items() if name in _OF_SSH or name.startswith("LC_")
    } | {"SSH_ASKPASS_REQUIRE": "never"}


def restart_without_web_secrets() -> None:
    """Start a program that has secrets of the web again without, as the same process.

    Else they could be read in /proc for as long as it lives, and every child would have them.
    """
    kept = without_web_secrets(os.environ)
    if len(kept) < len(os.environ):
        os.execve(sys.executable, [sys.executable, *sys.orig_argv[1:]], kept)


def read_secret(key: str, name: str) -> str:
    """The value of the variable `name`, which `key` of a deployment names; ConfigurationError where there is none."""
    if _web_alone(name):
        raise ConfigurationError(
            f"{key} names {name}, which is the web's and never a station's; allowed: a variable of its own, "
            "such as EVA_POLICY_KEY"
        )
    value = os.environ.get(name)
    if not value:
        raise ConfigurationError(f"{key} names {name}, which is not set in the environment")
    return value
