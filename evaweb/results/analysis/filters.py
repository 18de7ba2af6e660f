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
        EvaError: If the query names a value that the trials do not have.
    """
    trial_filter = TrialFilter(
        **{name: given.get(name, "").strip() for name in ("scene", "position", "station", "operator")}
    )
    choices = filter_choices(runs)
    for name, value in asdict(trial_filter).items():
        if value and value not in choices[name]:
            raise EvaError(f"{name} = {value!r:.80}; allowed: {', '.join(choices[name]) or 'none yet'}")
    return trial_filter


def filter_choices(runs: Iterable[Outcome]) -> dict[str, list[str]]:
    """Return the values of each field that can be selected."""
    outcomes = list(runs)
    positions = sorted({run.position for run in outcomes})
    return {
        "scene": sorted({run.scene for run in outcomes}),
        "position": [str(number) for number in positions],
        "station": sorted({run.station for run in outcomes}),
        "operator": sorted({run.operator for run in outcomes}),
    }
