"""Policy protocols and transports: round trips of the protocols, and delays of observations through each transport.

See `benchmarks.wires_policies` and `benchmarks.wires_transports` for the methods. If software is missing, there is no
measurement, and the row states the reason.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from typing import Any

from benchmarks import wires_policies, wires_transports
from benchmarks.report import Figure, Report

SECONDS = 5.0
_RATIO = "<= 1.1"  # equally fast; runs differ by up to a tenth
_GROWTH = "<= 10"  # [MB] in ten minutes; retaining one image in two hundred would exceed it


def measure(seconds: float) -> Report:
    """Measure all policy protocols and all transports.

    The figures include `roundtrip_*_ms.PROTOCOL`, `ratio_to_openpi_client` and `age_*_ms.TRANSPORT`.
    """
    rows = [*wires_policies.measure(seconds), *wires_transports.measure(seconds)]
    for row in rows:
        for key in ("absent", "peer_absent"):
            if key in row:
                print(
                    f"not measured: {row.get('protocol') or row.get('transport')}: {row[key]}",
                    file=sys.stderr,
                )
    return report(rows)


def report(rows: Sequence[Mapping[str, Any]]) -> Report:
    """Return the report of these rows."""
    figures: list[Figure] = []
    for row in rows:
        if "absent" not in row:
            figures += _protocol(row) if "protocol" in row else _transport(row)
    return Report("wires", figures, rows)


def _protocol(row: Mapping[str, Any]) -> list[Figure]:
    name, peer = row["protocol"], row.get("peer")
    figures = [
        *_round_trip(name, row),
        Figure(f"request_bytes.{name}", row["request_bytes"], "B"),
        Figure(f"answer_bytes.{name}", row["answer_bytes"], "B"),
    ]
    if peer is None:
        return figures
    return [
        *figures,
        *_round_trip("openpi_client", peer),
        Figure("ratio_to_openpi_client", row["ratio"], "", _RATIO),
        Figure("cpu_ratio_to_openpi_client", row["cpu_ms"] / peer["cpu_ms"], ""),
    ]


def _round_trip(name: str, row: Mapping[str, Any]) -> list[Figure]:
    return [
        *(Figure(f"roundtrip_{q}_ms.{name}", value, "ms") for q, value in row["round_trip_ms"].items()),
        Figure(f"cpu_ms_per_request.{name}", row["cpu_ms"], "ms"),
    ]


def _transport(row: Mapping[str, Any]) -> list[Figure]:
    name = row["transport"]
    return [
        Figure(f"cpu_percent.{name}", row["cpu_percent"], "%"),
        *(Figure(f"age_{q}_ms.{name}", value, "ms") for q, value in row["age_ms"].items()),
        Figure(f"observation_hz.{name}", row["observation_hz"], "Hz"),
        *([Figure(f"idle_minutes.{name}", row["idle_minutes"], "min")] if "idle_minutes" in row else []),
        *([Figure(f"growth_mb.{name}", row["growth_mb"], "MB", _GROWTH)] if "growth_mb" in row else []),
    ]
