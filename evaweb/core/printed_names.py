"""Check of names that are printed on one line: on pages, in drawings, in files for other programs."""

from __future__ import annotations

import re

from django.core.exceptions import ValidationError

# Control characters and line ends; surrogates and other code points that XML forbids; bidirectional marks.
_REFUSED = re.compile("[\x00-\x1f\x7f-\x9f\u2028-\u202e\u2066-\u2069\ud800-\udfff\ufffe\uffff]")


def is_name(given: str) -> bool:
    """Return True if `given` contains no control, line-end, bidirectional or non-XML character."""
    return _REFUSED.search(given) is None


def check_name(given: str) -> None:
    """Raise ValidationError if `given` contains a character that a name must not have."""
    match = _REFUSED.search(given)
    if match:
        raise ValidationError(
            f"{given!a:.80} contains the character U+{ord(match[0]):04X}; allowed: one line of letters, digits, signs "
            "and blanks"
        )
