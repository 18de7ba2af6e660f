"""The panel's PIN: kept as a hash that takes a while to try, and tried less and less often."""

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
_COST = {"n": 2**14, "r": 8, "p": 1}  # 16 MB and some 50 ms
_OTHERS = stat.S_IRWXG | stat.S_IRWXO
_FREE, _LONGEST_WAIT_S = 3, 300.0  # of one source
_FREE_IN_ALL, _LONGEST_WAIT_IN_ALL_S = 20, 60.0
_FORGOTTEN_S = 3600.0
_MOST_SOURCES = 1000


class PinFile:
    """DATA/stations/NAME/panel.pin, which this account alone can read."""

    def __init__(self, station_dir: Path) -> None:
        self.path = station_dir / "panel.pin"

    def set(self, pin: str) -> None:
        """Keep another one; ConfigurationError where it is too short or too long."""
        if not SHORTEST <= len(pin) <= LONGEST:
            raise ConfigurationError(
                f"the PIN has {len(pin)} characters; allowed: {SHORTEST} to {LONGEST}, digits or any others"
            )
        salt = secrets.token_bytes(16)
        kept = {**_COST, "salt": salt.hex(), "hash": _hashed(pin, salt, **_COST).hex()}
        self.path.parent.mkdir(parents=True, exist_ok=True)
        write_durably(self.path, json.dumps(kept).encode(), 0o600)

    @property
    def version(self) -> tuple[int, int]:
        """Which PIN it is: another one after each `set`; (0, 0) where there is none."""
        try:
            found = self.path.stat()
        except OSError:
            return (0, 0)
        return found.st_ino, found.st_mtime_ns

    def matches(self, pin: str) -> bool:
        """True if it is this one; ConfigurationError where none is set, or its file is of no use."""
        try:
            if self.path.stat().st_mode & _OTHERS:
                raise ConfigurationError(f"{self.path} can be read by others; allowed: 0600; set a PIN again")
            kept = json.loads(self.path.read_text("utf-8"))
            salt, wanted = bytes.fromhex(kept["salt"]), bytes.fromhex(kept["hash"])
            made = _hashed(pin, salt, int(kept["n"]), int(kept["r"]), int(kept["p"]))
        except FileNotFoundError:
            raise ConfigurationError("no PIN is set on the station's computer") from None
        except (OSError, ValueError, KeyError, TypeError, OverflowError) as error:
            raise ConfigurationError(f"{self.path} cannot be used ({error}): set a PIN again") from None
        return hmac.compare_digest(made, wanted)


def _hashed(pin: str, salt: bytes, n: int, r: int, p: int) -> bytes:
    return hashlib.scrypt(pin.encode(), salt=salt, n=n, r=r, p=p, maxmem=2**26)


@dataclass(slots=True)
class _Failures:
    count: int = 0
    until: float = 0.0
    last: float = 0.0

    def add(self, now: float, free: int, longest: float) -> None:
        """One more: the first ones cost nothing, then it is twice as long each time."""
        self.count, self.last = self.count + 1, now
        beyond = self.count - free
        if beyond >= 0:
            self.until = now + min(2.0 ** min(beyond + 1, 16), longest)


class Attempts:
    """Who has to wait before a PIN is looked at: each source of wrong ones, and all sources together.

    Times on a monotonic clock. The e-stop asks for no PIN, so nobody waits for it.
    """

    def __init__(self, now: Callable[[], float] = time.monotonic) -> None:
        self._now = now
        self._sources: OrderedDict[str, _Failures] = OrderedDict()
        self._all = _Failures()

    def wait(self, source: str) -> float:
        """Seconds until the next PIN of that source is looked at; 0 where it is at once."""
        now = self._now()
        if now - self._all.last > _FORGOTTEN_S:
            self._all = _Failures()
        own = self._sources.get(source)
        if own is not None and now - own.last > _FORGOTTEN_S:
            del self._sources[source]
            own = None
        return max(0.0, self._all.until - now, own.until - now if own is not None else 0.0)

    def failed(self, source: str) -> None:
        """A wrong PIN."""
        now = self._now()
        self._sources.setdefault(source, _Failures()).add(now, _FREE, _LONGEST_WAIT_S)
        self._sources.move_to_end(source)
        if len(self._sources) > _MOST_SOURCES:
            self._sources.popitem(last=False)
        self._all.add(now, _FREE_IN_ALL, _LONGEST_WAIT_IN_ALL_S)

    def passed(self, source: str) -> None:
        """The right one: this source begins anew, what others have tried stays."""
        self._sources.pop(source, None)
