"""Keys of both ends in files that only this account can read, and a station's record of its lab.

DATA/link/station.key       key of a robot's computer, for all its stations
DATA/link/lab.key           key of a lab, which authenticates it to stations
DATA/link/tokens.key        key with which a lab signs commands
DATA/stations/NAME/lab.json an enrolled station's record of its lab: address and public keys
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
    """Pair of CURVE keys, 32 bytes each."""

    public: bytes
    secret: bytes

    @classmethod
    def from_secret(cls, secret: bytes) -> KeyPair:
        """Return the pair that belongs to a secret key."""
        public = zmq.curve_public(z85(secret))
        return cls(zmq.utils.z85.decode(public), secret)


@dataclass(frozen=True, slots=True)
class KnownLab:
    """Record that a station has of its lab: the lab's address, and the public keys that authenticate it."""

    station: str
    lab: str  # name that people use
    host: str
    port: int
    second_port: int
    key: str  # CURVE public key, hexadecimal
    tokens: str  # Ed25519 public key, hexadecimal


def z85(key: bytes) -> bytes:
    """Encode a key of 32 bytes for ZMQ."""
    encoded: bytes = zmq.utils.z85.encode(key)
    return encoded


def folder(data: Path) -> Path:
    """Return the folder of keys in a data folder."""
    return data / "link"


def key_path(data: Path) -> Path:
    """Return the path of this computer's key."""
    return folder(data) / _STATION


def station_key(data: Path) -> KeyPair:
    """Return this computer's key pair. Raises: ConfigurationError if it has none or others can read it."""
    path = key_path(data)
    if not path.exists():
        raise ConfigurationError(f"{path} is not there: make it with python -m runtime.keys new")
    return KeyPair.from_secret(_read(path))


def make_station_key(data: Path, replace: bool = False) -> KeyPair:
    """Create a key pair for this computer.

    Raises: ConfigurationError if it has one already, unless `replace` is set.
    """
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
    """Return the key pair of this lab's gate; create it on first use."""
    return KeyPair.from_secret(
        _load_or_create(folder(data) / _LAB, zmq.utils.z85.decode(zmq.curve_keypair()[1]))
    )


def tokens_key(data: Path) -> bytes:
    """Return the Ed25519 secret, 32 bytes, with which this lab signs commands; create it on first use."""
    return _load_or_create(folder(data) / _TOKENS, secrets.token_bytes(_KEY_BYTES))


def known_lab_path(station_dir: Path) -> Path:
    """Return the path of an enrolled station's record of its lab."""
    return station_dir / "lab.json"


def save_lab(station_dir: Path, lab: KnownLab) -> None:
    """Write the station's record of its lab."""
    _write(known_lab_path(station_dir), json.dumps(asdict(lab), indent=1).encode())


def known_lab(station_dir: Path) -> KnownLab:
    """Read the station's record of its lab. Raises: ConfigurationError if it is not enrolled or the file is invalid."""
    path = known_lab_path(station_dir)
    try:
        fields = json.loads(path.read_text("utf-8"))
        lab = KnownLab(**{name: kind(fields[name]) for name, kind in _LAB_FIELDS.items()})
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
    """Read a key of 32 bytes. Raises: ConfigurationError if others can read the file or it is not a key."""
    try:
        status = os.stat(path, follow_symlinks=False)
        if not stat.S_ISREG(status.st_mode) or status.st_mode & (stat.S_IRWXG | stat.S_IRWXO):
            raise ConfigurationError(
                f"the key {path} has the mode {stat.S_IMODE(status.st_mode):04o}: a reader can act as its owner; "
                "allowed: a file with 0600"
            )
        if status.st_uid not in (os.geteuid(), _ROOT):
            raise ConfigurationError(
                f"the key {path} belongs to {account_name(status.st_uid)}; allowed: {account_name(os.geteuid())}"
            )
        secret = path.read_bytes()
    except OSError as error:
        raise ConfigurationError(f"the key {path} cannot be read: {error.strerror}") from None
    if len(secret) != _KEY_BYTES:
        raise ConfigurationError(f"the key {path} has {len(secret)} bytes; allowed: {_KEY_BYTES}")
    return secret


def _load_or_create(path: Path, secret: bytes) -> bytes:
    """Return the key in the file; if there is no file, create it with `secret`.

    The complete draft is linked into place: a concurrent reader never reads part of a key, and the first writer wins.
    """
    if not path.exists():
        _write(path, secret, create_durably)
    return _read(path)


def _write(path: Path, content: bytes, write: Callable[[Path, bytes, int], None] = write_durably) -> None:
    try:
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        write(path, content, 0o600)
    except OSError as error:
        raise ConfigurationError(f"{path} cannot be written: {error.strerror}") from None
