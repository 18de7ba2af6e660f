"""Episodes of Meta-World through a whole station, compared with the benchmark by itself, to the bit.

Each episode is one trial (`python -m runtime.standins.trial`) of a scripted expert with noise, recorded with both
cameras; the same episodes are run by `metaworld_alone.py`, which imports nothing of ours, in the benchmark's own
environment. The environment is made first if it is not there (250 MB).

* `disagreements`: episodes whose success, number of steps or last observation differ in any bit.
* `episodes`, `successes`: how many, and how many of them succeed, so that failures are compared too.
* `steps_per_s`, `steps_per_s.alone`: steps in a second of the run, with recording, and of the benchmark by itself.

With `--full` all fifty tasks; finished episodes are kept below the data folder, so that it continues where it ended.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from benchmarks.report import Figure, Report
from runtime.benches.environments import make_environment, program_variables, require_python
from runtime.benches.schema import load_schema

_ROOT = Path(__file__).parents[1]
_BENCH = "metaworld"
_TASKS = (
    *("reach-v3", "push-v3", "pick-place-v3", "door-open-v3", "drawer-open-v3"),
    *(
        "drawer-close-v3",
        "button-press-topdown-v3",
        "peg-insert-side-v3",
        "window-open-v3",
        "window-close-v3",
    ),
)
_SEEDS = 5
_NOISE = 0.5
_SIDE = 96  # of pictures [pixels]
_COMPARED = ("task", "seed", "success", "steps", "last")


def measure(seconds: float, *, long: bool = False) -> Report:
    """Run and compare the episodes of ten tasks, or of all; `seconds` is not used: episodes last as they last."""
    make_environment(_BENCH)
    schema = load_schema(_BENCH)
    tasks = tuple(schema.choices["task"].values) if long else _TASKS
    with tempfile.TemporaryDirectory() as name:
        kept = _results_file(schema.digest) if long else Path(name) / "results.jsonl"
        ours = _run_ours(tasks, kept, Path(name))
    alone = _run_alone(tasks)
    rows = []
    for key, own in ours.items():
        same = all(own[field] == alone[key][field] for field in _COMPARED)
        rows.append(
            {"task": own["task"], "seed": own["seed"], "steps": own["steps"], "success": own["success"]}
        )
        rows[-1]["same"] = same
    speeds = {
        name: sum(row["steps"] for row in runs.values()) / sum(row["seconds"] for row in runs.values())
        for name, runs in (("ours", ours), ("alone", alone))
    }
    figures = [
        Figure("disagreements", float(sum(not row["same"] for row in rows)), "", "== 0"),
        Figure("episodes", float(len(rows)), ""),
        Figure("successes", float(sum(bool(row["success"]) for row in rows)), ""),
        Figure("steps_per_s", speeds["ours"], "1/s"),
        Figure("steps_per_s.alone", speeds["alone"], "1/s"),
    ]
    return Report("peers_sim", figures, rows)


def _results_file(digest: str) -> Path:
    """Return the file of finished episodes of this version of the bench."""
    folder = Path(os.environ.get("EVA_DATA_DIR") or "data").absolute() / "environments"
    return folder / f"peers_sim-{digest.removeprefix('sha256:')[:12]}.jsonl"


def _run_ours(tasks: tuple[str, ...], kept: Path, folder: Path) -> dict[tuple[str, int], dict[str, Any]]:
    """Return what each episode through a station ended with; episodes in the file `kept` are not run again."""
    lines = kept.read_text().splitlines() if kept.exists() else []
    done = {(row["task"], row["seed"]): row for row in map(json.loads, lines)}
    with _experts() as url, kept.open("a") as file:
        for task in tasks:
            for seed in range(_SEEDS):
                if (task, seed) in done:
                    continue
                row = _trial(task, seed, url, folder)
                file.write(json.dumps(row) + "\n")
                file.flush()
                done[task, seed] = row
    return {(task, seed): done[task, seed] for task in tasks for seed in range(_SEEDS)}


@contextmanager
def _experts() -> Iterator[str]:
    """Yield the address of a server of Meta-World's experts."""
    command = [sys.executable, "-m", "runtime.benches.environments", _BENCH, "experts.py", "--lifeline"]
    server = subprocess.Popen(
        [*command, "--noise", str(_NOISE)],
        cwd=_ROOT,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert server.stdin is not None
    assert server.stdout is not None
    try:
        yield str(json.loads(server.stdout.readline())["url"])
    finally:
        server.stdin.close()
        server.wait()


def _trial(task: str, seed: int, url: str, folder: Path) -> dict[str, Any]:
    """Run one episode as a trial in a process of its own."""
    bench = {"id": f"{task}-{seed}", "seed": seed, "choices": {"task": task, "pictures": "plain"}}
    setup = {"task": task, "policy": {"kind": "openpi", "url": url}, "bench": bench}
    orders = {"setup": setup, "run": {"mode": "continuous", "trial": {}}}
    sets = [f'data_dir="{folder}"', "recording.min_free_bytes=0", "recording.export=false"]
    command = [sys.executable, "-m", "runtime.standins.trial", "deployments/metaworld.toml"]
    command += [part for assignment in sets for part in ("--set", assignment)]
    done = subprocess.run(
        [*command, "--width", str(_SIDE), "--height", str(_SIDE)],
        cwd=_ROOT,
        input=json.dumps(orders),
        stdout=subprocess.PIPE,
        text=True,
        check=True,
    )
    events: list[Mapping[str, Any]] = json.loads(done.stdout)["events"]
    truth = next(event["data"] for event in events if event["kind"] == "truth")
    opened = next(at for at, event in enumerate(events) if event["kind"] == "episode_opened")
    ended = next(event for event in events[opened:] if event["kind"] == "state")
    end = {"success": truth["success"], "steps": truth["steps"], "last": truth["observation"]}
    return {"task": task, "seed": seed, **end, "seconds": ended["wall"] - events[opened]["wall"]}


def _run_alone(tasks: tuple[str, ...]) -> dict[tuple[str, int], dict[str, Any]]:
    """Return what each episode ends with in the benchmark by itself."""
    script = str(_ROOT / "benchmarks" / "metaworld_alone.py")
    done = subprocess.run(
        [str(require_python(_BENCH)), script, ",".join(tasks), str(_SEEDS), str(_NOISE)],
        env=program_variables(_BENCH) | {"PYTHONPATH": ""},
        stdout=subprocess.PIPE,
        text=True,
        check=True,
    )
    rows = [json.loads(line) for line in done.stdout.splitlines()]
    return {(row["task"], row["seed"]): row for row in rows}
