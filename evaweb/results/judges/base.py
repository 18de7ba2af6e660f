"""What an automatic judge is given of a trial, and what it says of it.

A module of a judge has `SEES` ("pictures" or "truth": it is given that and not the other), `SERVED` (whether it sends
what it sees to an address, which an administrator has to allow first) and `build(setup)`, a `Judge`. EvaError says what
is wrong with a set-up.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

PATIENCE_S = 120.0  # for all that a judge does about one trial


class NoVerdict(Exception):
    """The judge said nothing that can be used; why, in words. The trial is not shown to it again."""


@dataclass(frozen=True, slots=True)
class Setup:
    """What an administrator has said of a judge that has a server; `plain`: over http, to another machine too."""

    address: str = ""
    model: str = ""
    key_variable: str = ""
    plain: bool = False
    patience_s: float = PATIENCE_S


@dataclass(frozen=True, slots=True)
class MilestonePrompt:
    """A milestone in its words, and until when it counts [s], None where it always does."""

    text: str
    limit_s: float | None = None


@dataclass(frozen=True, slots=True)
class StillImage:
    """A picture of `camera`, a number and no name, `at` [s] after the start of the run; a JPEG of pixels alone."""

    camera: str
    at: float
    jpeg: bytes


@dataclass(frozen=True, slots=True)
class TrialCase:
    """One trial as a judge is shown it; nothing here tells its code, checkpoint, score, plan, operator or files.

    `truth` has for each step whether the bench itself says that it was reached, None where it says nothing.
    """

    instruction: str
    criterion: str
    steps: tuple[MilestonePrompt, ...]
    stills: tuple[StillImage, ...] = ()
    truth: tuple[bool | None, ...] = ()


@dataclass(frozen=True, slots=True)
class MilestoneJudgement:
    """Of one milestone: whether it was reached, and how probable that is, 0 to 1; both None for no verdict."""

    reached: bool | None = None
    probability: float | None = None

    def __post_init__(self) -> None:
        if (self.reached is None) != (self.probability is None):
            raise ValueError("a verdict and its probability stand together")
        if self.probability is None:
            return
        if not 0 <= self.probability <= 1:  # nor NaN
            raise ValueError(f"probability = {self.probability}; allowed: 0 to 1")
        if self.reached != (self.probability >= 0.5) and self.probability != 0.5:
            raise ValueError(f"{self.probability} that it was reached contradicts the verdict")


@dataclass(frozen=True, slots=True)
class CaseJudgement:
    """One word on each milestone, in their order; `model` is what the server says has answered."""

    milestones: tuple[MilestoneJudgement, ...]
    model: str = ""


class Judge(Protocol):
    """Says of each milestone of a trial whether it was reached; asked once about each."""

    @property
    def version(self) -> str:
        """Another one where the same case could be judged otherwise."""

    def prompt_text(self, case: TrialCase) -> str:
        """All that it is told in words, "" for nothing."""

    def judge(self, case: TrialCase) -> CaseJudgement:
        """Raises NoVerdict; whatever else it raises is a fault of the judge, and the trial is shown to it again."""
