"""Readers of settings from environment variables; an invalid value raises ImproperlyConfigured at start-up."""

from __future__ import annotations

import math
import os
import re
import secrets
import sys
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from importlib.util import find_spec
from ipaddress import IPv4Network, IPv6Network, ip_network
from pathlib import Path
from urllib.parse import urlsplit
from zoneinfo import ZoneInfo, ZoneInfoNotFoundError

from django.core.exceptions import ImproperlyConfigured

_TRUE, _FALSE = ("1", "true", "yes", "on"), ("0", "false", "no", "off", "")
HUB_KEY = "hub_tokens.key"  # file in DATA without which the Hugging Face tokens of people cannot be decrypted
_LEVELS = ("DEBUG", "INFO", "WARNING", "ERROR", "CRITICAL")


@dataclass(frozen=True, slots=True)
class Bucket:
    """Bucket of an S3-compatible store, with its credentials; `endpoint` is "" for Amazon's own servers."""

    name: str
    prefix: str
    endpoint: str
    region: str
    key: str
    secret: str = field(repr=False)

    @property
    def origin(self) -> str:
        """Origin of signed URLs, for the content security policy."""
        return self.endpoint or f"https://s3.{self.region}.amazonaws.com"

    def __str__(self) -> str:
        return f"s3://{self.name}/{self.prefix}".rstrip("/")


def read_flag(name: str, default: bool) -> bool:
    """Return the boolean value of the environment variable `name`."""
    text = os.environ.get(name)
    if text is None:
        return default
    word = text.strip().lower()
    if word not in _TRUE + _FALSE:
        raise ImproperlyConfigured(f"{name} = {text!r}; allowed: {', '.join(_TRUE + _FALSE[:-1])}")
    return word in _TRUE


def read_list(name: str, default: tuple[str, ...] = ()) -> list[str]:
    """Return the items of the environment variable `name`, which are separated by commas."""
    text = os.environ.get(name)
    return list(default) if text is None else [word.strip() for word in text.split(",") if word.strip()]


def _number(name: str, default: float, least: float, most: float, allowed: str) -> float:
    text = os.environ.get(name)
    if text is None:
        return default
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not least <= value <= most:
        raise ImproperlyConfigured(f"{name} = {text!r}; allowed: {allowed}")
    return value


def read_seconds(name: str, default: float) -> float:
    """Return the duration [s] in the environment variable `name`, which must be above zero."""
    return _number(name, default, sys.float_info.min, sys.float_info.max, "seconds above zero")


def mebibytes(name: str, default: float) -> float:
    """Return the size [MiB] in the environment variable `name`, which must be at least 1."""
    return _number(name, default, 1.0, 1e6, "mebibytes from 1 to 1000000")


def gigabytes(name: str, default: float) -> float:
    """Return the size [GB] in the environment variable `name`, which must be at least 0."""
    return _number(name, default, 0.0, 1e6, "gigabytes from 0 to 1000000")


def archive_days(name: str, stored: bool) -> float | None:
    """Return the number of days in the environment variable `name`, at least 0; None if it is not set.

    `stored` is whether there is a store, without which nothing can be archived.
    """
    if not os.environ.get(name, "").strip():
        return None
    days = _number(name, 0.0, 0.0, 1e5, "days from 0 to 100000")
    if not stored:
        raise ImproperlyConfigured(
            f"{name} = {os.environ[name]!r}, and EVA_STORE names no store: set EVA_STORE, or remove {name}"
        )
    return days


def niceness(name: str, default: int) -> int:
    """Return the process niceness in the environment variable `name`: from 0 (normal priority) to 19 (lowest)."""
    return _whole(name, default, 19)


def copies(name: str, default: int) -> int:
    """Return the number of copies in the environment variable `name`: from 0 to 1000."""
    return _whole(name, default, 1000)


def _whole(name: str, default: int, most: int) -> int:
    text = os.environ.get(name)
    if text is None:
        return default
    if not (text.isascii() and text.isdecimal() and int(text) <= most):
        raise ImproperlyConfigured(f"{name} = {text!r}; allowed: 0 to {most}")
    return int(text)


def read_networks(name: str) -> list[IPv4Network | IPv6Network]:
    """Return the comma-separated addresses and networks in the environment variable `name`; [] if it is not set."""
    try:
        return [ip_network(word) for word in read_list(name)]
    except ValueError as error:
        text = os.environ[name]
        raise ImproperlyConfigured(
            f"{name} = {text!r}: {error}; allowed: addresses and networks such as 127.0.0.1, 10.0.0.0/24"
        ) from None


def address(name: str) -> tuple[str, int] | None:
    """Return host and port in the environment variable `name` (HOST:PORT); None if it is not set."""
    text = os.environ.get(name, "").strip()
    if not text:
        return None
    host, _, port = text.rpartition(":")
    if not host or not port.isdecimal() or not 0 < int(port) < 65535:
        raise ImproperlyConfigured(
            f"{name} = {text!r}; allowed: HOST:PORT such as 0.0.0.0:8470, the port below 65535"
        )
    return host.strip("[]"), int(port)


def log_level(name: str, default: str) -> str:
    """Return the level in the environment variable `name`: messages below it are not logged."""
    level = os.environ.get(name) or default
    if level not in _LEVELS:
        raise ImproperlyConfigured(f"{name} = {level!r}; allowed: {', '.join(_LEVELS)}")
    return level


def time_zone(name: str, default: str) -> str:
    """Return the time zone in the environment variable `name`, in which pages show times."""
    zone = os.environ.get(name)
    if not zone:
        return default
    try:
        return ZoneInfo(zone).key
    except (ZoneInfoNotFoundError, ValueError, OSError):  # unknown name, malformed name, folder of names
        raise ImproperlyConfigured(
            f"{name} = {zone!r}; allowed: names such as UTC, Europe/Berlin, Asia/Shanghai"
        ) from None


def store() -> Path | Bucket | None:
    """Return the folder or bucket of EVA_STORE for large immutable files; None if it is not set."""
    address = os.environ.get("EVA_STORE", "").strip()
    if not address:
        return None
    if not address.startswith("s3://"):
        folder = Path(address).expanduser()
        if not folder.is_absolute() or not folder.is_dir():
            raise ImproperlyConfigured(
                f"EVA_STORE = {address!r}; allowed: the path of a folder that is there, or s3://BUCKET/PREFIX"
            )
        return folder
    name, _, prefix = address.removeprefix("s3://").partition("/")
    if not re.fullmatch("[a-z0-9][a-z0-9.-]{1,61}[a-z0-9]", name):
        raise ImproperlyConfigured(f"EVA_STORE = {address!r}; allowed: s3://BUCKET or s3://BUCKET/PREFIX")
    if find_spec("obstore") is None:
        raise ImproperlyConfigured(
            "EVA_STORE names a bucket, and obstore is absent: .venv/bin/python -m pip install -e '.[s3]'"
        )
    key, secret = os.environ.get("EVA_STORE_KEY", ""), os.environ.get("EVA_STORE_SECRET", "")
    if not key or not secret:
        raise ImproperlyConfigured(
            "EVA_STORE names a bucket: give its key in EVA_STORE_KEY and EVA_STORE_SECRET"
        )
    region = os.environ.get("EVA_STORE_REGION") or "us-east-1"
    return Bucket(name, prefix.strip("/"), _endpoint("EVA_STORE_ENDPOINT"), region, key, secret)


def _endpoint(name: str) -> str:
    """Return the origin that the environment variable `name` sets, "" if it is not set.

    The origin is inserted unescaped into the content security policy, and therefore checked.

    Raises:
        ImproperlyConfigured: If the value is not an origin.
    """
    origin = os.environ.get(name, "").strip().rstrip("/")
    parts = urlsplit(origin)
    whole = f"{parts.scheme}://{parts.netloc}"
    if origin and (origin != whole or not re.fullmatch(r"https?://[A-Za-z0-9.\[\]:-]+", origin)):
        raise ImproperlyConfigured(
            f"{name} = {origin!r}; allowed: an origin such as https://s3.example.org:9000"
        )
    return origin


def require_driver(name: str, engine: str) -> None:
    """Raise ImproperlyConfigured if the Python driver of the database is not installed."""
    if engine.endswith("postgresql") and find_spec("psycopg") is None:
        raise ImproperlyConfigured(
            f"{name} names PostgreSQL, whose driver is absent: .venv/bin/python -m pip install -e '.[lab]'"
        )


def checkout(folder: Path) -> Path:
    """Return `folder` if it contains templates and static files. Raises: ImproperlyConfigured if it does not."""
    absent = [name for name in ("templates", "static") if not (folder / name).is_dir()]
    if absent:
        raise ImproperlyConfigured(
            f"{folder} has no {' and no '.join(absent)}: the web runs from a checkout of its repository "
            "(make setup there, or pip install --editable .); runtime and robots alone also run installed"
        )
    return folder


def data_dir(default: Path) -> Path:
    """Return the data folder of the lab (EVA_DATA_DIR); create it with mode 700 if it is absent."""
    folder = Path(os.environ.get("EVA_DATA_DIR") or default).expanduser().absolute()
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    except OSError as error:
        raise ImproperlyConfigured(
            f"EVA_DATA_DIR = {folder}: {error.strerror}; name a folder that can be written"
        ) from None
    return folder


def private_file(path: Path) -> Path:
    """Return `path` after creating the file if it does not exist.

    The file gets mode 600, and so do SQLite's files next to it: a restored copy that other accounts could read is made
    private again.
    """
    os.close(os.open(path, os.O_RDWR | os.O_CREAT, 0o600))
    for file in database_files(path):
        _make_private(file)
    return path


def database_files(database: Path) -> list[Path]:
    """Return the existing files of an SQLite database: itself and its journals."""
    names = [database, *(database.with_name(database.name + end) for end in ("-wal", "-shm", "-journal"))]
    return [path for path in names if path.exists()]


def readable_by_others(path: Path) -> bool:
    """Return True if accounts other than the owner may read or write the file."""
    return bool(path.stat().st_mode & 0o077)


def _make_private(path: Path) -> None:
    """Set mode 600 of a file that others can read.

    A file of another account cannot be changed; evaweb.core.file_checks warns about it at every start.
    """
    if readable_by_others(path):
        with suppress(PermissionError):
            path.chmod(0o600)


def secret_key(folder: Path) -> str:
    """Return EVA_SECRET_KEY, else a key of the lab that is generated once and stored privately."""
    key = os.environ.get("EVA_SECRET_KEY")
    return key or _load_or_create(folder / "secret_key", partial(secrets.token_urlsafe, 50))


def lab_id(folder: Path) -> str:
    """Return a random id of this lab, 8 characters unless edited.

    Cookie names contain it, because cookies ignore ports: two labs on one host would overwrite each other's.
    """
    path = folder / "lab_id"
    text = _load_or_create(path, partial(secrets.token_hex, 4))
    if not re.fullmatch("[0-9A-Za-z]{1,32}", text):
        raise ImproperlyConfigured(
            f"{path}: {text!r:.60}; allowed: 1 to 32 letters and digits, or remove it, and everybody logs in anew"
        )
    return text


def _load_or_create(path: Path, make: Callable[[], str]) -> str:
    """Return the content of a private file; create it from `make` if it is absent."""
    try:
        descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
    except FileExistsError:
        _make_private(path)
        text = path.read_text("utf-8").strip()
        if not text:
            raise ImproperlyConfigured(f"{path} is empty: remove it, and everybody logs in anew") from None
        return text
    with os.fdopen(descriptor, "w", encoding="utf-8") as file:
        value = make()
        file.write(value)
    return value
