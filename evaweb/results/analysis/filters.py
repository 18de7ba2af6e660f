"""Filters of an evaluation's trials, as used in addresses of pages and of REST."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from typing import TypeVar
from urllib.parse import urlencode

from evaweb.core.errors import EvaError
from evaweb.results.analysis.outcomes import Interruption, Outcome

Run = TypeVar("Run", Outcome, Interruption)


@dataclass(frozen=True, slots=True)
class TrialFilter:
    """Filter by scene, position, station and operator; "" matches all."""

    scene: str = ""
    position: str = ""
    station: str = ""
    operator: str = ""

    @property
    def query(self) -> str:
        """Query string of the filter; "" if it matches all."""
        return urlencode({name: value for name, value in asdict(self).items() if value})

    def apply(self, runs: Iterable[Run]) -> list[Run]:
        """Return the runs that match."""
        return [
            run
            for run in runs
            if self.scene in ("", run.scene)
            and self.position in ("", str(run.position))
            and self.station in ("", run.station)
            and self.operator in ("", run.operator)
        ]


def parse_filter(given: Mapping[str, str], runs: Iterable[Outcome]) -> TrialFilter:
    """Return the filter that the query of an address (`given`) describes.

    Raises:
        EvaError: If it names a value that the trials do not have.
    """
    found = TrialFilter(
        **{name: given.get(name, "").strip() for name in ("scene", "position", "station", "operator")}
    )
    known = filter_choices(runs)
    for name, value in asdict(found).items():
        if value and value not in known[name]:
            raise EvaError(f"{name} = {value!r:.80}; allowed: {', '.join(known[name]) or 'none yet'}")
    return found


def filter_choices(runs: Iterable[Outcome]) -> dict[str, list[str]]:
    """Return the values of each field that can be selected."""
    given = list(runs)
    positions = sorted({run.position for run in given})
    return {
        "scene": sorted({run.scene for run in given}),
        "position": [str(number) for number in positions],
        "station": sorted({run.station for run in given}),
        "operator": sorted({run.operator for run in given}),
    }
