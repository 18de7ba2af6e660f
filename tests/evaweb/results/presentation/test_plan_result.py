"""A result is one object: what shows it computes nothing anew, and a later one knows what was written since."""

from collections import Counter

import pytest

from evaweb.core.errors import EvaError
from evaweb.results.analysis import agreement
from evaweb.results.presentation import plan_result
from evaweb.results.presentation.plan_result import PlanResult
from evaweb.results.reports.reporting import write_report
from evaweb.trials import services


@pytest.fixture
def computed(monkeypatch):
    """How often each part was computed."""
    counts = Counter()

    def counted(module, name):
        compute = getattr(module, name)

        def count(*given, **more):
            counts[name] += 1
            return compute(*given, **more)

        monkeypatch.setattr(module, name, count)

    for name in ("conclude", "current_pairs", "integrity_document"):
        counted(plan_result, name)
    for name in ("rater_agreement", "judge_agreement", "preference_ranking"):
        counted(agreement, name)
    return counts


def test_a_report_computes_each_part_once(revealed, computed, tmp_path):
    write_report(revealed, tmp_path / "report")
    assert set(computed.values()) == {1}
    assert len(computed) == 6


def test_of_a_selection_runs_and_conclusion_are_those_of_all(revealed):
    whole = PlanResult(revealed)
    part = whole.select({"position": "1"})
    assert part.runs is whole.runs
    assert 0 < part.analysis.n < whole.analysis.n
    assert part.headline == whole.headline
    with pytest.raises(EvaError, match="allowed: 1, 2"):
        whole.select({"position": "7"})


def test_after_a_correction_a_new_result_knows_of_it(plan, bench, carry_out):
    carry_out(plan, 8)
    before = PlanResult(plan)
    successes = sum(arm.success.successes for arm in before.analysis.arms)
    trial = plan.handouts.first().trial
    last = not trial.verdict.success
    services.score_trial(
        user=bench.operator, trial=trial, milestones=bench.ticks(True, last, last), reason="seen on the video"
    )
    assert sum(arm.success.successes for arm in before.analysis.arms) == successes
    after = PlanResult(plan)
    assert abs(sum(arm.success.successes for arm in after.analysis.arms) - successes) == 1
