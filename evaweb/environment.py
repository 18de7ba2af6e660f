"""Reads settings from the environment; a value that cannot be used ends the start with a sentence."""

from __future__ import annotations

import os
import secrets
from importlib.util import find_spec
from pathlib import Path
from zoneinfo import ZoneInfo, ZoneInfoNotFoundError

from django.core.exceptions import ImproperlyConfigured

_TRUE, _FALSE = ("1", "true", "yes", "on"), ("0", "false", "no", "off", "")
_LEVELS = ("DEBUG", "INFO", "WARNING", "ERROR", "CRITICAL")


def flag(name: str, default: bool) -> bool:
    """A yes or no."""
    given = os.environ.get(name)
    if given is None:
        return default
    word = given.strip().lower()
    if word not in _TRUE + _FALSE:
        raise ImproperlyConfigured(f"{name} = {given!r}; allowed: {', '.join(_TRUE + _FALSE[:-1])}")
    return word in _TRUE


def words(name: str, default: tuple[str, ...] = ()) -> list[str]:
    """A list separated by commas."""
    given = os.environ.get(name)
    return list(default) if given is None else [word.strip() for word in given.split(",") if word.strip()]


def seconds(name: str, default: float) -> float:
    """A time above zero [s]."""
    given = os.environ.get(name)
    if given is None:
        return default
    try:
        value = float(given)
    except ValueError:
        value = 0.0
    if not 0 < value < float("inf"):
        raise ImproperlyConfigured(f"{name} = {given!r}; allowed: seconds above zero")
    return value


def log_level(name: str, default: str) -> str:
    """From which level on something is logged."""
    given = os.environ.get(name) or default
    if given not in _LEVELS:
        raise ImproperlyConfigured(f"{name} = {given!r}; allowed: {', '.join(_LEVELS)}")
    return given


def time_zone(name: str, default: str) -> str:
    """In which time zone pages show times."""
    given = os.environ.get(name)
    if not given:
        return default
    try:
        return ZoneInfo(given).key
    except (ZoneInfoNotFoundError, ValueError, OSError):  # unknown, no name at all, a folder of names
        raise ImproperlyConfigured(
            f"{name} = {given!r}; allowed: names such as UTC, Europe/Berlin, Asia/Shanghai"
        ) from None


def require_driver(name: str, engine: str) -> None:
    """The Python package that a database needs is there."""
    if engine.endswith("postgresql") and find_spec("psycopg") is None:
        raise ImproperlyConfigured(
            f"{name} names PostgreSQL, whose driver is absent: .venv/bin/python -m pip install -e '.[lab]'"
        )


def checkout(folder: Path) -> Path:
    """The folder of the program, which pages and scripts are read from; ImproperlyConfigured where they are not."""
    absent = [name for name in ("templates", "static") if not (folder / name).is_dir()]
    if absent:
        raise ImproperlyConfigured(
            f"{folder} has no {' and no '.join(absent)}: the web runs from a checkout of its repository "
            "(make setup there, or pip install --editable .); runtime and robots alone also run installed"
        )
    return folder


def data_dir(default: Path) -> Path:
    """The folder that holds everything of this lab; created where it is absent."""
    folder = Path(os.environ.get("EVA_DATA_DIR") or default).expanduser().absolute()
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ImproperlyConfigured(
            f"EVA_DATA_DIR = {folder}: {error.strerror}; name a folder that can be written"
        ) from None
    return folder


def private_file(path: Path) -> Path:
    """`path`, made empty where it is absent: for its user alone, as is what SQLite puts beside it."""
    os.close(os.open(path, os.O_RDWR | os.O_CREAT, 0o600))
    return path


def secret_key(folder: Path) -> str:
    """EVA_SECRET_KEY, or one of the lab's own that is made once and readable by its user alone."""
    given = os.environ.get("EVA_SECRET_KEY")
    if given:
        return given
    path = folder / "secret_key"
    try:
        descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
    except FileExistsError:
        found = path.read_text("utf-8").strip()
        if not found:
            raise ImproperlyConfigured(f"{path} is empty: remove it, and everybody logs in anew") from None
        return found
    with os.fdopen(descriptor, "w", encoding="utf-8") as file:
        made = secrets.token_urlsafe(50)
        file.write(made)
    return made
