"""Lookup of judges by kind; all their errors name the judge."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from types import ModuleType

from evaweb.core.errors import EvaError
from evaweb.results.judges.base import CaseJudgement, Judge, NoVerdict, Setup, TrialCase
from runtime.core.plugins import variants
from runtime.core.sentences import Pattern

_JUDGE_VERDICTS_ON_MILESTONES = Pattern(
    "results.judges.finding.judge_verdicts_on_milestones",
    "judge {name}: {count} verdicts on {count_2} milestones",
)
_JUDGE_KIND_ALLOWED = Pattern(
    "results.judges.finding.judge_kind_allowed",
    "judge {name}: kind = {kind!r:.40}; allowed: {kinds}",
)


@dataclass(frozen=True, slots=True)
class UsableJudge:
    """Judge that is ready for use.

    `pictures` is True if the judge is shown images, and False if it is given the ground truth of a simulated bench.
    """

    name: str
    version: str
    judge: Judge
    pictures: bool
    served: bool

    def prompt_text(self, case: TrialCase) -> str:
        """Return the complete text of the prompt for a case.

        Raises:
            EvaError: If the judge's code fails; the message names the judge.
        """
        with _named(self.name):
            return self.judge.prompt_text(case)

    def judge_case(self, case: TrialCase) -> CaseJudgement:
        """Return the judgement, with one entry per milestone.

        Raises:
            NoVerdict: If the judge has none.
            EvaError: If its code fails; the message names the judge.
        """
        with _named(self.name, NoVerdict):
            verdict = self.judge.judge(case)
        if len(verdict.milestones) != len(case.steps):
            raise EvaError(
                _JUDGE_VERDICTS_ON_MILESTONES(
                    name=self.name, count=len(verdict.milestones), count_2=len(case.steps)
                )
            )
        return verdict


def build_judge(name: str, kind: str, setup: Setup) -> UsableJudge:
    """Return the judge `name` of that kind.

    Raises:
        EvaError: If kind or set-up is invalid.
    """
    kinds = variants("evaweb.results.judges")
    if kind not in kinds:
        raise EvaError(_JUDGE_KIND_ALLOWED(name=name, kind=kind, kinds=", ".join(kinds)))
    with _named(name):
        module: ModuleType = kinds[kind]
        judge = module.build(setup)
        return UsableJudge(name, judge.version, judge, module.SEES == "pictures", module.SERVED)


@contextmanager
def _named(name: str, *through: type[Exception]) -> Iterator[None]:
    """Convert exceptions of a judge's code to an EvaError that names the judge; those in `through` pass unchanged."""
    try:
        yield
    except through:
        raise
    except EvaError as fault:
        raise EvaError(f"judge {name}: {fault}") from fault
    except Exception as fault:  # a judge is third-party code and may raise anything
        raise EvaError(f"judge {name}: {type(fault).__name__}: {fault}") from fault
