"""A judge by the name of its kind; one that cannot be used is told in a sentence that names it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from types import ModuleType

from evaweb.errors import EvaError
from evaweb.results.judges.base import Case, Judge, NoVerdict, Setup, Verdict
from runtime.core.plugins import variants


@dataclass(frozen=True, slots=True)
class Found:
    """A judge that can be asked; `pictures` where it is shown these, else the bench's truth."""

    name: str
    version: str
    judge: Judge
    pictures: bool
    served: bool

    def words(self, case: Case) -> str:
        """All that it is told in words; EvaError that names the judge."""
        with _named(self.name):
            return self.judge.words(case)

    def asked(self, case: Case) -> Verdict:
        """Its verdict, one word for each milestone; NoVerdict, else EvaError that names the judge."""
        with _named(self.name, NoVerdict):
            verdict = self.judge.judge(case)
        if len(verdict.milestones) != len(case.steps):
            raise EvaError(
                f"judge {self.name}: {len(verdict.milestones)} verdicts on {len(case.steps)} milestones"
            )
        return verdict


def built(name: str, kind: str, setup: Setup) -> Found:
    """The judge `name`, of that kind; EvaError where the kind or the set-up cannot be."""
    kinds = variants("evaweb.results.judges")
    if kind not in kinds:
        raise EvaError(f"judge {name}: kind = {kind!r:.40}; allowed: {', '.join(kinds)}")
    with _named(name):
        module: ModuleType = kinds[kind]
        judge = module.build(setup)
        return Found(name, judge.version, judge, module.SEES == "pictures", module.SERVED)


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
