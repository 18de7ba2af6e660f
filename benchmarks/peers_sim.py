"""Episodes of published benchmarks through a whole station, compared with the benchmark by itself, to the bit.

Each episode is one trial (`python -m runtime.standins.trial`) of a scripted expert with noise, recorded with all
cameras; the same episodes are run by `metaworld_alone.py` and `aloha_alone.py`, which import nothing of ours, in the
benchmark's own environment. The environments are made first if they are not there (250 and 650 MB).

* `disagreements`: episodes whose success, number of steps or last observation differ in any bit.
* `episodes.BENCH`, `successes.BENCH`: how many, and how many of them succeed, so that failures are compared too.
* `steps_per_s.BENCH`, `alone_per_s.BENCH`: steps per second of the run, with recording, and of the benchmark by itself.

With `--full` all tasks; finished episodes are kept below the data folder, so that it continues where it ended.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

from benchmarks.report import Figure, Report
from runtime.benches.environments import make_environment, program_variables, require_python
from runtime.benches.schema import load_schema

_ROOT = Path(__file__).parents[1]
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


class Peer(NamedTuple):
    """A benchmark: its tasks that are compared, the noise of its experts, and the last argument of its own script."""

    bench: str
    tasks: tuple[str, ...]
    noise: float
    argument: Callable[[str], str]
    """Function of the address of the experts."""


_PEERS = (
    Peer("metaworld", _TASKS, 0.5, lambda url: "0.5"),
    Peer("aloha", ("transfer_cube", "insertion"), 0.01, lambda url: url),
)
_SIDE = 96  # of pictures [pixels]
_COMPARED = ("task", "seed", "success", "steps", "last")


def measure(seconds: float, *, long: bool = False) -> Report:
    """Run and compare the episodes of a dozen tasks, or of all; `seconds` is not used: episodes last as they last."""
    figures, rows = [], []
    for peer in _PEERS:
        make_environment(peer.bench)
        schema = load_schema(peer.bench)
        tasks = tuple(schema.choices["task"].values) if long else peer.tasks
        with tempfile.TemporaryDirectory() as name, _experts(peer) as url:
            kept = _results_file(peer.bench, schema.digest) if long else Path(name) / "results.jsonl"
            ours = _run_ours(peer, tasks, kept, Path(name), url)
            alone = _run_alone(peer, tasks, url)
        for key, own in ours.items():
            same = all(own[field] == alone[key][field] for field in _COMPARED)
            told = {field: own[field] for field in ("task", "seed", "steps", "success")}
            rows.append({"bench": peer.bench, **told, "same": same})
        figures += [
            Figure(f"episodes.{peer.bench}", float(len(ours)), ""),
            Figure(f"successes.{peer.bench}", float(sum(bool(row["success"]) for row in ours.values())), ""),
            Figure(f"steps_per_s.{peer.bench}", _steps_per_s(ours), "1/s"),
            Figure(f"alone_per_s.{peer.bench}", _steps_per_s(alone), "1/s"),
        ]
    disagreements = Figure("disagreements", float(sum(not row["same"] for row in rows)), "", "== 0")
    return Report("peers_sim", [disagreements, *figures], rows)


def _steps_per_s(runs: Mapping[Any, Mapping[str, Any]]) -> float:
    return float(sum(row["steps"] for row in runs.values()) / sum(row["seconds"] for row in runs.values()))


def _results_file(bench: str, digest: str) -> Path:
    """Return the file of finished episodes of this version of the bench."""
    folder = Path(os.environ.get("EVA_DATA_DIR") or "data").absolute() / "environments"
    return folder / f"peers_sim-{bench}-{digest.removeprefix('sha256:')[:12]}.jsonl"


def _run_ours(
    peer: Peer, tasks: tuple[str, ...], kept: Path, folder: Path, url: str
) -> dict[tuple[str, int], dict[str, Any]]:
    """Return what each episode through a station ended with; episodes in the file `kept` are not run again."""
    lines = kept.read_text().splitlines() if kept.exists() else []
    done = {(row["task"], row["seed"]): row for row in map(json.loads, lines)}
    with kept.open("a") as file:
        for task in tasks:
            for seed in range(_SEEDS):
                if (task, seed) in done:
                    continue
                row = _trial(peer.bench, task, seed, url, folder)
                file.write(json.dumps(row) + "\n")
                file.flush()
                done[task, seed] = row
    return {(task, seed): done[task, seed] for task in tasks for seed in range(_SEEDS)}


@contextmanager
def _experts(peer: Peer) -> Iterator[str]:
    """Yield the address of a server of the benchmark's experts."""
    command = [sys.executable, "-m", "runtime.benches.environments", peer.bench, "experts.py", "--lifeline"]
    server = subprocess.Popen(
        [*command, "--noise", str(peer.noise)],
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


def _trial(bench: str, task: str, seed: int, url: str, folder: Path) -> dict[str, Any]:
    """Run one episode as a trial in a process of its own."""
    layout = {"id": f"{task}-{seed}", "seed": seed, "choices": {"task": task, "pictures": "plain"}}
    setup = {"task": task, "policy": {"kind": "openpi", "url": url}, "bench": layout}
    orders = {"setup": setup, "run": {"mode": "continuous", "trial": {}}}
    sets = [f'data_dir="{folder}"', "recording.min_free_bytes=0", "recording.export=false"]
    command = [sys.executable, "-m", "runtime.standins.trial", f"deployments/{bench}.toml"]
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


def _run_alone(peer: Peer, tasks: tuple[str, ...], url: str) -> dict[tuple[str, int], dict[str, Any]]:
    """Return what each episode ends with in the benchmark by itself."""
    script = str(_ROOT / "benchmarks" / f"{peer.bench}_alone.py")
    done = subprocess.run(
        [str(require_python(peer.bench)), script, ",".join(tasks), str(_SEEDS), peer.argument(url)],
        env=program_variables(peer.bench) | {"PYTHONPATH": ""},
        stdout=subprocess.PIPE,
        text=True,
        check=True,
    )
    rows = [json.loads(line) for line in done.stdout.splitlines()]
    return {(row["task"], row["seed"]): row for row in rows}
