"""Statistics of the scored trials, per scene and checkpoint."""

from __future__ import annotations

from typing import Any

from django.http import HttpRequest, HttpResponse
from ninja import Query, Router, Schema

from evaweb.api.responses import FAILURES
from evaweb.api.tables import Format, table_response
from evaweb.api.trials import Filters
from evaweb.blinding.visibility import visibility_for_request
from evaweb.trials import selectors
from evaweb.trials.selectors import StatisticsRow

router = Router(tags=["statistics"])


class StatisticsOut(Schema):
    """Summary of one checkpoint at one scene. Every rate comes with n and an interval; null if n is 0."""

    scene: str
    scene_title: str
    checkpoint: str
    n: int
    successes: int
    rate: float | None
    low: float | None
    high: float | None
    level: float | None
    mean_score: float | None
    median_duration_s: float | None
    smoothness: float | None
    smoothness_low: float | None
    smoothness_high: float | None
    smoothness_n: int
    to_score: int
    interrupted: int
    voided: int

    @staticmethod
    def of(row: StatisticsRow) -> dict[str, Any]:
        """Return the row as a dict without nested values, the same for JSON and CSV."""
        success, interval = row.summary.success, row.summary.success.interval
        smooth = row.summary.smoothness
        spread = smooth.interval if smooth else None
        return {
            "scene": row.scene.name,
            "scene_title": row.scene.title,
            "checkpoint": row.checkpoint.name,
            "n": success.n,
            "successes": success.successes,
            "rate": success.rate,
            "low": interval and interval.low,
            "high": interval and interval.high,
            "level": interval and interval.level,
            "mean_score": row.summary.mean_score,
            "median_duration_s": row.summary.median_duration_s,
            "smoothness": smooth and smooth.value,
            "smoothness_low": spread and spread.low,
            "smoothness_high": spread and spread.high,
            "smoothness_n": smooth.n if smooth else 0,
            "to_score": row.to_score,
            "interrupted": row.interrupted,
            "voided": row.voided,
        }


class Statistics(Schema):
    """All summaries, sorted by scene and checkpoint name, which is no ranking."""

    method: str
    items: list[StatisticsOut]


METHOD = (
    "success rate with Wilson 95 % interval over scored trials; voided and interrupted trials do not count; "
    "smoothness: mean SPARC of those that were recorded, with Student's 95 % interval"
)


@router.get(
    "",
    response={200: Statistics, **FAILURES},
    summary="Success per scene and checkpoint",
    url_name="statistics",
)
def statistics(request: HttpRequest, filters: Query[Filters], format: Format = "json") -> Any:
    """Return counts, success rates with Wilson 95 % intervals, mean scores, median durations and smoothness, also as
    CSV and Parquet.
    """
    rows = [
        StatisticsOut.of(row)
        for row in selectors.statistics(filters.chosen(), visibility_for_request(request))
    ]
    if format != "json":
        columns = {name: field.annotation for name, field in StatisticsOut.model_fields.items()}
        answer: HttpResponse = table_response(request, "statistics", columns, [rows], format)
        return answer
    return {"method": METHOD, "items": rows}
