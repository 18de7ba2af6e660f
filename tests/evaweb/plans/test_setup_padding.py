"""A watch does not tell which checkpoint a blind trial is of."""

import pytest

from evaweb.plans import setup_padding as pacing
from evaweb.plans.allocation import allocate_trial
from evaweb.plans.models import Plan
from evaweb.plans.services import freeze_plan
from evaweb.trials.models import Trial
from evaweb.trials.station_commands import setup_args, trial_command
from tests.evaweb.trials import builders
from tests.evaweb.unguarded import without_triggers


@pytest.fixture
def plan(draft, owner):
    return freeze_plan(user=owner, plan=draft)


@pytest.fixture
def handed(bench, plan):
    """The next trial of the plan; the one before has ended."""

    def hand():
        Trial.objects.filter(station=bench.station).update(status="voided")
        return allocate_trial(user=bench.operator, station=bench.station, plan=plan).trial

    return hand


def took(checkpoint, bench, *seconds):
    """Earlier trials of a checkpoint at the station, and how long its policy took."""
    for warm_up in seconds:
        Trial.objects.filter(station=bench.station).update(status="voided")
        trial = bench.prepare(checkpoint=checkpoint)
        Trial.objects.filter(pk=trial.pk).update(setup_took={"connect_s": 0.2, "warm_up_s": warm_up})


def test_every_set_up_lasts_as_long_as_with_the_slowest(bench, plan, handed):
    quick, slow = plan.checkpoints.order_by("name")
    took(quick, bench, 1.0, 1.5)
    took(slow, bench, 8.0, 6.0)
    found = [setup_args(handed(), "00000000-0000-0000-0000-000000000000")["least"] for _ in range(6)]
    assert {row.keys() == {"connect_s", "warm_up_s"} for row in found} == {True}
    assert all(8.0 <= row["warm_up_s"] <= 10.0 and 0.2 <= row["connect_s"] <= 0.25 for row in found)
    assert len({row["warm_up_s"] for row in found}) == 6, "by chance"
    trial = handed()
    assert pacing.min_stage_times(trial) == pacing.min_stage_times(trial), "but the same for the same trial"


def test_what_took_long_once_is_forgotten_after_five_trials(bench, plan, handed):
    quick = plan.checkpoints.order_by("name")[0]
    took(quick, bench, 60.0, *[2.0] * pacing.NEWEST)
    assert pacing.min_stage_times(handed())["warm_up_s"] <= 2.5
    took(quick, bench, 10_000.0)
    assert pacing.min_stage_times(handed())["warm_up_s"] == pacing.MOST_S


def test_where_nothing_is_blind_or_nothing_known_nobody_waits(bench, plan, handed):
    trial = handed()
    assert pacing.min_stage_times(trial) is None
    assert "least" not in setup_args(trial, "00000000-0000-0000-0000-000000000000")
    Trial.objects.filter(pk=trial.pk).update(setup_took={"connect_s": 1.0, "warm_up_s": 1.0})
    assert pacing.min_stage_times(trial) is not None
    with without_triggers("plans"):
        Plan.objects.filter(pk=plan.pk).update(state="revealed")
    assert pacing.min_stage_times(trial) is None
    Trial.objects.filter(station=bench.station).update(status="voided")
    assert pacing.min_stage_times(bench.prepare()) is None


def test_how_long_it_took_is_kept_when_the_run_is_asked_for_and_a_repeated_set_up_is_the_same(
    bench, wire, monkeypatch
):
    trial = bench.prepare()
    draws = iter((5.0, 6.0, 7.0))
    monkeypatch.setattr("evaweb.trials.station_commands._least", [lambda trial: {"warm_up_s": next(draws)}])
    order = {"user": bench.operator, "page": "p1", "epoch": 3, "boot": builders.BOOT, "sequence": 5}
    row = trial_command(trial=trial, kind="setup", **order)
    assert row.args["least"] == {"warm_up_s": 5.0}
    Trial.objects.filter(pk=trial.pk).update(setup=None)  # as if its answer had been lost
    again = trial_command(trial=trial, kind="setup", uuid=row.pk, **order)
    assert (again.pk, again.args["least"]) == (row.pk, {"warm_up_s": 5.0})
    wire.snapshot = {**wire.snapshot, "setup_took": {"connect_s": 0.5, "warm_up_s": 3.25}}
    trial_command(trial=trial, kind="run", **order)
    trial.refresh_from_db()
    assert trial.setup_took == {"connect_s": 0.5, "warm_up_s": 3.25}
