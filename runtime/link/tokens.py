"""Signed permission for one command of a user, valid for a few seconds on the station's own clock.

The station issues challenges, the lab signs a challenge together with the command, and the station verifies the
signature: the two clocks need not agree, and a signature is valid for one message. A token identifies the user who
commands; stops never need one.
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

VALID_S = 3.0  # from issuing the challenge to the arrival of the command [s]
_EVERY_S = 0.2  # shortest time between two challenges [s]
_CHALLENGE_BYTES = 16
_DOMAIN = b"eva-web link command 1\0"
_MOST_SERIALS = 10_000  # per challenge: bounds the memory that a flood can use
_LARGEST_SERIAL = (1 << 63) - 1


def _signed(station: str, challenge: bytes, serial: int, place: str, payload: bytes) -> bytes:
    """Return the bytes to sign.

    All parts have a fixed length except two texts; each of these ends with a zero byte and contains none, so that
    different arguments never give the same bytes.
    """
    label = f"{station}\0{place}\0".encode()
    return _DOMAIN + label + challenge + serial.to_bytes(8, "big") + hashlib.sha256(payload).digest()


class Signer:
    """Signer of commands at the lab's end; each signature has a new serial."""

    def __init__(self, key: Ed25519PrivateKey) -> None:
        self._key = key
        self._serial = secrets.randbits(
            48
        )  # random start: two processes of a lab do not use the same serials

    def token(self, station: str, challenge: bytes, place: str, payload: bytes) -> tuple[int, bytes]:
        """Return serial and signature for one message, bound to the station's challenge."""
        self._serial += 1
        return self._serial, self._key.sign(_signed(station, challenge, self._serial, place, payload))


class Challenges:
    """Issuer of challenges at the station's end, which also checks that each token is valid and used once."""

    def __init__(
        self, station: str, key: Ed25519PublicKey, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._station, self._key, self._clock = station, key, clock
        self._made: OrderedDict[bytes, tuple[float, set[int]]] = OrderedDict()  # issue time, used serials

    def newest(self) -> bytes:
        """Return the current challenge; issue a new one if it is older than `_EVERY_S`."""
        now = self._clock()
        last = next(reversed(self._made), None)
        if last is None or now - self._made[last][0] >= _EVERY_S:
            last = secrets.token_bytes(_CHALLENGE_BYTES)
            self._made[last] = (now, set())
        while now - next(iter(self._made.values()))[0] > VALID_S:
            self._made.popitem(last=False)
        return last

    def wrong(self, ask: Ask, payload: bytes) -> str:
        """Return the reason to reject a message's token, "" if it is valid.

        This call uses up a valid token: the same token is rejected from then on.
        """
        if not ask.signature:
            return "the lab names no user for it"
        challenge = self._made.get(ask.challenge)
        if challenge is None or self._clock() - challenge[0] > VALID_S:
            return f"it was more than {VALID_S:g} s on its way from the lab: give it again"
        if not 0 <= ask.serial <= _LARGEST_SERIAL or not self._verifies(ask, payload):
            return "its signature is not this lab's"
        serials = challenge[1]
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
    """Return the socket that a command is for, in the form that is signed."""
    return f"{ask.process}/{ask.socket}"
