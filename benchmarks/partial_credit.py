"""Number of pairs after which partial credit separates two policies, with two methods on the same pairs.

The methods are our e-process and NSCORE's supermartingale. NSCORE (Snyder et al.) is not part of the product, and
requires cvxpy and matplotlib: it runs in a separate environment, which is created by hand. Without that environment
NSCORE is not measured.

  python -m venv build/peers/nscore && build/peers/nscore/bin/python -m pip install nscore==0.1.2
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from benchmarks.report import Figure, Report
from evaweb.statistics.sequential import ALPHA, score_evidence

PEER = Path(__file__).parents[1] / "build" / "peers" / "nscore" / "bin" / "python"
SECONDS = 0.0  # the number of cases limits it
RUNS, PAIRS, STEPS = 60, 60, 3  # steps: milestones of a trial, each reached with the checkpoint's probability
CHANCES = ((0.5, 0.5), (0.5, 0.6), (0.5, 0.7), (0.5, 0.8))
# Two one-sided tests at alpha/2 each, like ours; the peer takes scores as indices of the list of scores.
_ASKED = """
import json, sys
import numpy as np
from nscore.nsm import MirroredPartialCreditNsmTest
from statistical_comparison_core import Decision, Hypothesis
given = json.load(sys.stdin)
found = []
for run in given["runs"]:
    test = MirroredPartialCreditNsmTest(Hypothesis.P0LessThanP1, given["alpha"] / 2, np.array(given["scores"]))
    stop = None
    for at, (one, other) in enumerate(run, start=1):
        if test.step(one, other).decision is not Decision.FailToDecide:
            stop = at
            break
    found.append(stop)
print(json.dumps(found))
"""


def measure(seconds: float) -> Report:
    """Measure the figures `found.WHO.P0.P1` and `pairs.WHO.P0.P1`, in which WHO is ours or nscore.

    The figure `found` is the share of runs that separate the policies (wrongly, if they are equal). The figure `pairs`
    is the median number of pairs until they are separated; a run that never separates them counts with all its pairs.
    """
    scores = [step / STEPS for step in range(STEPS + 1)]
    figures: list[Figure] = []
    rows: list[dict[str, object]] = []
    for chances in CHANCES:
        reached = np.random.default_rng(7).binomial(STEPS, chances, size=(RUNS, PAIRS, 2))
        runs = reached.tolist()
        stops = {
            "ours": [
                score_evidence([(scores[left], scores[right]) for left, right in run]).stop for run in runs
            ]
        }
        if PEER.exists():
            stops["nscore"] = _asked({"runs": runs, "alpha": ALPHA, "scores": scores})
        for rule, ends in stops.items():
            figures += _figures(f"{rule}.{chances[0]}.{chances[1]}", ends, equal=chances[0] == chances[1])
            rows.append({"who": rule, "chances": chances, "stops": ends})
    if not PEER.exists():
        print(f"{PEER} does not exist: NSCORE is left out (see {__file__})", file=sys.stderr)
    return Report("partial_credit", figures, rows)


def _asked(question: dict[str, object]) -> list[int | None]:
    completed = subprocess.run(
        [str(PEER), "-c", _ASKED], input=json.dumps(question), capture_output=True, text=True, check=True
    )
    return list(json.loads(completed.stdout))


def _figures(of: str, stops: Sequence[int | None], equal: bool) -> Iterator[Figure]:
    share = sum(stop is not None for stop in stops) / len(stops)
    own = equal and of.startswith("ours")
    allowed = ALPHA + 3 * (ALPHA * (1 - ALPHA) / len(stops)) ** 0.5
    yield Figure(f"found.{of}", share, "", f"<= {allowed:.4f}" if own else "")
    yield Figure(f"pairs.{of}", float(np.median([stop or PAIRS for stop in stops])), "")
