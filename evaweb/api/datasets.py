"""Datasets of the data folder, our own and others': properties, episodes, and operations."""

from __future__ import annotations

from datetime import datetime
from typing import Any
from uuid import UUID

from django.http import HttpRequest
from ninja import Router, Schema, Status

from evaweb.api.jobs import JobOut
from evaweb.api.responses import FAILURES
from evaweb.core.errors import Conflict
from evaweb.datasets import dataset_jobs, dataset_orders, episode_list
from evaweb.datasets.overview import Overview, overview, overviews
from runtime.recording.files import RecordingError

router = Router(tags=["datasets"])


class CheckOut(Schema):
    """Findings of the newest check; `remarks` are not damage; `fresh` is false if the dataset has changed since."""

    at: datetime
    problems: list[str]
    remarks: list[str]
    fresh: bool


class DatasetOut(Schema):
    """One dataset, named by its folder relative to the data folder. With a `problem` all other fields are empty."""

    name: str
    version: str
    robot: str
    fps: float
    episodes: int
    frames: int
    tasks: int
    cameras: list[str]
    size: int
    problem: str
    check: CheckOut | None

    @staticmethod
    def of(found: Overview) -> dict[str, Any]:
        """Return the dataset with the findings of its newest check."""
        own = [name for name in DatasetOut.model_fields if name != "check"]
        checked = None if found.problem else dataset_jobs.latest_check(found.name)
        check = checked and {name: getattr(checked, name) for name in CheckOut.model_fields}
        return {**{name: getattr(found, name) for name in own}, "check": check}


class DatasetEpisodeOut(Schema):
    """One episode of a dataset; `uuid` is that of its recording, null if it was not recorded by this lab."""

    index: int
    rows: int
    seconds: float
    task: str
    uuid: UUID | None
    success: bool | None
    result: str
    verdict: str

    @staticmethod
    def of(row: episode_list.DatasetRow) -> dict[str, Any]:
        """Return the episode as listed in the dataset, with the lab's newest verdict."""
        plain = ("index", "seconds", "task", "success", "result", "verdict")
        return {**{name: getattr(row, name) for name in plain}, "rows": row.length, "uuid": row.uuid or None}


@router.get("", response={200: list[DatasetOut], **FAILURES}, summary="Datasets", url_name="datasets")
def datasets(request: HttpRequest) -> Any:
    """Return all datasets below the data folder, sorted by name."""
    return [DatasetOut.of(row) for row in overviews()]


@router.get("/one", response={200: DatasetOut, **FAILURES}, summary="One dataset", url_name="dataset")
def dataset(request: HttpRequest, name: str) -> Any:
    """Return a dataset by its name; for a dataset in the folder `datasets/`, the name without `datasets/` is enough."""
    return DatasetOut.of(overview(dataset_orders.full_name(name)))


@router.get(
    "/episodes",
    response={200: list[DatasetEpisodeOut], **FAILURES},
    summary="Episodes of a dataset",
    url_name="dataset-episodes",
)
def episodes(
    request: HttpRequest, name: str, words: str = "", success: str = "", result: str = "", verdict: str = ""
) -> Any:
    """Return the episodes of a dataset, sorted by index.

    `success` is yes, no or unknown, `result` success, partial, fail or unknown, `verdict` pass, fail or unreviewed.
    """
    only = {"words": words, "success": success, "result": result, "verdict": verdict}
    try:
        rows = episode_list.list_rows(dataset_orders.full_name(name), **only)
    except RecordingError as error:
        raise Conflict(str(error)) from None
    return [DatasetEpisodeOut.of(row) for row in rows]


@router.post(
    "/jobs",
    response={202: JobOut, **FAILURES},
    summary="Have something done",
    url_name="dataset-jobs",
)
def ask(request: HttpRequest, given: dataset_orders.Order) -> Any:
    """Queue a check, repair, conversion, import, merge, split or export as MCAP.

    Only administrators may delete, push and pull. Push and pull use the Hugging Face token that the user has stored
    under Your account, else the lab's account. The job reports the progress. MCAP files are then downloaded
    episode by episode, for a day.
    """
    return Status(202, dataset_orders.submit_order(user=request.auth, given=given.model_dump()))
