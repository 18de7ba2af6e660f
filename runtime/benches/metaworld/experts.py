"""Meta-World's scripted experts as a policy server; the task is the word of the instruction that is the name of one."""

from __future__ import annotations

import re
import warnings
from functools import cache
from typing import Any

import numpy as np
from metaworld.policies import ENV_POLICY_MAP  # type: ignore[import-not-found]

from runtime.standins.expert_server import Array, serve

_TASK = re.compile(r"[a-z0-9-]+-v3")


@cache  # cache: one per task, as the benchmark has them
def _expert(task: str) -> Any:
    return ENV_POLICY_MAP[task]()


def compute_rows(instruction: str, seen: Array) -> Array:
    """Return the row [1, 4] of a task's expert for an observation vector [39], into which some of them write."""
    task = next((word for word in _TASK.findall(instruction) if word in ENV_POLICY_MAP), None)
    if task is None:
        raise ValueError(f"the instruction {instruction!r} names no task of Meta-World, such as reach-v3")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of rows beyond -1 to 1, which the benchmark cuts
        return np.asarray(_expert(task).get_action(seen), np.float64)[None]


if __name__ == "__main__":
    serve(compute_rows, observation=39, horizon=1)
