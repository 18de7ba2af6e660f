"""Result of a plan: runs, analysis, conclusion and conduct, each computed once for everything that shows it."""

from __future__ import annotations

from collections.abc import Hashable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

from evaweb.plans.design import Tried, compared, current_pairs, frozen_design, stored_blocks
from evaweb.plans.models import Plan
from evaweb.results.analysis import agreement, caching
from evaweb.results.analysis.analysis import Analysis
from evaweb.results.analysis.comparison import Comparison
from evaweb.results.analysis.filters import TrialFilter, parse_filter
from evaweb.results.presentation.headline import Headline, conclude, letters_of
from evaweb.results.presentation.integrity import delays_banner, integrity_document
from evaweb.statistics.designs import Block, Design
from evaweb.statistics.proportions import Proportion


@dataclass(frozen=True)
class PlanResult:
    """Result of a plan for one request or one job.

    Each part is computed from the database when it is first used, and then kept: after a write to the database a new
    object is needed. Whether a user may see the result has to be decided before, by the module
    `ratings.result_visibility`. `only` selects the trials that are analysed; the conclusion is always from all trials.
    """

    plan: Plan
    only: TrialFilter = field(default_factory=TrialFilter)

    def select(self, given: Mapping[str, str]) -> PlanResult:
        """Return the result of those trials that the filters in an address select.

        `given` is the query of the address.

        Raises:
            EvaError: If a filter names a value that the trials do not have.
        """
        chosen = replace(self, only=parse_filter(given, self.runs.outcomes))
        vars(chosen).update(at=self.at, runs=self.runs)  # do not depend on the selection
        return chosen

    @cached_property
    def at(self) -> Hashable:
        """Fingerprint of the rows from which runs and analysis are made."""
        return caching.fingerprint(self.plan)

    @cached_property
    def runs(self) -> caching.Runs:
        """All trials that count, and all interrupted runs, whatever `only` selects."""
        return caching.cached_runs(self.plan, self.at)

    @cached_property
    def analysis(self) -> Analysis:
        """Analysis, with the letters of the plan's design if it compared all checkpoints with each other.

        Letters of checkpoints whose trials are filtered out are omitted.
        """
        analysis = caching.cached_analysis(self.plan, self.only, self.at)
        if self.design is None or len(self.design.comparisons) < 3:
            return analysis
        names = {arm.checkpoint for arm in analysis.arms}
        letters = letters_of(self.plan, self.design, self.blocks)
        return replace(analysis, letters={n: of for n, of in letters if n in names}) if letters else analysis

    @property
    def primaries(self) -> list[Comparison]:
        """Planned comparisons for which both checkpoints have trials."""
        comparisons = (self.analysis.comparison_of(*names) for names in compared(self.plan.document or {}))
        return [comparison for comparison in comparisons if comparison is not None]

    @cached_property
    def corrected(self) -> dict[str, Proportion]:
        """Current successes of checkpoints whose scores were corrected since the reveal."""
        return caching.corrected_of(self.plan, self.only, self.at)

    @cached_property
    def design(self) -> Design | None:
        """Design of the frozen plan; None without a comparison."""
        return frozen_design(self.plan.document) if self.plan.document else None

    @cached_property
    def tried(self) -> Tried:
        """Outcomes of the compared checkpoints as of now."""
        return current_pairs(self.plan)

    @cached_property
    def blocks(self) -> list[Block]:
        """Blocks that count: those of the reveal if there was one, else the current ones."""
        stored = stored_blocks(self.plan)
        return self.tried.counted if stored is None else stored

    @cached_property
    def headline(self) -> Headline | None:
        """Conclusion of the design; None without a comparison."""
        if self.design is None:
            return None
        return conclude(self.plan, self.design, self.tried, self.blocks)

    @cached_property
    def conduct(self) -> dict[str, Any]:
        """Record of how the trials were made."""
        return integrity_document(self.plan)

    @property
    def caveats(self) -> list[str]:
        """Reasons for doubt: alternative headlines, remarks on how the trials were made; [] without a comparison."""
        if self.headline is None:
            return []
        return [
            *self.headline.caveats,
            *filter(None, [delays_banner(self.conduct)]),
            *self.conduct["remarks"],
        ]

    @cached_property
    def agreement(self) -> dict[str, Any] | None:
        """Agreement of second raters with the scores."""
        return agreement.rater_agreement(self.plan)

    @cached_property
    def judges(self) -> list[dict[str, Any]] | None:
        """Agreement of automatic judges with the scores."""
        return agreement.judge_agreement(self.plan)

    @cached_property
    def preferences(self) -> dict[str, Any] | None:
        """Ranking by the raters' preferences."""
        return agreement.preference_ranking(self.plan)
