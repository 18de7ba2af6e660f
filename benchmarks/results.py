"""Result pages with 100,000 trials of 200 evaluations, exports, concurrent allocation, and the stopping rule.

All are measured on SQLite, and on PostgreSQL if its programs and a driver are installed, with a server in a temporary
folder.
"""

from __future__ import annotations

import json
import math
import os
import random
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from benchmarks.report import Figure, Report
from benchmarks.servers import postgresql, why_no_postgresql
from evaweb.statistics.sequential import success_evidence

PLANS, TRIALS = 200, 100_000
RATES = (0.5, 0.8, 0.3)
RUNS = 2000  # runs of the stopping rule at each rate
PAIRS = 100
FIRST_LOOK = 10  # first pair after which the peeking reader tests
ALPHA = 0.05
PAGES = (
    "dashboard",
    "evaluations",
    "results",
    "comparison",
    "evidence",
    "trials",
    "all_trials",
    "export",
    "export_statistics",
)
WANTED_MS, MOST_QUERIES = 200, 53
MANY_PLANS, MANY_TRIALS, COPIES = 42, 21_000, 50  # together a million trials
MANY_WANTED_MS = {"all_trials": 500, "dashboard": 500}  # pages over all trials
_ROOT = Path(__file__).parents[1]


def measure(
    seconds: float, plans: int = PLANS, trials: int = TRIALS, runs: int = RUNS, long: bool = False
) -> Report:
    """Return all figures; with `long` also those of a million trials, on PostgreSQL.

    `seconds` is ignored, because the amount of work is fixed.
    """
    figures = list(rule_figures(runs))
    rows: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as folder:
        rows.append(_measured(Path(folder) / "sqlite", {}, plans, trials))
        missing = why_no_postgresql()
        if missing:
            print(f"not measured on PostgreSQL: {missing}", file=sys.stderr)
        else:
            with postgresql(Path(folder) / "postgresql") as store:
                rows.append(_measured(Path(folder) / "web", {"DATABASE_URL": store.url}, plans, trials))
            if long:
                with postgresql(Path(folder) / "million") as store:
                    data = Path(folder) / "web_million"
                    measured = _measured(data, {"DATABASE_URL": store.url}, MANY_PLANS, MANY_TRIALS, COPIES)
                    rows.append(measured | {"database": "million"})
    for row in rows:
        figures += database_figures(row)
    figures.append(Figure("export_rows_per_s", rows[0]["exports"]["evaluation_csv"], "1/s"))
    return Report("results", figures, rows)


def _measured(
    data: Path, environment: dict[str, str], plans: int, trials: int, copies: int = 1
) -> dict[str, Any]:
    """Return the results on one database, which a separate program measures."""
    data.mkdir()
    out = data / "out.json"
    counts = {"--plans": plans, "--trials": trials, "--copies": copies}
    arguments = [
        "-m",
        "benchmarks.results_pages",
        str(out),
        *(str(word) for pair in counts.items() for word in pair),
    ]
    variables = os.environ | {"EVA_DATA_DIR": str(data), "EVA_LOG_LEVEL": "ERROR"} | environment
    if "DATABASE_URL" not in environment:
        variables.pop("DATABASE_URL", None)
    subprocess.run([sys.executable, *arguments], cwd=_ROOT, env=variables, check=True)
    figures: dict[str, Any] = json.loads(out.read_text("utf-8"))
    return figures


def database_figures(row: dict[str, Any]) -> Iterator[Figure]:
    """Yield the figures that were measured on one database."""
    name = row["database"]
    for page in PAGES:
        timings = row["pages"][page]
        yield Figure(f"page_p50_ms.{page}.{name}", timings["p50"], "ms")
        allowed = MANY_WANTED_MS.get(page, WANTED_MS) if name == "million" else WANTED_MS
        yield Figure(f"page_p95_ms.{page}.{name}", timings["p95"], "ms", f"<= {allowed}")
        yield Figure(f"page_first_p95_ms.{page}.{name}", timings["cold_p95"], "ms")
        yield Figure(f"queries.{page}.{name}", timings["queries"], "", f"<= {MOST_QUERIES}")
    for label, rate in row["exports"].items():
        yield Figure(f"export_rows_per_s.{label}.{name}", rate, "1/s")
    handing = row["handing"]
    for label in ("left", "twice", "codes_twice", "out_of_order"):
        yield Figure(f"handing.{label}.{name}", handing[label], "", "== 0")
    yield Figure(f"handing.locked.{name}", handing["locked"], "")
    yield Figure(f"handing.p95_ms.{name}", handing["p95_ms"], "ms")
    for label, value in row["planner"].items():
        yield Figure(f"planner.{label}.{name}", value, "ms" if label.endswith("ms") else "")


def rule_figures(runs: int) -> Iterator[Figure]:
    """Yield how often equal checkpoints are declared different.

    This is given for the stopping rule, and for comparison for a reader who tests for a difference at every look.
    """
    for rate in RATES:
        chance = random.Random(f"{rate}")
        false_positives = naive = 0
        for _ in range(runs):
            pairs = [(chance.random() < rate, chance.random() < rate) for _ in range(PAIRS)]
            false_positives += success_evidence(pairs, ALPHA).stop is not None
            naive += _peeked(pairs)
        yield Figure(f"false_positive_rate.{rate:g}", false_positives / runs, "", f"<= {ALPHA}")
        yield Figure(f"naive_false_positive_rate.{rate:g}", naive / runs, "")


def _peeked(pairs: list[tuple[bool, bool]]) -> bool:
    """Return True if a fixed-size test of two pooled proportions is significant at any of the looks."""
    x1 = x2 = 0
    for n, (left, right) in enumerate(pairs, start=1):
        x1, x2 = x1 + left, x2 + right
        pooled = (x1 + x2) / (2 * n)
        spread = math.sqrt(2 * pooled * (1 - pooled) / n)
        if n >= FIRST_LOOK and spread and math.erfc(abs(x1 - x2) / n / spread / math.sqrt(2)) <= ALPHA:
            return True
    return False
