"""Signed permission for one command of a user, good for seconds counted on the station's own clock.

The station makes challenges, the lab signs one of them with the command, the station verifies that: no two clocks have
to agree, and what was signed once is good for one message. A token says who commands; it is never asked for to stop.
"""

from __future__ import annotations

import hashlib
import secrets
import time
from collections import OrderedDict
from collections.abc import Callable

from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey, Ed25519PublicKey

from runtime.link.wire import Ask

VALID_S = 3.0  # from when the station has made the challenge to when the command arrives
_EVERY_S = 0.2  # between two challenges
_CHALLENGE_BYTES = 16
_DOMAIN = b"eva-web link command 1\0"
_MOST_SERIALS = 10_000  # of one challenge
_LARGEST_SERIAL = (1 << 63) - 1


def _signed(station: str, challenge: bytes, serial: int, place: str, payload: bytes) -> bytes:
    """Bytes of a fixed layout but for two texts, which no zero byte is in."""
    words = f"{station}\0{place}\0".encode()
    return _DOMAIN + words + challenge + serial.to_bytes(8, "big") + hashlib.sha256(payload).digest()


class Signer:
    """The lab's end: signs commands for stations, each with a serial of its own."""

    def __init__(self, key: Ed25519PrivateKey) -> None:
        self._key = key
        self._serial = secrets.randbits(48)  # so that two processes of one lab never give the same

    def token(self, station: str, challenge: bytes, place: str, payload: bytes) -> tuple[int, bytes]:
        """Serial and signature for one message with the station's challenge."""
        self._serial += 1
        return self._serial, self._key.sign(_signed(station, challenge, self._serial, place, payload))


class Challenges:
    """The station's end: makes challenges, and knows which tokens are good and have not been used."""

    def __init__(
        self, station: str, key: Ed25519PublicKey, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._station, self._key, self._clock = station, key, clock
        self._made: OrderedDict[bytes, tuple[float, set[int]]] = OrderedDict()  # when, and the serials used

    def newest(self) -> bytes:
        """A challenge for the lab: a new one where the last is some time old."""
        now = self._clock()
        last = next(reversed(self._made), None)
        if last is None or now - self._made[last][0] >= _EVERY_S:
            last = secrets.token_bytes(_CHALLENGE_BYTES)
            self._made[last] = (now, set())
        while now - next(iter(self._made.values()))[0] > VALID_S:
            self._made.popitem(last=False)
        return last

    def wrong(self, ask: Ask, payload: bytes) -> str:
        """Why the token of a message is worth nothing; "" where it is good, which it is once."""
        if not ask.signature:
            return "the lab names no user for it"
        made = self._made.get(ask.challenge)
        if made is None or self._clock() - made[0] > VALID_S:
            return f"it was more than {VALID_S:g} s on its way from the lab: give it again"
        if not 0 <= ask.serial <= _LARGEST_SERIAL or not self._verifies(ask, payload):
            return "its signature is not this lab's"
        serials = made[1]
        if ask.serial in serials or len(serials) >= _MOST_SERIALS:
            return "its token was used before"
        serials.add(ask.serial)
        return ""

    def _verifies(self, ask: Ask, payload: bytes) -> bool:
        place = place_of(ask)
        try:
            self._key.verify(ask.signature, _signed(self._station, ask.challenge, ask.serial, place, payload))
        except (InvalidSignature, ValueError):
            return False
        return True


def place_of(ask: Ask) -> str:
    """The socket that a command is for, as it is signed."""
    return f"{ask.process}/{ask.socket}"
