"""Report of a preflight as texts of a page."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from typing import Any

STAGES = ("resolve", "connect", "protocol", "metadata", "infer", "shape", "space")
_MARKS = {"done": "✓", "failed": "✕", "waiting": "·"}


@dataclass(frozen=True, slots=True)
class StageRow:
    """Stage with its state "done", "failed" or "waiting", and the mark that shows it."""

    name: str
    state: str
    mark: str


@dataclass(frozen=True, slots=True)
class ReportView:
    """Texts of the page; empty texts and lists are not shown."""

    ok: bool
    stages: tuple[StageRow, ...]
    sentence: str
    advice: str
    latency: str
    rows: str
    policy: str
    calls: tuple[tuple[str, str], ...]
    metadata: tuple[tuple[str, str], ...]
    notes: tuple[str, ...]


def time_since(moment: datetime, now: datetime) -> str:
    """Return the time since `moment` in its largest unit."""
    seconds = max(0.0, (now - moment).total_seconds())
    for unit, length in (("d", 86400), ("h", 3600), ("min", 60)):
        if seconds >= length:
            return f"{int(seconds // length)} {unit} ago"
    return f"{int(seconds)} s ago"


def view_report(report: Mapping[str, Any] | None) -> ReportView | None:
    """Return the texts of a complete or redacted report; None without a report."""
    if report is None:
        return None
    return ReportView(
        ok=bool(report.get("ok")),
        stages=_stages(str(report.get("stage", "")), bool(report.get("ok"))),
        sentence=str(report.get("sentence", "")),
        advice=str(report.get("advice", "")),
        latency=_ms(report.get("latency_ms")),
        rows=_rows(report.get("chunk")),
        policy=", ".join(str(report[key]) for key in ("kind", "name", "endpoint") if report.get(key)),
        calls=tuple(_call(call) for call in report.get("calls", ())),
        metadata=tuple((str(key), str(value)) for key, value in report.get("metadata", {}).items()),
        notes=tuple(map(str, report.get("notes", ()))),
    )


def _stages(reached: str, ok: bool) -> tuple[StageRow, ...]:
    at = STAGES.index(reached) if reached in STAGES else -1
    states = [
        "done" if n < at or (n == at and ok) else "failed" if n == at else "waiting"
        for n in range(len(STAGES))
    ]
    return tuple(StageRow(name, state, _MARKS[state]) for name, state in zip(STAGES, states, strict=True))


def _ms(figure: Any) -> str:
    return f"{figure:.0f} ms" if isinstance(figure, int | float) else ""


def _rows(chunk: Any) -> str:
    if not isinstance(chunk, Mapping):
        return ""
    return (
        f"[{chunk['rows']}, {chunk['width']}] {chunk['mode']} {chunk['space']} at {chunk['rate']:g} Hz, "
        f"{chunk['seconds']:.2f} s"
    )


def _call(call: Mapping[str, Any]) -> tuple[str, str]:
    """Return the name of one call to the policy server, and the duration of the call with a note."""
    how = str(call["note"]) if call.get("note") else "" if call["ok"] else "failed"
    return str(call["name"]), _ms(call["ms"]) + (f" ({how})" if how else "")
