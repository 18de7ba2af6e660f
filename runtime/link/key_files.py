"""Keys of both ends as files that this account alone can read, and what a station knows of its lab.

DATA/link/station.key       of a robot's computer, for all its stations
DATA/link/lab.key           of a lab: to which stations connect
DATA/link/tokens.key        of a lab: with which it signs commands
DATA/stations/NAME/lab.json of a station that is enrolled: where its lab is, and its public keys
"""

from __future__ import annotations

import json
import os
import secrets
import stat
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import zmq
import zmq.utils.z85

from runtime.core.durable_files import create_durably, write_durably
from runtime.core.errors import ConfigurationError
from runtime.ipc.endpoints import account_name

_KEY_BYTES = 32
_ROOT = 0
_STATION, _LAB, _TOKENS = "station.key", "lab.key", "tokens.key"


@dataclass(frozen=True, slots=True)
class KeyPair:
    """A pair of CURVE keys, 32 bytes each."""

    public: bytes
    secret: bytes

    @classmethod
    def from_secret(cls, secret: bytes) -> KeyPair:
        """The pair of a secret key."""
        public = zmq.curve_public(z85(secret))
        return cls(zmq.utils.z85.decode(public), secret)


@dataclass(frozen=True, slots=True)
class KnownLab:
    """What a station knows of its lab: where it is, and by what it knows that it is the lab."""

    station: str
    lab: str  # its name, as people know it
    host: str
    port: int
    second_port: int
    key: str  # of CURVE, hexadecimal
    tokens: str  # of Ed25519, hexadecimal


def z85(key: bytes) -> bytes:
    """A key of 32 bytes as ZMQ wants it."""
    encoded: bytes = zmq.utils.z85.encode(key)
    return encoded


def folder(data: Path) -> Path:
    """The folder of keys in a data folder."""
    return data / "link"


def key_path(data: Path) -> Path:
    """The file of this computer's key."""
    return folder(data) / _STATION


def station_key(data: Path) -> KeyPair:
    """The pair of this computer; ConfigurationError where it has none, or others can read it."""
    path = key_path(data)
    if not path.exists():
        raise ConfigurationError(f"{path} is not there: make it with python -m runtime.keys new")
    return KeyPair.from_secret(_read(path))


def make_station_key(data: Path, replace: bool = False) -> KeyPair:
    """A new pair for this computer; ConfigurationError where it has one, unless that is to be replaced."""
    path = key_path(data)
    if path.exists() and not replace:
        raise ConfigurationError(
            f"{path} is there already: python -m runtime.keys show says what it is; with --replace another takes its "
            "place, and every station of this computer has to be enrolled again"
        )
    secret = zmq.utils.z85.decode(zmq.curve_keypair()[1])
    _write(path, secret)
    return KeyPair.from_secret(secret)


def lab_key(data: Path) -> KeyPair:
    """The pair of this lab's gate, made where there is none."""
    return KeyPair.from_secret(
        _load_or_create(folder(data) / _LAB, zmq.utils.z85.decode(zmq.curve_keypair()[1]))
    )


def tokens_key(data: Path) -> bytes:
    """The secret with which this lab signs commands, made where there is none: the 32 bytes of an Ed25519 key."""
    return _load_or_create(folder(data) / _TOKENS, secrets.token_bytes(_KEY_BYTES))


def known_lab_path(station_dir: Path) -> Path:
    """The file that a station has where it is enrolled."""
    return station_dir / "lab.json"


def save_lab(station_dir: Path, lab: KnownLab) -> None:
    """Write down what the station knows of its lab from now on."""
    _write(known_lab_path(station_dir), json.dumps(asdict(lab), indent=1).encode())


def known_lab(station_dir: Path) -> KnownLab:
    """What the station knows of its lab; ConfigurationError where it is not enrolled, or its file is of no use."""
    path = known_lab_path(station_dir)
    try:
        found = json.loads(path.read_text("utf-8"))
        lab = KnownLab(**{name: kind(found[name]) for name, kind in _LAB_FIELDS.items()})
        if len(bytes.fromhex(lab.key)) != _KEY_BYTES or len(bytes.fromhex(lab.tokens)) != _KEY_BYTES:
            raise ValueError("a key of another length")
    except FileNotFoundError:
        raise ConfigurationError(
            f"the station {station_dir.name!r} is not enrolled at a lab ({path} is not there): "
            "python -m runtime.keys enrol ADDRESS CODE"
        ) from None
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise ConfigurationError(f"{path} cannot be used ({error!r:.80}): enrol the station again") from None
    return lab


_LAB_FIELDS: dict[str, Any] = {
    "station": str,
    "lab": str,
    "host": str,
    "port": int,
    "second_port": int,
    "key": str,
    "tokens": str,
}


def _read(path: Path) -> bytes:
    """A key of 32 bytes; ConfigurationError where others can read it, or it is something else."""
    try:
        found = os.stat(path, follow_symlinks=False)
        if not stat.S_ISREG(found.st_mode) or found.st_mode & (stat.S_IRWXG | stat.S_IRWXO):
            raise ConfigurationError(
                f"the key {path} has the mode {stat.S_IMODE(found.st_mode):04o}: whoever reads it is taken for its "
                "owner; allowed: a file with 0600"
            )
        if found.st_uid not in (os.geteuid(), _ROOT):
            raise ConfigurationError(
                f"the key {path} belongs to {account_name(found.st_uid)}; allowed: {account_name(os.geteuid())}"
            )
        secret = path.read_bytes()
    except OSError as error:
        raise ConfigurationError(f"the key {path} cannot be read: {error.strerror}") from None
    if len(secret) != _KEY_BYTES:
        raise ConfigurationError(f"the key {path} has {len(secret)} bytes; allowed: {_KEY_BYTES}")
    return secret


def _load_or_create(path: Path, secret: bytes) -> bytes:
    """The key in that file, which is `secret` where there was none; nobody ever sees a part of it."""
    if not path.exists():
        _write(path, secret, create_durably)
    return _read(path)


def _write(path: Path, content: bytes, write: Callable[[Path, bytes, int], None] = write_durably) -> None:
    try:
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        write(path, content, 0o600)
    except OSError as error:
        raise ConfigurationError(f"{path} cannot be written: {error.strerror}") from None
