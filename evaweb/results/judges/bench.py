"""Judge for simulated benches: reports the bench's own ground truth."""

from __future__ import annotations

from typing import Literal

from evaweb.results.judges.base import CaseJudgement, MilestoneJudgement, NoVerdict, Setup, TrialCase

SEES: Literal["pictures", "truth"] = "truth"
SERVED = False


class BenchTruth:
    """Judge that is certain of all that the bench reports, and gives no verdict on the rest."""

    version = "bench 1"

    def prompt_text(self, case: TrialCase) -> str:
        """Return "", because this judge has no prompt."""
        return ""

    def judge(self, case: TrialCase) -> CaseJudgement:
        """Return whether the bench reports each milestone as reached within its time."""
        if all(reached is None for reached in case.truth):
            raise NoVerdict("the bench reports none of its milestones")
        return CaseJudgement(
            tuple(
                MilestoneJudgement() if reached is None else MilestoneJudgement(reached, float(reached))
                for reached in case.truth
            )
        )


def build(setup: Setup) -> BenchTruth:
    """Return the judge; it uses no set-up."""
    return BenchTruth()
