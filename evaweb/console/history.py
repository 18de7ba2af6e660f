"""Statistics of the stations by day over the last week: throughput, policy latency, missed ticks, faults."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import date, timedelta
from statistics import median
from typing import Any

from django.utils import timezone

from evaweb.blinding.visibility import Visibility
from evaweb.episodes.manifest import CLOSED
from evaweb.episodes.models import Episode, EpisodeStatus
from evaweb.results.presentation.drawings.svg import (
    Drawing,
    Scale,
    drawing,
    element,
    line,
    number,
    ticks,
    words,
)
from evaweb.stations.models import Station

DAYS = 7
_BROKEN = (EpisodeStatus.INTERRUPTED, EpisodeStatus.FAILED)
_WIDTH, _HEIGHT, _LEFT, _TOP, _STEP = 260.0, 120.0, 40.0, 10.0, 30.0


@dataclass(slots=True)
class Day:
    """Statistics of a station's recordings of one day in the lab's time zone."""

    day: date
    runs: int = 0
    broken: int = 0
    seconds: float = 0.0
    ticks: int = 0
    missed: int = 0
    latencies_ms: list[float] = field(default_factory=list)

    @property
    def minutes(self) -> float | None:
        """Recorded time [min]; None without a recording."""
        return self.seconds / 60 if self.runs else None

    @property
    def latency_ms(self) -> float | None:
        """Median of the runs' median latencies [ms]; None if no policy was used."""
        return median(self.latencies_ms) if self.latencies_ms else None

    @property
    def missed_per_mille(self) -> float | None:
        """Missed ticks of the control loop per thousand; None without ticks."""
        return 1000 * self.missed / self.ticks if self.ticks else None


@dataclass(frozen=True, slots=True)
class History:
    """Figures of one station for the last week, day by day.

    `covered` is the number of recordings of blind trials, which are left out.
    """

    station: Station
    days: Sequence[Day]
    covered: int
    figures: Sequence[Drawing]


_MEASURES: tuple[tuple[str, str, Callable[[Day], float | None]], ...] = (
    ("Recordings", "", lambda day: day.runs or None),
    ("Recorded", "min", lambda day: day.minutes),
    ("Interrupted or failed", "", lambda day: float(day.broken) if day.runs else None),
    ("Policy's latency, median", "ms", lambda day: day.latency_ms),
    ("Ticks missed of 1,000", "", lambda day: day.missed_per_mille),
)


def histories(sight: Visibility) -> Iterator[History]:
    """Yield the history of every active station; one query covers all of them."""
    today = timezone.localdate()
    first = today - timedelta(days=DAYS - 1)
    days: dict[int, dict[date, Day]] = defaultdict(
        lambda: {day: Day(day) for day in (first + timedelta(days=n) for n in range(DAYS))}
    )
    covered: dict[int, int] = defaultdict(int)
    rows = Episode.objects.filter(status__in=CLOSED, started_at__gte=timezone.now() - timedelta(days=DAYS))
    named = ("station_id", "started_at", "status", "duration_s", "control", "policy")
    for station, began, status, seconds, control, policy, name, checkpoint in rows.values_list(
        *named, "checkpoint", "trial__checkpoint_id"
    ):
        day = days[station].get(timezone.localdate(began))
        if day is None:
            continue
        if name in sight.names or checkpoint in sight.checkpoints:
            covered[station] += 1
            continue
        _count(day, status, seconds, control, policy)
    for row in Station.objects.filter(active=True).order_by("name"):
        own = list(days[row.pk].values())
        yield History(row, own, covered[row.pk], [_bars(*measure, own) for measure in _MEASURES])


def _count(
    day: Day, status: str, seconds: float | None, control: Mapping[str, Any], policy: Mapping[str, Any]
) -> None:
    day.runs += 1
    day.broken += status in _BROKEN
    day.seconds += seconds or 0.0
    day.ticks += int(control.get("ticks") or 0)
    day.missed += int(control.get("missed") or 0)
    latency = (policy.get("latency_ms") or {}).get("p50")
    if latency is not None:
        day.latencies_ms.append(float(latency))


def _bars(title: str, unit: str, value: Callable[[Day], float | None], days: Sequence[Day]) -> Drawing:
    """Return a bar chart by day; a day without a value has no bar."""
    values = [value(day) for day in days]
    high = max((amount for amount in values if amount is not None), default=0.0) or 1.0
    axis = ticks(0.0, high, 2)
    top = axis[-1] if axis[-1] >= high else axis[-1] + (axis[1] - axis[0] if len(axis) > 1 else high)
    place = Scale(0.0, top, _TOP + _HEIGHT, _TOP)
    right = _LEFT + _STEP * len(days)
    parts = [line([(_LEFT, place(at)), (right, place(at))], "grid") for at in axis]
    parts += [words(_LEFT - 6, place(at) + 4, number(at), "end", "tick") for at in axis]
    for n, (day, amount) in enumerate(zip(days, values, strict=True)):
        x = _LEFT + _STEP * n
        parts.append(words(x + _STEP / 2, _TOP + _HEIGHT + 16, f"{day.day:%a}", "middle", "tick"))
        if amount:
            bar = {
                "x": x + 4,
                "y": place(amount),
                "width": _STEP - 8,
                "height": _TOP + _HEIGHT - place(amount),
            }
            parts.append(element("rect", class_="beam series-none", **bar))
    heading = f"{title} [{unit}]" if unit else title
    text = "; ".join(
        f"{day.day:%a} {'–' if amount is None else number(amount)}"
        for day, amount in zip(days, values, strict=True)
    )
    rows = [(f"{day.day:%Y-%m-%d}", amount) for day, amount in zip(days, values, strict=True)]
    size = (_WIDTH, _TOP + _HEIGHT + 24)
    return drawing(*size, heading, text, *parts, kind="history", columns=("day", "value"), rows=rows)
