"""Descriptions of the jobs of a dataset, and the result of its newest check."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

from django.db.models import Q

from evaweb.datasets.dataset_orders import KIND, key_of
from evaweb.datasets.overview import get_dataset_folder
from evaweb.jobs.models import Job, JobStatus
from evaweb.jobs.workers import waiting_for
from runtime.datasets import layout

SHOWN = 8  # jobs shown on a page
_VERBS = {
    "check": "Check",
    "repair": "Repair",
    "convert": "Convert",
    "import": "Import",
    "merge": "Merge",
    "split": "Split",
    "delete": "Delete",
    "push": "Push",
    "pull": "Pull",
    "mcap": "Export as MCAP",
    "propose": "Propose a mapping for",
    "import_bags": "Import",
    "subset": "Publish the subset",
}


@dataclass(frozen=True, slots=True)
class JobSummary:
    """Description of one job: title, state (waiting, running, done, refused, failed), and a message."""

    job: Job
    title: str
    state: str
    sentence: str
    made: tuple[str, ...] = ()  # datasets that the job has written

    @property
    def is_transient(self) -> bool:
        """Whether the state changes without user action, so that a page polls."""
        return self.state in ("waiting", "running")


@dataclass(frozen=True, slots=True)
class LatestCheck:
    """Result of the newest check; `fresh` is False if the dataset has changed since."""

    at: datetime
    problems: tuple[str, ...]
    remarks: tuple[str, ...]  # notable, but not damage
    fresh: bool


def jobs_of(name: str = "") -> list[JobSummary]:
    """Return the newest jobs of a dataset, or of all datasets."""
    rows = Job.objects.filter(kind=KIND)
    if name:
        rows = rows.filter(
            Q(args__dataset=name) | Q(args__to=name) | Q(args__datasets__icontains=f'"{name}"')
        )
    return [summarize_job(job) for job in rows[:SHOWN]]


def summarize_job(job: Job) -> JobSummary:
    """Return the description of a job."""
    args, result = job.args, job.result
    title = f"{_VERBS.get(args['what'], args['what'])} {_about(args)}"
    if job.status == JobStatus.DONE and not result.get("done"):
        return JobSummary(job, title, "refused", str(result.get("why", "")))
    if job.status == JobStatus.DONE:
        names = [result["dataset"]] if "dataset" in result else result.get("datasets", [])
        return JobSummary(job, title, "done", _sentence(args["what"], result), tuple(names))
    if job.status == JobStatus.FAILED:
        return JobSummary(job, title, "failed", job.error)
    if job.status == JobStatus.RUNNING:
        return JobSummary(job, title, "running", job.progress or "it has begun")
    reason = f"tried again in a moment: {job.error}" if job.error else "for the worker"
    return JobSummary(job, title, "waiting", waiting_for(job) or reason)


def _about(args: Mapping[str, Any]) -> str:
    sources = [name.removeprefix("datasets/") for name in args.get("datasets") or [args.get("dataset", "")]]
    about = args["repository"] if args["what"] == "pull" else ", ".join(sources)
    if args["what"] == "propose":
        return f"{args['bag']} and {args['robot']}"
    if args["what"] == "subset":
        return str(args["subset"])
    if args["what"] == "import_bags":
        about = args["bags"][0] if len(args["bags"]) == 1 else _counted(len(args["bags"]), "bag")
    if args.get("to"):
        return f"{about} to {args['to'].removeprefix('datasets/')}"
    if args["what"] == "delete":
        return f"{_counted(len(args['episodes']), 'episode')} of {about}"
    return f"{about} to {args['repository']}" if args["what"] == "push" else about


def _sentence(action: str, result: Mapping[str, Any]) -> str:
    problems = result.get("problems") or []
    if action in ("check", "repair"):
        return "whole" if not problems else f"{_counted(len(problems), 'problem')}: {problems[0]}"
    if action == "push":
        return str(result.get("address", "")) + _account_of(result)
    if action == "import":
        text = f"{_counted(result['episodes'], 'episode')} can be reviewed, {result['made']} new"
        return text + (f"; {problems[0]}" if problems else "")
    if action == "propose":
        missing = result["missing"]
        return missing[0] + (f"; {len(missing) - 1} more" if missing[1:] else "") if missing else "complete"
    if action == "import_bags":
        text = f"{_counted(result['episodes'], 'episode')}, {_counted(result['frames'], 'row')}"
        for name, sentences in (("problem", problems), ("gap", result["remarks"])):
            text += f"; {_counted(len(sentences), name)}: {sentences[0]}" if sentences else ""
        return text
    if action == "mcap":
        text = f"{result['files']} of {_counted(result['episodes'], 'episode')} as MCAP, for a day"
        return text + (f"; {_counted(len(problems), 'problem')}: {problems[0]}" if problems else "")
    parts = result.get("parts") or [result]
    episodes, rows = (sum(part[name] for part in parts) for name in ("episodes", "frames"))
    text = f"{_counted(episodes, 'episode')}, {_counted(rows, 'row')}"
    encoded = sum(len(part.get("encoded", ())) for part in parts)
    left = [thing for part in parts for thing in part.get("left_out", ())]
    text += f"; {_counted(encoded, 'video')} coded again" if encoded else ""
    text += f"; left out: {'; '.join(left)}" if left else ""
    text += _account_of(result) if action == "pull" else ""
    return text + (f"; {problems[0]}" if problems else "")


def _account_of(result: Mapping[str, Any]) -> str:
    """Return whose account on the hub was used; "" for a job of an earlier version."""
    if "account" not in result:
        return ""
    return f", with the token of {result['account']}" if result["account"] else ", with the lab's account"


def _counted(count: int, thing: str) -> str:
    return f"{count} {thing}{'' if count == 1 else 's'}"


def latest_check(name: str) -> LatestCheck | None:
    """Return the result of the newest finished check or repair of the dataset; None if there is none."""
    key = key_of("check", name, {})
    repaired = key_of("repair", name, {})
    job = Job.objects.filter(key__in=(key, repaired), status=JobStatus.DONE, result__done=True).first()
    if job is None or job.claimed_at is None or job.finished_at is None:
        return None
    changed = datetime.fromtimestamp((get_dataset_folder(name) / layout.INFO).stat().st_mtime, UTC)
    since = job.finished_at if job.args["what"] == "repair" else job.claimed_at
    messages = (tuple(job.result.get(name, ())) for name in ("problems", "remarks"))
    return LatestCheck(job.finished_at, *messages, fresh=changed <= since)
