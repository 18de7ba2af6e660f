"""ORCID iDs: identifiers of researchers, with a check digit (ISO 7064 MOD 11-2)."""

from __future__ import annotations

import re

from django.core.exceptions import ValidationError

from runtime.core.sentences import Pattern

_NO_ORCID = Pattern(
    "accounts.orcid.no_orcid", "{given!r:.60} is no ORCID iD; allowed: the form 0000-0002-1825-0097"
)
_WRONG_CHECK_DIGIT = Pattern(
    "accounts.orcid.wrong_check_digit", "{orcid} has a wrong check digit: a digit is mistyped"
)

ADDRESS = "https://orcid.org/"
_FORM = re.compile(r"\d{4}-\d{4}-\d{4}-\d{3}[\dX]", re.ASCII)


def parse_orcid(text: str) -> str:
    """Return an ORCID iD without its address, "" for an empty text. Raises: ValidationError if it is none."""
    bare = text.strip().removeprefix("http://orcid.org/").removeprefix(ADDRESS).upper()
    if bare:
        check_orcid(bare)
    return bare


def check_orcid(orcid: str) -> None:
    """Raise ValidationError if this is no ORCID iD: four groups of four digits with a correct check digit."""
    if not _FORM.fullmatch(orcid):
        raise ValidationError(_NO_ORCID(given=orcid))
    *digits, check = orcid.replace("-", "")
    total = 0
    for digit in digits:
        total = (total + int(digit)) * 2
    expected = (12 - total % 11) % 11
    if check != ("X" if expected == 10 else str(expected)):
        raise ValidationError(_WRONG_CHECK_DIGIT(orcid=orcid))
