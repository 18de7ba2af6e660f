"""Interface of automatic judges: the case that a judge receives, and its judgement.

A judge's module has three names. `SEES` is "pictures" or "truth", the only data that the judge receives. `SERVED` is
whether the judge sends data to an address, which an administrator has to allow first. `build(setup)` returns a `Judge`,
and raises EvaError for an invalid set-up.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

PATIENCE_S = 120.0  # time limit for one trial


class NoVerdict(Exception):
    """Error of a judge that gave no usable verdict; its text is the reason. The trial is not shown to it again."""


@dataclass(frozen=True, slots=True)
class Setup:
    """Set-up of a judge by an administrator.

    If `plain` is set, unencrypted http to another machine is allowed.
    """

    address: str = ""
    model: str = ""
    key_variable: str = ""
    plain: bool = False
    patience_s: float = PATIENCE_S


@dataclass(frozen=True, slots=True)
class MilestonePrompt:
    """Milestone as text, and its time limit [s], None without one."""

    text: str
    limit_s: float | None = None


@dataclass(frozen=True, slots=True)
class StillImage:
    """JPEG of `camera` (an anonymous number), `at` [s] after the start of the run, without metadata."""

    camera: str
    at: float
    jpeg: bytes


@dataclass(frozen=True, slots=True)
class TrialCase:
    """Trial as shown to a judge, without code, checkpoint, score, plan, operator or file names.

    `truth` has one entry for each of `steps`: whether the bench reports the step as reached, None if it reports
    nothing.
    """

    instruction: str
    criterion: str
    steps: tuple[MilestonePrompt, ...]
    stills: tuple[StillImage, ...] = ()
    truth: tuple[bool | None, ...] = ()


@dataclass(frozen=True, slots=True)
class MilestoneJudgement:
    """Judgement of one milestone: whether it was reached, and the probability (0 to 1); both None for no verdict."""

    reached: bool | None = None
    probability: float | None = None

    def __post_init__(self) -> None:
        if (self.reached is None) != (self.probability is None):
            raise ValueError("a verdict and its probability stand together")
        if self.probability is None:
            return
        if not 0 <= self.probability <= 1:  # excludes NaN too
            raise ValueError(f"probability = {self.probability}; allowed: 0 to 1")
        if self.reached != (self.probability >= 0.5) and self.probability != 0.5:
            raise ValueError(f"{self.probability} that it was reached contradicts the verdict")


@dataclass(frozen=True, slots=True)
class CaseJudgement:
    """Judgement of each milestone, in order; `model` is the model that the server reports."""

    milestones: tuple[MilestoneJudgement, ...]
    model: str = ""


class Judge(Protocol):
    """Automatic judge of whether a trial's milestones were reached; it is called once per trial."""

    @property
    def version(self) -> str:
        """Version of the judge; it changes whenever the same case could be judged differently."""

    def prompt_text(self, case: TrialCase) -> str:
        """Return the complete text of the prompt, "" if there is none."""

    def judge(self, case: TrialCase) -> CaseJudgement:
        """Return the judgement of a case.

        Raises:
            NoVerdict: If it has none. Any other exception is a fault of the judge, and the trial is shown to it
                again.
        """
