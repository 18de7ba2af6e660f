"""Facts that are recorded at a plan's reveal, so that its reports show later changes.

They are recorded in addition to the blocks that count.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from datetime import datetime
from typing import Any

from evaweb.core.canonical_json import digest
from evaweb.core.tabular_export import plain
from evaweb.plans.design import register_reveal_data
from evaweb.plans.models import Plan
from evaweb.results.presentation.plan_result import PlanResult
from evaweb.results.presentation.setting import setting_now
from evaweb.results.reports.tables import JUDGED, SCORE_COLUMNS, outcome_pages, score_pages
from evaweb.trials.models import TrialStatus

# Columns of an attempt in the report's table; recompute/record.py has the same.
ATTEMPT = (
    *("trial", "uuid", "order", "code", "slot", "block", "checkpoint", "scene", "position", "repetition"),
    *("attempt", "why_again", "station", "operator", "started_at", "ended_at"),
)
MEASURED = ("trial", "duration_s", "ended_by", "frames")
STAYS = ("looks", "voids", "cameras")  # parts of the integrity document
LOOKED_AT = ("smoothness", "smoothness_commanded")  # computed from a recording by the worker


def record_to_seal(plan: Plan) -> dict[str, Any]:
    """Return headline, setting and caveats as texts, and digests of attempts, scores, measurements and judgements."""
    result = PlanResult(plan)
    rows = [row for page in outcome_pages(result) for row in page]
    return {
        "headline": list(result.headline.all_sentences) if result.headline else [],
        "caveats": result.caveats,
        "setting": setting_now(plan),
        "record": digest({"attempts": list(_attempts(rows)), "scores": list(_scores(plan))}),
        "measured": _measured(rows),
        "judged": digest(_judged(plan)),
        "conduct": digest(_conduct(result)),
    }


def _measured(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return a dict that identifies the measurements of all runs.

    Key "digest" is a digest of the values. Key "names" lists the names of the measurements. Key "later" lists the
    trials whose recordings have not been analysed yet: of these trials, the digest covers only the measurements that
    need no recording.
    """
    later = [row["trial"] for row in rows if any(row[name] is None for name in LOOKED_AT)]
    values = [
        [
            *(plain(row[name]) for name in MEASURED),
            *(() if row["trial"] in later else (plain(row[name]) for name in LOOKED_AT)),
        ]
        for row in rows
    ]
    return {"digest": digest(values), "later": later, "names": list(MEASURED)}


def _judged(plan: Plan) -> dict[str, list[list[str]]]:
    return {
        name: [[plain(row[c]) for c in columns] for row in rows(plan)]
        for name, (columns, rows) in JUDGED.items()
    }


def _conduct(result: PlanResult) -> dict[str, Any]:
    """Return the parts of the integrity document that later corrections do not change, as JSON."""
    conduct: dict[str, Any] = json.loads(
        json.dumps({name: result.conduct[name] for name in STAYS}, default=datetime.isoformat)
    )
    return conduct


def _attempts(rows: Sequence[Mapping[str, Any]]) -> Iterator[list[str]]:
    """Yield one row of texts for each attempt: its values of the columns in ATTEMPT, then why it was voided.

    The last text is "" for an attempt that was not voided. Reasons for other states are left out, because they may
    change when an attempt is scored later.
    """
    for row in rows:
        voided = row["status"] == TrialStatus.VOIDED
        yield [*(plain(row[name]) for name in ATTEMPT), row["reason"] if voided else ""]


def _scores(plan: Plan) -> Iterator[list[str]]:
    for page in score_pages(plan):
        yield from ([plain(row[name]) for name in SCORE_COLUMNS] for row in page)


register_reveal_data(record_to_seal)
