"""What the exporter of a crate decides: licence, name, description, date, lab, and whether videos are included."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import date

from evaweb.core.errors import EvaError
from evaweb.core.printed_names import is_name
from evaweb.results.crates.licenses import require_license
from runtime.core.sentences import Pattern

_TOO_LONG = Pattern("results.crates.too_long", "{name} has {count} characters; allowed: at most {most}")
_ONE_LINE = Pattern(
    "results.crates.one_line",
    "{name} = {given!r:.60}; allowed: one line of letters, digits, signs and blanks",
)
_DATE_ALLOWED = Pattern(
    "results.crates.date_allowed", "date = {given!r:.40}; allowed: a day such as 2026-03-31, or none"
)

LONGEST = {"name": 200, "lab": 200, "description": 4000}  # [characters]


@dataclass(frozen=True, slots=True)
class CrateOptions:
    """Decisions of the exporter; "" stands for what follows from the plan.

    Attributes:
        license: SPDX identifier of the licence.
        name: Name of the crate.
        description: Description of the crate.
        lab: Name of the lab that publishes it.
        date: Day of publication, as in 2026-03-31.
        videos: Whether the videos of the trials that count are included.

    Raises:
        EvaError: If a value is not allowed.
    """

    license: str
    name: str = ""
    description: str = ""
    lab: str = ""
    date: str = ""
    videos: bool = False

    def __post_init__(self) -> None:
        require_license(self.license)
        for name, most in LONGEST.items():
            given = getattr(self, name)
            if len(given) > most:
                raise EvaError(_TOO_LONG(name=name, count=len(given), most=most))
            lines = given.replace("\r\n", "\n").split("\n") if name == "description" else [given]
            if not all(map(is_name, lines)):
                raise EvaError(_ONE_LINE(name=name, given=given))
        if self.date and not _is_day(self.date):
            raise EvaError(_DATE_ALLOWED(given=self.date))


def _is_day(text: str) -> bool:
    try:
        return date.fromisoformat(text).isoformat() == text
    except ValueError:
        return False
