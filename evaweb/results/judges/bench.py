"""A simulated bench as a judge: what it says itself of how it was left."""

from __future__ import annotations

from typing import Literal

from evaweb.results.judges.base import CaseJudgement, MilestoneJudgement, NoVerdict, Setup, TrialCase

SEES: Literal["pictures", "truth"] = "truth"
SERVED = False


class BenchTruth:
    """Certain of all that the bench reports, and silent about the rest."""

    version = "bench 1"

    def prompt_text(self, case: TrialCase) -> str:
        """It is asked nothing."""
        return ""

    def judge(self, case: TrialCase) -> CaseJudgement:
        """Whether the bench says that each was reached, within its time."""
        if all(known is None for known in case.truth):
            raise NoVerdict("the bench reports none of its milestones")
        return CaseJudgement(
            tuple(
                MilestoneJudgement() if known is None else MilestoneJudgement(known, float(known))
                for known in case.truth
            )
        )


def build(setup: Setup) -> BenchTruth:
    """It has no set-up."""
    return BenchTruth()
