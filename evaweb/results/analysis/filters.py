"""Which trials of an evaluation are meant; in addresses of pages and of REST."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from typing import TypeVar
from urllib.parse import urlencode

from evaweb.errors import EvaError
from evaweb.results.analysis.outcomes import Interruption, Outcome

Run = TypeVar("Run", Outcome, Interruption)


@dataclass(frozen=True, slots=True)
class TrialFilter:
    """Scene, position, station and operator by name; "" where it does not matter."""

    scene: str = ""
    position: str = ""
    station: str = ""
    operator: str = ""

    @property
    def query(self) -> str:
        """As it stands in an address; "" where nothing is chosen."""
        return urlencode({name: value for name, value in asdict(self).items() if value})

    def apply(self, runs: Iterable[Run]) -> list[Run]:
        """Those that fit."""
        return [
            run
            for run in runs
            if self.scene in ("", run.scene)
            and self.position in ("", str(run.position))
            and self.station in ("", run.station)
            and self.operator in ("", run.operator)
        ]


def parse_filter(given: Mapping[str, str], runs: Iterable[Outcome]) -> TrialFilter:
    """The filters of an address; EvaError says what there is where one names what the trials do not have."""
    found = TrialFilter(
        **{name: given.get(name, "").strip() for name in ("scene", "position", "station", "operator")}
    )
    known = filter_choices(runs)
    for name, value in asdict(found).items():
        if value and value not in known[name]:
            raise EvaError(f"{name} = {value!r:.80}; allowed: {', '.join(known[name]) or 'none yet'}")
    return found


def filter_choices(runs: Iterable[Outcome]) -> dict[str, list[str]]:
    """Values that can be chosen of each field."""
    given = list(runs)
    positions = sorted({run.position for run in given})
    return {
        "scene": sorted({run.scene for run in given}),
        "position": [str(number) for number in positions],
        "station": sorted({run.station for run in given}),
        "operator": sorted({run.operator for run in given}),
    }
