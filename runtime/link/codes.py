"""One-time code for enrolment: the public key of the lab's gate, and a secret.

The code contains the whole key, so nothing has to be fetched from an unverified address: a computer that answers there
without the lab's secret key cannot read the station's messages.
"""

from __future__ import annotations

import base64
import hashlib
import secrets
from dataclasses import dataclass

from runtime.core.errors import ConfigurationError

_KEY_BYTES, SECRET_BYTES, _SUM_BYTES = 32, 10, 3
_WHOLE = _KEY_BYTES + SECRET_BYTES + _SUM_BYTES
_GROUP = 8


@dataclass(frozen=True, slots=True)
class Code:
    """Public key of the lab's gate, and a secret that is valid once."""

    lab: bytes
    secret: bytes

    def text(self) -> str:
        """Return the code as people copy it: nine groups of eight letters and digits."""
        whole = self.lab + self.secret
        letters = base64.b32encode(whole + _sum(whole)).decode()
        return "-".join(letters[at : at + _GROUP] for at in range(0, len(letters), _GROUP))


def fresh(lab: bytes) -> Code:
    """Return a new code of the lab whose gate has the public key `lab`."""
    return Code(lab, secrets.token_bytes(SECRET_BYTES))


def read(shown: str) -> Code:
    """Parse a copied code. Raises: ConfigurationError if the code is incomplete or mistyped."""
    letters = "".join(shown.split()).replace("-", "").upper()
    try:
        whole = base64.b32decode(letters)
    except ValueError:
        whole = b""
    body, end = whole[:-_SUM_BYTES], whole[-_SUM_BYTES:]
    if len(whole) != _WHOLE or not secrets.compare_digest(_sum(body), end):
        raise ConfigurationError(
            f"the code of {len(letters)} letters and digits is not whole, or mistyped; it has 72, in groups of 8: "
            "copy all of it from the administration"
        )
    return Code(body[:_KEY_BYTES], body[_KEY_BYTES:])


def fingerprint(key: bytes) -> str:
    """Return a public key as people compare it: four groups of five hexadecimal digits of its SHA-256."""
    digest = hashlib.sha256(key).hexdigest()
    return " ".join(digest[at : at + 5] for at in range(0, 20, 5))


def digest(secret: bytes) -> str:
    """Return the digest that the lab stores in place of the secret of a code."""
    return hashlib.sha256(b"eva-web enrolment 1\0" + secret).hexdigest()


def _sum(whole: bytes) -> bytes:
    return hashlib.sha256(b"eva-web code 1\0" + whole).digest()[:_SUM_BYTES]
