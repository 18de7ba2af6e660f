"""What pages and REST show of an imported crate; rates are computed here from its counts."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from evaweb.results.crates.licenses import LICENSES, license_address
from evaweb.results.models import ImportedCrate
from evaweb.statistics.proportions import Proportion, proportion


@dataclass(frozen=True, slots=True)
class ShownCrate:
    """Imported crate as shown; `hidden` leaves only the facts of its import.

    `arms` are (checkpoint, success rate with its Wilson interval), the best rate first.
    """

    crate: ImportedCrate
    hidden: bool
    content: dict[str, Any]
    arms: list[tuple[str, Proportion]]
    license: str

    @property
    def title(self) -> str:
        """Name of the crate, or of its plan if it has none; "" if it is hidden."""
        if self.hidden:
            return ""
        return str(self.content["origin"]["name"] or self.content["plan"]["title"])


def shown_crate(crate: ImportedCrate, hidden: bool) -> ShownCrate:
    """Return a crate as shown."""
    if hidden:
        return ShownCrate(crate, True, {}, [], "")
    content = crate.content
    arms = [(arm["checkpoint"], proportion(arm["successes"], arm["n"])) for arm in content["arms"]]
    arms.sort(key=lambda arm: (-(arm[1].rate or 0.0), arm[0]))
    address = content["origin"]["license"]
    known = next((id for id in LICENSES if address == license_address(id)), "")
    return ShownCrate(crate, False, content, arms, known or address)
