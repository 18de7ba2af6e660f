"""Names that stand in one line: on pages, in drawings, in files that others read."""

from __future__ import annotations

import re

from django.core.exceptions import ValidationError

# Controls and line ends, surrogates and what else XML has no character for, and marks that turn what follows around.
_REFUSED = re.compile("[\x00-\x1f\x7f-\x9f\u2028-\u202e\u2066-\u2069\ud800-\udfff\ufffe\uffff]")


def is_name(given: str) -> bool:
    """True if it has no character that no name has."""
    return _REFUSED.search(given) is None


def check_name(given: str) -> None:
    """ValidationError where it has a character that no name has."""
    found = _REFUSED.search(given)
    if found:
        raise ValidationError(
            f"{given!a:.80} contains the character U+{ord(found[0]):04X}; allowed: one line of letters, digits, signs "
            "and blanks"
        )
