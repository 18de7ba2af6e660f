"""Report of a plan: pages, data, and the program that recomputes them; usable offline and without EVA Web."""

from __future__ import annotations

import json
import shutil
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from datetime import datetime
from pathlib import Path
from typing import Any

from django.contrib.staticfiles import finders
from django.template.loader import render_to_string
from django.utils import timezone

from evaweb.core.errors import EvaError
from evaweb.core.tabular_export import iter_csv
from evaweb.plans.counting import ENDS, declared_failures
from evaweb.plans.design import compared
from evaweb.plans.models import CountsAs, Plan, PlanState
from evaweb.results.analysis.arm import COLUMNS as ARM_COLUMNS
from evaweb.results.analysis.integrity import checkpoint_changes
from evaweb.results.presentation import facts, listings
from evaweb.results.presentation.drawings import time_courses
from evaweb.results.presentation.drawings.svg import restart_numbering
from evaweb.results.presentation.figures import draw_arms
from evaweb.results.presentation.integrity import delays_banner
from evaweb.results.presentation.plan_result import PlanResult
from evaweb.results.presentation.setting import setting_of
from evaweb.results.reports import bench_photos as laid_out
from evaweb.results.reports.checklist import checklist
from evaweb.results.reports.tables import COLUMNS, JUDGED, SCORE_COLUMNS, outcome_pages, score_pages
from evaweb.statistics.designs import estimated, findings
from evaweb.statistics.difference import Difference
from evaweb.trials.failures import ordered_terms
from runtime.core.sentences import Pattern

_NOT_EMPTY_NAME_NEW_FOLDER = Pattern(
    "results.reports.reporting.not_empty_name_new_folder",
    "{out} is not empty: name a new folder, so that reports are not mixed",
)
_DRAFT_THERE_NOTHING_REPORT_BEFORE = Pattern(
    "results.reports.reporting.draft_there_nothing_report_before",
    "{plan} is a draft: there is nothing to report before it is frozen",
)
_STYLE_SHEET_NOT_WHERE_INSTALLED = Pattern(
    "results.reports.reporting.style_sheet_not_where_installed",
    "the style sheet {name} is not where it was installed",
)

_STYLES = (
    *("css/tokens.css", "css/base.css", "css/card.css", "css/table.css", "css/chip.css"),
    *("result/result.css", "result/figures.css", "result/plans.css"),
)
MOST_LINES = 1000  # lines per list on the report's page; its data are complete
_PROGRAM = Path(__file__).parent / "recompute"


def write_report(
    plan: Plan, out: Path, *, most_pictures: int | None = None, written_at: datetime | None = None
) -> Path:
    """Write the report to the new folder `out`, and return its first page.

    Args:
        plan: A plan that is frozen or later.
        out: Folder, created if it does not exist.
        most_pictures: Limit of bench images [bytes]; None for all.
        written_at: Time that the report states; None for the present.

    Raises:
        EvaError: If the folder is not empty, or the plan is a draft.
    """
    if out.exists() and any(out.iterdir()):
        raise EvaError(_NOT_EMPTY_NAME_NEW_FOLDER(out=out))
    if plan.state == PlanState.DRAFT:
        raise EvaError(_DRAFT_THERE_NOTHING_REPORT_BEFORE(plan=plan))
    result = PlanResult(plan)
    data = out / "data"
    data.mkdir(parents=True, exist_ok=True)
    _json(data / "plan.json", plan.document or {})
    _json(data / "seal.json", plan_seal(plan))
    _json(data / "numbers.json", report_numbers(result))
    _json(data / "integrity.json", result.conduct)
    _csv(data / "trials.csv", list(COLUMNS), outcome_pages(result))
    _csv(data / "scores.csv", SCORE_COLUMNS, score_pages(plan))
    for name, (columns, rows) in JUDGED.items():
        _csv(data / f"{name}.csv", columns, iter([rows(plan)]))
    _csv(data / "laid_out.csv", laid_out.COLUMNS, laid_out.with_json_regions(laid_out.layout_rows(plan)))
    left = laid_out.write_pictures(plan, data / "pictures", most_pictures)
    shutil.copytree(_PROGRAM, out / "recompute", ignore=shutil.ignore_patterns("__pycache__"))
    (out / "recompute" / "page.css").write_text(_styles(), "utf-8")
    page = out / "index.html"
    with restart_numbering():
        context = report_context(result)
    context |= {
        **({"made": written_at} if written_at else {}),
        "record": result.conduct,
        "banner": delays_banner(result.conduct),
        "most": MOST_LINES,
        "benches": _bench_images(plan, data / "pictures"),
        "left": left,
    }
    page.write_text(render_to_string("results/report.html", context), "utf-8")
    return page


def report_numbers(result: PlanResult) -> dict[str, Any]:
    """Return every number of the report that the program recomputes."""
    preferred = result.preferences
    text_fields = ("reason", "groups")
    return {
        **result.analysis.document,
        "planned": planned_document(result),
        "agreement": result.agreement,
        "judges": result.judges,
        "preferences": preferred
        and {name: value for name, value in preferred.items() if name not in text_fields},
    }


def planned_document(result: PlanResult) -> list[dict[str, Any]]:
    """Return the conclusion of the plan's design for each comparison."""
    design, blocks = result.design, result.blocks
    if design is None:
        return []
    return [
        {
            "first": names[0],
            "second": names[1],
            "blocks": conclusion.blocks,
            "at": conclusion.ended_at_pair,
            "winner": {"first": names[0], "second": names[1], None: None}[conclusion.winner],
            "p": conclusion.p,
            "estimate": _estimate(estimated(design, blocks, pair, conclusion)),
        }
        for names, pair, conclusion in zip(
            compared(result.plan.document or {}),
            design.comparisons,
            findings(design, blocks).each,
            strict=True,
        )
    ]


def _estimate(difference: Difference | None) -> list[float] | None:
    return (
        None if difference is None else [difference.value, difference.interval.low, difference.interval.high]
    )


def plan_seal(plan: Plan) -> dict[str, Any]:
    """Return the plan's digest and commitment, and the record of its reveal.

    The key of the commitment is included if the plan was revealed or the record exists; otherwise `key` is "".
    """
    visible = plan.state == PlanState.REVEALED or plan.at_reveal is not None
    return {
        "digest": plan.digest,
        "commitment": plan.commitment,
        "key": bytes(plan.key or b"").hex() if visible else "",
        "at_reveal": plan.at_reveal,
    }


def report_context(result: PlanResult) -> dict[str, Any]:
    """Return the context of the report's page; its figures have no links, because the report has no other pages."""
    plan, analysis = result.plan, result.analysis
    primaries, order = result.primaries, {arm.checkpoint: arm.series for arm in analysis.arms}
    return {
        "plan": plan,
        "document": plan.document,
        "seal": plan_seal(plan),
        "analysis": analysis,
        "styles": _styles(),
        "made": timezone.now(),
        "setting": setting_of(plan),
        "ends": _ends(plan.document or {}),
        "changes": checkpoint_changes(plan),
        "headline": result.headline,
        "primaries": [facts.comparison_facts(result, comparison) for comparison in primaries],
        "columns": ARM_COLUMNS,
        "table": listings.arm_rows(result),
        "others": [
            (comparison, facts.comparison_sentence(analysis, comparison))
            for comparison in analysis.comparisons
            if comparison not in primaries
        ],
        **draw_arms(analysis.arms, analysis.letters, lambda **named: "", mixed=True),
        "failures": listings.failure_tables(analysis, ordered_terms(), lambda **named: ""),
        "evidence": [
            time_courses.draw_evidence(
                comparison.evidence,
                comparison.first,
                comparison.second,
                drawn=(order[comparison.first], order[comparison.second]),
            )
            for comparison in primaries
            if comparison.pairs and comparison.evidence
        ],
        "agreement": result.agreement,
        "judges": result.judges,
        "preferences": result.preferences,
        "checklist": checklist(result),
        "runs": result.runs.outcomes,
        "declared": declared_failures(plan),
    }


def _ends(document: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Return (kind of abnormal end, what it counts as) as texts, for each kind that the plan decides."""
    counts_as = document.get("counts_as", {})
    return [(label, CountsAs(counts_as[name]).label) for name, label in ENDS.items() if name in counts_as]


def _bench_images(plan: Plan, folder: Path) -> dict[int, list[dict[str, Any]]]:
    """Return by trial the images of its cameras that are in the report."""
    stems = {path.stem for path in folder.glob("*.jpg")}
    by_trial: dict[int, list[dict[str, Any]]] = defaultdict(list)
    for row in (row for page in laid_out.layout_rows(plan) for row in page):
        if row["picture"] in stems:
            reference = row["reference"] if row["reference"] in stems else ""
            by_trial[row["trial"]].append({**row, "reference": reference})
    return dict(by_trial)


def _styles() -> str:
    return "\n".join(_style(name) for name in _STYLES)


def _style(name: str) -> str:
    path = finders.find(name)
    if not isinstance(path, str):
        raise EvaError(_STYLE_SHEET_NOT_WHERE_INSTALLED(name=name))
    return Path(path).read_text("utf-8")


def _json(path: Path, content: Mapping[str, Any]) -> None:
    path.write_text(json.dumps(content, indent=1, ensure_ascii=False, default=_time) + "\n", "utf-8")


def _time(value: datetime) -> str:
    return value.isoformat()


def _csv(path: Path, columns: Sequence[str], rows: Iterator[list[dict[str, Any]]]) -> None:
    with path.open("w", encoding="utf-8", newline="") as file:
        file.writelines(iter_csv(columns, rows))
