"""PIN of the panel: stored as a slow hash, and checked at growing intervals after wrong attempts."""

from __future__ import annotations

import hashlib
import hmac
import json
import secrets
import stat
import time
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from runtime.core.durable_files import write_durably
from runtime.core.errors import ConfigurationError

SHORTEST, LONGEST = 6, 64
_COST = {"n": 2**14, "r": 8, "p": 1}  # scrypt: 16 MB and about 50 ms
_OTHERS = stat.S_IRWXG | stat.S_IRWXO
_FREE, _LONGEST_WAIT_S = 3, 300.0  # per source: free failures, longest wait [s]
_FREE_IN_ALL, _LONGEST_WAIT_IN_ALL_S = 20, 60.0
_FORGOTTEN_S = 3600.0
_MOST_SOURCES = 1000


class PinFile:
    """File DATA/stations/NAME/panel.pin, which only this account can read."""

    def __init__(self, station_dir: Path) -> None:
        self.path = station_dir / "panel.pin"

    def set(self, pin: str) -> None:
        """Store a new PIN. Raises: ConfigurationError if it is too short or too long."""
        if not SHORTEST <= len(pin) <= LONGEST:
            raise ConfigurationError(
                f"the PIN has {len(pin)} characters; allowed: {SHORTEST} to {LONGEST}, digits or any others"
            )
        salt = secrets.token_bytes(16)
        fields = {**_COST, "salt": salt.hex(), "hash": _hashed(pin, salt, **_COST).hex()}
        self.path.parent.mkdir(parents=True, exist_ok=True)
        write_durably(self.path, json.dumps(fields).encode(), 0o600)

    @property
    def version(self) -> tuple[int, int]:
        """Identity of the stored PIN, which changes with each `set`; (0, 0) if there is none."""
        try:
            status = self.path.stat()
        except OSError:
            return (0, 0)
        return status.st_ino, status.st_mtime_ns

    def matches(self, pin: str) -> bool:
        """Return True if the PIN is right. Raises: ConfigurationError if none is set or its file is invalid."""
        try:
            if self.path.stat().st_mode & _OTHERS:
                raise ConfigurationError(f"{self.path} can be read by others; allowed: 0600; set a PIN again")
            fields = json.loads(self.path.read_text("utf-8"))
            salt, expected = bytes.fromhex(fields["salt"]), bytes.fromhex(fields["hash"])
            computed = _hashed(pin, salt, int(fields["n"]), int(fields["r"]), int(fields["p"]))
        except FileNotFoundError:
            raise ConfigurationError("no PIN is set on the station's computer") from None
        except (OSError, ValueError, KeyError, TypeError, OverflowError) as error:
            raise ConfigurationError(f"{self.path} cannot be used ({error}): set a PIN again") from None
        return hmac.compare_digest(computed, expected)


def _hashed(pin: str, salt: bytes, n: int, r: int, p: int) -> bytes:
    return hashlib.scrypt(pin.encode(), salt=salt, n=n, r=r, p=p, maxmem=2**26)


@dataclass(slots=True)
class _Failures:
    count: int = 0
    until: float = 0.0
    last: float = 0.0

    def add(self, now: float, free: int, longest: float) -> None:
        """Count a failure; from the failure with number `free` on, each causes a wait before the next attempt.

        The wait is 2 s after that failure and doubles with each further one, up to `longest` [s].
        """
        self.count, self.last = self.count + 1, now
        beyond = self.count - free
        if beyond >= 0:
            self.until = now + min(2.0 ** min(beyond + 1, 16), longest)


class Attempts:
    """Waiting times before a PIN is checked: per source of wrong PINs, and for all sources together.

    Times are of a monotonic clock. The e-stop needs no PIN and is never delayed.
    """

    def __init__(self, now: Callable[[], float] = time.monotonic) -> None:
        self._now = now
        self._sources: OrderedDict[str, _Failures] = OrderedDict()
        self._all = _Failures()

    def wait(self, source: str) -> float:
        """Return the time until the next PIN of that source is checked [s]; 0 if that may be done at once."""
        now = self._now()
        if now - self._all.last > _FORGOTTEN_S:
            self._all = _Failures()
        own = self._sources.get(source)
        if own is not None and now - own.last > _FORGOTTEN_S:
            del self._sources[source]
            own = None
        return max(0.0, self._all.until - now, own.until - now if own is not None else 0.0)

    def failed(self, source: str) -> None:
        """Record a wrong PIN."""
        now = self._now()
        self._sources.setdefault(source, _Failures()).add(now, _FREE, _LONGEST_WAIT_S)
        self._sources.move_to_end(source)
        if len(self._sources) > _MOST_SOURCES:
            self._sources.popitem(last=False)
        self._all.add(now, _FREE_IN_ALL, _LONGEST_WAIT_IN_ALL_S)

    def passed(self, source: str) -> None:
        """Record the right PIN: the failures of this source are cleared, the count for all sources together is not."""
        self._sources.pop(source, None)
