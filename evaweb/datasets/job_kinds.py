"""The job kind of datasets: executes orders and updates the rows of episodes."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path, PurePosixPath
from typing import Any

from django.conf import settings
from django.db.models.functions import Now

from evaweb.accounts.hub_tokens import load_hub_token
from evaweb.core.errors import EvaError
from evaweb.datasets.bags import bags_dir, check_mapping, find_bag
from evaweb.datasets.dataset_orders import KIND, least_for
from evaweb.datasets.episode_list import list_rows
from evaweb.datasets.overview import folder_named, get_dataset_folder
from evaweb.episodes.archive import use_videos
from evaweb.episodes.dataset_membership import sync_memberships
from evaweb.episodes.exports import MCAP, write_mcap
from evaweb.episodes.models import Subset
from evaweb.episodes.subsets import subset_get, subset_uuids
from evaweb.jobs.kinds import ORDERED_BY, Cancelled, JobContext, job_kind
from runtime.core.sentences import fixed
from runtime.datasets import layout
from runtime.recording.files import RecordingError

Found = dict[str, Any]
_NO_LOGIN = fixed(
    "datasets.job_kinds.no_login",
    "the worker has no login at the Hugging Face hub: enter your own token under Your account, and order it again, or "
    "start the lab with HF_TOKEN",
)
_READ = ("check", "push", "mcap", "propose")  # orders that change no dataset


@job_kind(KIND, least=lambda args: least_for(args["what"]))
def dataset(work: JobContext) -> Mapping[str, Any]:
    """Execute an order for datasets.

    The arguments of the job are a validated order of evaweb.datasets.dataset_orders. If the order is refused, the job
    still succeeds, with the result `done` False and the reason in `why`, because a retry would not change it.
    """
    try:
        work.hold(_names(work.args))
        result = _KINDS[work.args["what"]](work)
    except (RecordingError, EvaError) as fault:
        return {"done": False, "why": str(fault)}
    except Cancelled:  # the dataset may have changed before
        if work.args["what"] not in _READ:
            sync_memberships()
        raise
    if work.args["what"] not in _READ:
        result["problems"] = [*result.get("problems", ()), *sync_memberships()]
    return {"done": True, **result}


def _names(args: Mapping[str, Any]) -> list[str]:
    """Return the names of all datasets that an order reads or writes."""
    names = [*args.get("datasets", ()), *filter(None, (args.get("dataset"), args.get("to")))]
    if args["what"] == "split":
        names += [f"{args['to']}/{part}" for part in args["parts"]]
    if args["what"] == "import":  # its copy below datasets/
        names.append(f"datasets/{PurePosixPath(args['dataset']).name}")
    return names


def _check(work: JobContext) -> Found:
    from runtime.datasets.consistency import (
        check_with_remarks,
    )  # imported late: web processes import this module but never run the job

    work.report_progress("every file is compared with the metadata")
    result = check_with_remarks(_source(work))
    return {"problems": result.problems, "remarks": result.remarks}


def _repair(work: JobContext) -> Found:
    from runtime.datasets.operations import repair

    return {"problems": repair(_source(work))}


def _convert(work: JobContext) -> Found:
    from runtime.datasets.operations import convert

    args = work.args
    target = folder_named(args["to"])
    result = convert(
        _source(work),
        target,
        args["version"],
        rename=args["rename"],
        reencode=args["reencode"],
        tell=work.report_progress,
    )
    return _result(args["to"], result)


def _import(work: JobContext) -> Found:
    from evaweb.datasets.importing import import_dataset

    args = work.args
    result = import_dataset(
        _source(work), state=args["state"], robot=args["robot"], tell=work.report_progress
    )
    return {"dataset": result.dataset, "episodes": len(result.episodes), "made": result.made}


def _merge(work: JobContext) -> Found:
    from runtime.datasets.operations import merge

    args = work.args
    sources = [get_dataset_folder(name) for name in args["datasets"]]
    target = folder_named(args["to"])
    result = merge(sources, target, args["version"], reencode=args["reencode"], tell=work.report_progress)
    return _result(args["to"], result)


def _split(work: JobContext) -> Found:
    from runtime.datasets.operations import split

    args = work.args
    targets = {folder_named(f"{args['to']}/{part}"): which for part, which in args["parts"].items()}
    results = split(
        _source(work), targets, args["version"], reencode=args["reencode"], tell=work.report_progress
    )
    parts = [_result(f"{args['to']}/{result.dataset.name}", result) for result in results]
    return {"datasets": [part["dataset"] for part in parts], "parts": parts}


def _delete(work: JobContext) -> Found:
    from runtime.datasets.operations import delete

    args = work.args
    result = delete(
        _source(work),
        args["episodes"],
        reencode=args["reencode"],
        known=args["known"],
        tell=work.report_progress,
    )
    return _result(args["dataset"], result)


def _push(work: JobContext) -> Found:
    from runtime.datasets.hub import has_login, push

    args = work.args
    token, name = load_hub_token(person=args.get(ORDERED_BY), account=args.get("account", ""))
    if token is None and not has_login():
        raise EvaError(_NO_LOGIN)
    address = push(
        _source(work),
        args["repository"],
        private=args["private"],
        licence=args.get("licence", ""),
        token=token,
        tell=work.report_progress,
    )
    return {"address": address, "account": name}


def _pull(work: JobContext) -> Found:
    from runtime.datasets.hub import pull

    args = work.args
    token, name = load_hub_token(person=args.get(ORDERED_BY), account=args.get("account", ""))
    pulled = pull(
        args["repository"],
        folder_named(args["to"]),
        revision=args["revision"],
        reserve=settings.EVA_RESERVE_BYTES,
        token=token,
        tell=work.report_progress,
    )
    rows = sum(listed.length for listed in pulled.episodes)
    return {"dataset": args["to"], "episodes": len(pulled.episodes), "frames": rows, "account": name}


def _mcap(work: JobContext) -> Found:
    """Write the MCAP files one after the other; those that are current stay as they are."""
    name, pictures = work.args["dataset"], work.args["pictures"]
    rows = list_rows(name)
    files, problems = 0, []
    for number, row in enumerate(rows, start=1):
        if row.recording is None:
            problems.append(f"episode {row.index} was not recorded by this lab")
            continue
        uuid = row.recording.uuid
        try:
            if MCAP[pictures].find(uuid) is None:
                use_videos(work, uuid, [name])
                write_mcap(uuid, pictures, _reporter(work, f"episode {number} of {len(rows)}"))
            files += 1
        except RecordingError as error:
            problems.append(f"episode {row.index}: {error}")
    return {"files": files, "episodes": len(rows), "problems": problems}


def _propose(work: JobContext) -> Found:
    import robots
    from runtime.interop.bag_mapping import propose_mapping, to_toml
    from runtime.interop.bag_reader import Bag

    work.report_progress("the topics are read")
    with Bag(find_bag(work.args["bag"])) as bag:
        mapping, missing = propose_mapping(bag, robots.load_robot(work.args["robot"]))
    return {"mapping": to_toml(mapping), "missing": missing}


def _bags(work: JobContext) -> Found:
    from runtime.interop.bag_import import import_bags

    args = work.args
    results = import_bags(
        [bags_dir() / name for name in args["bags"]],
        check_mapping(args["content"]),
        folder_named(args["to"]),
        report=work.report_progress,
        reserve=settings.EVA_RESERVE_BYTES,
    )
    imported = [result for result in results if not result.problem]
    named = list(zip(args["bags"], results, strict=True))
    return {
        **({"dataset": args["to"]} if imported else {}),
        "episodes": len(imported),
        "frames": sum(result.rows for result in imported),
        "problems": [f"{name}: {result.problem}" for name, result in named if result.problem],
        "remarks": [f"{name}: {remark}" for name, result in named for remark in result.remarks],
    }


def _subset(work: JobContext) -> Found:
    from runtime.datasets.operations import select

    args = work.args
    subset = subset_get(name=args["subset"])
    uuids = subset_uuids(subset=subset)
    result = select(
        _chosen(args["datasets"], uuids),
        folder_named(args["to"]),
        args["version"],
        reencode=args["reencode"],
        provenance={
            "name": subset.name,
            "description": subset.description,
            "query": subset.query,
            "created_at": subset.created_at.isoformat(),
            "episodes": len(uuids),
            "digest": subset.digest,
        },
        tell=work.report_progress,
    )
    Subset.objects.filter(pk=subset.pk).update(dataset=args["to"], published_at=Now())
    return _result(args["to"], result)


def _chosen(names: Sequence[str], uuids: Sequence[str]) -> dict[Path, list[str]]:
    """Return the episodes of each dataset. Raises: RecordingError if one is in none of them."""
    chosen: dict[Path, list[str]] = {}
    left = dict.fromkeys(uuids)
    for name in names:
        folder = get_dataset_folder(name)
        there = {str(line["uuid"]) for line in layout.read_lines(folder / layout.EVA_EPISODES)}
        if found := [uuid for uuid in left if uuid in there]:
            chosen[folder] = found
            left = {uuid: None for uuid in left if uuid not in there}
    if left:
        raise RecordingError(
            f"{len(left)} episodes of it are in none of {', '.join(names)} any more, such as {next(iter(left))}: "
            "publish them again"
        )
    return chosen


def _reporter(work: JobContext, words: str) -> Callable[[str], None]:
    return lambda progress: work.report_progress(f"{words}: {progress}")


_KINDS: Mapping[str, Callable[[JobContext], Found]] = {
    "check": _check,
    "repair": _repair,
    "convert": _convert,
    "import": _import,
    "merge": _merge,
    "split": _split,
    "delete": _delete,
    "push": _push,
    "pull": _pull,
    "mcap": _mcap,
    "propose": _propose,
    "import_bags": _bags,
    "subset": _subset,
}


def _source(work: JobContext) -> Path:
    return get_dataset_folder(work.args["dataset"])


def _result(name: str, written: Any) -> Found:
    """Return the job's result for an operation that wrote a dataset."""
    return {
        "dataset": name,
        "version": written.version,
        "episodes": written.episodes,
        "frames": written.frames,
        "encoded": list(written.encoded),
        "left_out": list(written.left_out),
    }
