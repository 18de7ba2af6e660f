"""What is written opens in LeRobot's own loader. EVA_LEROBOT_PYTHONS names interpreters that have lerobot, with
colons between: one of 0.3.3 reads v2.1, from 0.4 on they read v3.0."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest

from runtime.datasets.operations import convert, delete, merge
from runtime.datasets.publishing import publish
from runtime.datasets.reader import open_dataset
from tests.runtime.datasets.foreign import Plan, column, shown, write
from tests.runtime.datasets.small import picture, record, row

pytestmark = pytest.mark.slow  # an import of torch, twice
LOADER = Path(__file__).parents[2] / "conformance" / "load_with_lerobot.py"
READS = "from lerobot.datasets.lerobot_dataset import CODEBASE_VERSION; print(CODEBASE_VERSION)"


@cache
def interpreters() -> dict[str, str]:
    """Interpreter by the version of datasets that its lerobot reads."""
    named = [path for path in os.environ.get("EVA_LEROBOT_PYTHONS", "").split(":") if path]
    if find_spec("lerobot") is not None:
        named.append(sys.executable)
    operators = (
        "import torch; l = torch.library.Library('torchvision', 'DEF')\n"
        "try: l.define('nms(Tensor dets, Tensor scores, float iou_threshold) -> Tensor')\n"
        "except RuntimeError: pass\n"
    )
    found = {}
    for path in named:
        done = subprocess.run([path, "-c", operators + READS], capture_output=True, text=True, check=True)
        found[done.stdout.split()[-1]] = path
    return found


def loaded(dataset: Path, step: int = 1) -> dict[str, Any]:
    version = open_dataset(dataset).version
    if version not in interpreters():
        pytest.skip(f"no lerobot that reads {version}: not importable here, nor named by EVA_LEROBOT_PYTHONS")
    done = subprocess.run(
        [interpreters()[version], str(LOADER), str(dataset), str(step)],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    report: dict[str, Any] = json.loads(done.stdout)
    return report


@pytest.mark.some(1)
@pytest.mark.parametrize("version", ["v2.1", "v3.0"])
def test_what_we_publish_is_loaded_with_exact_values(tmp_path: Path, version: str) -> None:
    frames = (6, 9, 5)
    for seed, (count, task) in enumerate(zip(frames, ("stack", "sort", "stack"), strict=True)):
        episode = record(tmp_path / "episodes", frames=count, seed=seed, task=task)
        publish(episode, tmp_path / "set", success=seed != 1, version=version)
    report = loaded(tmp_path / "set")
    assert (report["episodes"], report["fps"]) == (3, 30)
    made = [(seed, k) for seed, count in enumerate(frames) for k in range(count)]
    assert len(report["rows"]) == len(made)
    for read, (seed, k) in zip(report["rows"], made, strict=True):
        wanted = row(k, seed=seed)
        assert (read["episode"], read["task"]) == (seed, "sort" if seed == 1 else "stack")
        assert read["state"] == wanted.qpos.astype(float).tolist()
        assert read["action"] == wanted.action.astype(float).tolist()
        for value in read["brightness"].values():
            assert value == pytest.approx(float(picture(k).mean()), abs=2)
    assert {"min", "max", "mean", "std"} <= set(report["stats"]["action"])


@pytest.mark.some(1)
@pytest.mark.parametrize("version", ["v2.1", "v3.0"])
def test_what_was_converted_merged_and_deleted_is_loaded_with_exact_values(
    tmp_path: Path, version: str
) -> None:
    plans = [Plan("v2.1", lengths=(7, 5)), Plan(lengths=(4, 6, 3))]
    for number, plan in enumerate(plans):
        write(tmp_path / f"set{number}", plan)
    convert(tmp_path / "set0", tmp_path / "turned", "v3.0")
    merge([tmp_path / "turned", tmp_path / "set1"], tmp_path / "new", version)
    delete(tmp_path / "new", [1])
    report = loaded(tmp_path / "new")
    wanted = [(0, 7), (0, 4), (1, 6), (2, 3)]
    made = [(place, index, k, n) for place, (index, n) in enumerate(wanted) for k in range(n)]
    assert len(report["rows"]) == len(made)
    for read, (place, index, k, length) in zip(report["rows"], made, strict=True):
        assert (read["episode"], read["task"]) == (place, f"task {index % 2}")
        assert read["state"] == column(index, "observation.state", length)[k].astype(float).tolist()
        assert read["action"] == column(index, "action", length)[k].astype(float).tolist()
        for value in read["brightness"].values():
            assert value == pytest.approx(float(picture(shown(index, k)).mean()), abs=2)


def test_the_sample_episode_is_loaded_in_both_versions(tmp_path: Path) -> None:
    sample = os.environ.get("EVA_SAMPLE_EPISODE")
    if not sample:
        pytest.skip("EVA_SAMPLE_EPISODE does not name a LeRobot v2.1 dataset to try")
    convert(Path(sample), tmp_path / "there", "v3.0")
    convert(tmp_path / "there", tmp_path / "back", "v2.1")
    one, other = loaded(tmp_path / "there", 57), loaded(tmp_path / "back", 57)
    assert one["length"] == other["length"] == 398
    assert len(one["rows"]) == 7
    for new, old in zip(one["rows"], other["rows"], strict=True):
        assert new["action"] == old["action"]
        assert new["brightness"] == pytest.approx(old["brightness"], abs=0.01)
