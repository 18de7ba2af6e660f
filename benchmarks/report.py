"""Result of a benchmark, as a table for people and as JSON for programs."""

from __future__ import annotations

import json
import operator
import os
import platform
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path

_COMPARE = {"<=": operator.le, "<": operator.lt, ">=": operator.ge, "==": operator.eq}


@dataclass(frozen=True, slots=True)
class Figure:
    """Number with its requirement, such as "<= 0.5"; the requirement is "" if the number is only reported."""

    name: str
    value: float
    unit: str
    wanted: str = ""

    @property
    def holds(self) -> bool | None:
        """Whether the value meets the requirement; None if there is no requirement."""
        if not self.wanted:
            return None
        sign, bound = self.wanted.split()
        return bool(_COMPARE[sign](self.value, float(bound)))


@dataclass(frozen=True, slots=True)
class Report:
    """Figures of one run, and the rows from which they were computed."""

    name: str
    figures: Sequence[Figure]
    rows: Sequence[Mapping[str, object]] = field(default_factory=list)

    def table(self) -> str:
        """Return the figures as a table."""
        width = max(len(figure.name) for figure in self.figures)
        marks = {True: "ok", False: "MISSED", None: ""}
        return "\n".join(
            f"{f.name:<{width}}  {f.value:>12.3f} {f.unit:<5} {f.wanted:<10} {marks[f.holds]}"
            for f in self.figures
        )

    def write(self, path: Path) -> None:
        """Write the report as JSON to a file."""
        path.write_text(self.json(), "utf-8")

    def json(self) -> str:
        """Return the report as JSON."""
        figures = [asdict(figure) | {"holds": figure.holds} for figure in self.figures]
        content = {"name": self.name, "machine": machine(), "figures": figures, "rows": list(self.rows)}
        return json.dumps(content, indent=1, default=str)


def machine() -> dict[str, object]:
    """Return the properties of the machine on which the figures were measured."""
    return {
        "cpus": os.cpu_count(),
        "load": os.getloadavg(),
        "kernel": platform.release(),
        "machine": platform.machine(),
        "python": platform.python_version(),
    }
