"""A judge by the name of its kind; one that cannot be used is told in a sentence that names it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from types import ModuleType

from evaweb.errors import EvaError
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
    """A judge that can be asked; `pictures` where it is shown these, else the bench's truth."""

    name: str
    version: str
    judge: Judge
    pictures: bool
    served: bool

    def prompt_text(self, case: TrialCase) -> str:
        """All that it is told in words; EvaError that names the judge."""
        with _named(self.name):
            return self.judge.prompt_text(case)

    def judge_case(self, case: TrialCase) -> CaseJudgement:
        """Its verdict, one word for each milestone; NoVerdict, else EvaError that names the judge."""
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
    """The judge `name`, of that kind; EvaError where the kind or the set-up cannot be."""
    kinds = variants("evaweb.results.judges")
    if kind not in kinds:
        raise EvaError(_JUDGE_KIND_ALLOWED(name=name, kind=kind, kinds=", ".join(kinds)))
    with _named(name):
        module: ModuleType = kinds[kind]
        judge = module.build(setup)
        return UsableJudge(name, judge.version, judge, module.SEES == "pictures", module.SERVED)


@contextmanager
def _named(name: str, *through: type[Exception]) -> Iterator[None]:
    """Whatever a judge's own code raises, but `through`, as an EvaError that names the judge."""
    try:
        yield
    except through:
        raise
    except EvaError as fault:
        raise EvaError(f"judge {name}: {fault}") from fault
    except Exception as fault:  # of anybody's code
        raise EvaError(f"judge {name}: {type(fault).__name__}: {fault}") from fault
