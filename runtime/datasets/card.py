"""Card of a dataset on a hub: what it contains and how it was collected, as YAML and Markdown."""

from __future__ import annotations

import html
import json
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Literal, get_args

from runtime.datasets import layout
from runtime.datasets.reader import Dataset

Licence = Literal[
    "", "cc-by-4.0", "cc-by-sa-4.0", "cc-by-nc-4.0", "cc0-1.0", "apache-2.0", "mit", "odbl", "other"
]
"""Licence by the hub's name; "" if none is granted."""
LICENCES = get_args(Licence)[1:]
_MOST_TASKS = 50  # named in a card
_COLLECTED = {
    "demonstration": "demonstrations: a person drove the robot",
    "rollout": "rollouts: a policy drove the robot",
    "imported": "imported from another dataset",
}
_RESULTS = {"success": "succeeded", "partial": "partly succeeded", "fail": "failed"}


def render_card(dataset: Dataset, title: str, licence: Licence = "") -> str:
    """Return the card of a dataset: YAML between lines of dashes, then Markdown.

    Only facts of the dataset's own files are stated; nothing
    names persons, stations or checkpoints.
    """
    lines = layout.read_lines(dataset.root / layout.EVA_EPISODES)
    parts = [
        _front_matter(dataset, licence),
        f"# {_plain(title)}",
        _summary(dataset),
        "## Columns",
        *_columns(dataset),
        *_cameras(dataset),
        "## Tasks",
        *_tasks(dataset),
        "## How it was collected",
        *_collected(lines, len(dataset.episodes)),
        "## Results",
        *_results(lines, len(dataset.episodes)),
        "## Licence",
        f"`{licence}`" if licence else "No licence is granted: ask whoever owns the dataset.",
    ]
    return "\n\n".join(parts) + "\n"


def _front_matter(dataset: Dataset, licence: Licence) -> str:
    """Return the YAML that the hub reads; its values are JSON, which is YAML too."""
    robot = str(dataset.info.get("robot_type") or "")
    values: dict[str, Any] = {
        **({"license": licence} if licence else {}),
        "task_categories": ["robotics"],
        "tags": ["LeRobot", "robotics", *([robot] if robot else [])],
        "configs": [{"config_name": "default", "data_files": "data/*/*.parquet"}],
    }
    return "\n".join(["---", *(f"{key}: {json.dumps(value)}" for key, value in values.items()), "---"])


def _summary(dataset: Dataset) -> str:
    rows = sum(listed.length for listed in dataset.episodes)
    minutes, seconds = divmod(round(rows / dataset.fps), 60)
    robot = _plain(str(dataset.info.get("robot_type") or "a robot that is not named"))
    return (
        f"{_counted(len(dataset.episodes), 'episode')} of {robot}: {_counted(rows, 'row')} at {dataset.fps:g} Hz, "
        f"{minutes} min {seconds} s, in the format of LeRobot {dataset.version}."
    )


def _columns(dataset: Dataset) -> Iterator[str]:
    pictures = {*layout.video_keys(dataset.features), *layout.image_keys(dataset.features)}
    rows = [
        (key, feature["dtype"], " x ".join(map(str, feature["shape"])), _names(feature.get("names")))
        for key, feature in dataset.features.items()
        if key not in pictures
    ]
    yield _table(("column", "type", "shape", "names"), rows)


def _names(names: object) -> str:
    """Return the names of a column's numbers; datasets state them as a list, as a table of lists, or not at all."""
    if isinstance(names, Mapping):
        names = [name for part in names.values() if isinstance(part, list) for name in part]
    return ", ".join(map(str, names)) if isinstance(names, list) else ""


def _cameras(dataset: Dataset) -> Iterator[str]:
    keys = [*layout.video_keys(dataset.features), *layout.image_keys(dataset.features)]
    rows = [
        (key, dataset.features[key]["dtype"], " x ".join(map(str, dataset.features[key]["shape"])))
        for key in keys
    ]
    if rows:
        yield "## Cameras"
        yield _table(("camera", "stored as", "shape"), rows)


def _tasks(dataset: Dataset) -> Iterator[str]:
    counts = Counter(task for listed in dataset.episodes for task in listed.tasks)
    if not counts:
        yield "No task is named."
        return
    shown = counts.most_common(_MOST_TASKS)
    yield _table(("instruction", "episodes"), [(task, str(count)) for task, count in shown])
    if len(counts) > len(shown):
        yield f"{_counted(len(counts) - len(shown), 'more task')} with fewer episodes."


def _collected(lines: Sequence[Mapping[str, Any]], episodes: int) -> Iterator[str]:
    counts = Counter(str(line.get("kind", "")) for line in lines)
    known = [f"* {counts[kind]} {words}" for kind, words in _COLLECTED.items() if counts[kind]]
    if unknown := episodes - sum(counts[kind] for kind in _COLLECTED):
        known.append(f"* {unknown} of which the files do not say how")
    yield "\n".join(known) if known else "There are no episodes."
    if simulated := sum(line.get("simulated") is True for line in lines):
        yield f"{_counted(simulated, 'episode')} on a simulated robot."


def _results(lines: Sequence[Mapping[str, Any]], episodes: int) -> Iterator[str]:
    """Yield the counts of results."""
    counts = Counter(result_of(line) for line in lines)
    known = [f"* {counts[result]} {words}" for result, words in _RESULTS.items() if counts[result]]
    if unknown := episodes - sum(counts[result] for result in _RESULTS):
        known.append(f"* {unknown} not scored")
    yield "\n".join(known) if known else "There are no episodes."


def result_of(line: Mapping[str, Any]) -> str:
    """Return "success", "partial", "fail" or "" from the line of an episode; older lines have only `success`."""
    if line.get("result") in _RESULTS:
        return str(line["result"])
    return {"True": "success", "False": "fail"}.get(str(line.get("success")), "")


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join(f"| {' | '.join(_plain(cell) for cell in line)} |" for line in lines)


def _plain(text: str) -> str:
    """Return text on one line that neither Markdown tables nor HTML take for anything else."""
    return html.escape(" ".join(str(text).split()), quote=False).replace("|", "\\|").replace("`", "'")


def _counted(count: int, thing: str) -> str:
    return f"{count} {thing}{'' if count == 1 else 's'}"
