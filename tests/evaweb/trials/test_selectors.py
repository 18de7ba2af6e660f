from datetime import timedelta

import pytest
from django.utils import timezone

from evaweb.core.errors import EvaError, NotFound
from evaweb.episodes.models import Episode
from evaweb.episodes.services import trial_changed
from evaweb.trials import selectors, services, voids
from evaweb.trials.models import Checkpoint, Trial
from evaweb.trials.selectors import TrialFilters
from tests.evaweb.trials import builders


def test_statistics_of_no_trials_are_no_rows(bench):
    assert selectors.statistics() == []


def test_statistics_count_scored_trials_per_scene_and_checkpoint_and_name_the_others(bench):
    other = Checkpoint.objects.create(name="act-block")
    for success in (True, True, False):
        bench.scored(success)
    bench.scored(True, checkpoint=other)
    voids.void_trial(user=bench.operator, trial=bench.scored(), reason="a hand")
    interrupted = bench.prepare(position=2)
    Trial.objects.filter(pk=interrupted.pk).update(status="interrupted")
    bench.ended()
    first, second = selectors.statistics()
    assert (first.checkpoint, first.summary.success.n, first.summary.success.rate) == (other, 1, 1.0)
    assert (second.summary.success.successes, second.summary.success.n) == (2, 3)
    assert second.summary.success.interval.low == pytest.approx(0.2077, abs=1e-4)
    assert second.summary.mean_score == pytest.approx(0.75)
    assert second.summary.median_duration_s == 12.5
    assert (second.to_score, second.interrupted, second.voided) == (1, 1, 1)


def test_a_cell_without_a_scored_trial_is_a_row_without_a_rate(bench):
    bench.ended()
    (row,) = selectors.statistics()
    assert (row.summary.success.n, row.summary.success.rate, row.to_score) == (0, None, 1)


def test_statistics_take_a_bounded_number_of_queries(bench, django_assert_max_num_queries):
    for name in "abcdef":
        bench.scored(checkpoint=Checkpoint.objects.create(name=name))
    with django_assert_max_num_queries(6):
        assert len(selectors.statistics()) == 6


def test_the_list_takes_one_query_whatever_its_length(bench, django_assert_num_queries):
    for _ in range(5):
        bench.scored()
    with django_assert_num_queries(1):
        rows = [(t.scene.name, t.checkpoint.name, t.verdict.rater.username) for t in selectors.trial_list()]
    assert len(rows) == 5


def test_a_corrected_score_is_the_one_that_counts(bench):
    trial = bench.scored(True)
    ticks = bench.ticks(True, False, False)
    services.score_trial(user=bench.operator, trial=trial, milestones=ticks, reason="it fell")
    (row,) = selectors.statistics()
    assert (row.summary.success.successes, row.summary.success.n) == (0, 1)


def test_filters_choose_by_name_or_id_and_all_together(bench):
    trial = bench.scored()
    builders.scene("other-scene")
    for filters, n in (
        (TrialFilters(scene="block-on-plate", station="bench-1", status="scored"), 1),
        (TrialFilters(checkpoint=str(bench.checkpoint.pk)), 1),
        (TrialFilters(evaluation="open bench bench-1"), 1),
        (TrialFilters(scene="other-scene"), 0),
        (TrialFilters(status="voided"), 0),
    ):
        assert selectors.trial_list(filters).count() == n
    assert trial.pk


@pytest.mark.parametrize(
    ("kind", "known"), [("scene", "block-on-plate"), ("checkpoint", "pi0-block"), ("station", "bench-1")]
)
def test_an_unknown_name_is_an_error_that_lists_the_known_ones(bench, kind, known):
    with pytest.raises(NotFound, match=f"{kind} 'nope' does not exist; there are: {known}"):
        selectors.trial_list(TrialFilters(**{kind: "nope"}))


@pytest.mark.parametrize("given", ["yesterday", "2026-13-01", "2026-02-30", "1", "9999-12-31T23:59:59-23:00"])
def test_times_that_are_none_are_refused(bench, given):
    with pytest.raises(EvaError, match="since = "):
        selectors.trial_list(TrialFilters(since=given))


def test_since_takes_days_and_times(bench):
    bench.scored()
    tomorrow = timezone.now() + timedelta(days=2)
    assert selectors.trial_list(TrialFilters(since="2020-01-31")).count() == 1
    assert selectors.trial_list(TrialFilters(since="2020-01-31T10:00:00Z")).count() == 1
    assert selectors.trial_list(TrialFilters(since=tomorrow.date().isoformat())).count() == 0


@pytest.mark.parametrize("id", [0, -1, 999_999, 2**70])
def test_ids_that_are_nobodys_are_not_found(bench, id):
    with pytest.raises(NotFound, match="does not exist"):
        selectors.trial_get(id=id)


@pytest.mark.parametrize("name", ["", "nope", "9" * 30, "٣", 2**70])
def test_names_that_are_nobodys_are_not_found(bench, name):
    with pytest.raises(NotFound):
        selectors.scene_get(name=name)


def test_a_position_is_found_by_its_number_in_its_scene(bench):
    assert selectors.position_get(scene=bench.scene, number=2).number == 2
    with pytest.raises(NotFound, match="there are: 1, 2"):
        selectors.position_get(scene=bench.scene, number=3)


def test_the_open_trial_of_a_station_is_the_one_that_is_not_finished(bench):
    assert selectors.trial_open(bench.station) is None
    trial = bench.ended()
    assert selectors.trial_open(bench.station) == trial
    voids.void_trial(user=bench.operator, trial=trial, reason="x")
    assert selectors.trial_open(bench.station) is None


def test_exports_come_in_pages_that_neither_repeat_nor_miss(bench):
    made = [bench.scored().pk for _ in range(5)]
    pages = list(selectors.trials_in_pages(TrialFilters(), size=2))
    assert [len(page) for page in pages] == [2, 2, 1]
    assert [trial.pk for page in pages for trial in page] == made


def test_of_many_cells_only_those_are_made_anew_that_have_a_changed_trial(bench, monkeypatch):
    other = Checkpoint.objects.create(name="act-block")
    first, _ = bench.scored(True), bench.scored(True, checkpoint=other)
    made = []
    summarised = selectors._summarised

    def noted(trials):
        cells = summarised(trials)
        made.append(sorted(cells))
        return cells

    monkeypatch.setattr(selectors, "_summarised", noted)
    both = [(bench.scene.pk, bench.checkpoint.pk), (bench.scene.pk, other.pk)]
    assert len(selectors.statistics()) == 2
    assert len(selectors.statistics()) == 2
    assert made == [both], "nothing has changed since"
    bench.scored(False, checkpoint=other)
    act, pi0 = selectors.statistics()
    assert (act.summary.success.n, pi0.summary.success.n) == (2, 1)
    assert made[1:] == [both[1:]]
    voids.void_trial(user=bench.operator, trial=first, reason="a hand")
    assert [row.summary.success.n for row in selectors.statistics()] == [2, 0]
    long_ago = timezone.now() - timedelta(
        minutes=5
    )  # by a clock that is behind, or in a transaction that took long
    Episode.objects.filter(trial__checkpoint=other).update(smoothness=-1.5)
    Trial.objects.filter(checkpoint=other).update(changed_at=long_ago)
    assert selectors.statistics()[0].summary.smoothness.n == 2


def test_where_more_has_changed_than_is_looked_through_all_of_it_is_made_anew(bench, monkeypatch):
    monkeypatch.setattr(selectors, "_MOST_CHANGED", 1)
    for success in (True, False, True):
        bench.scored(success)
        (row,) = selectors.statistics()
    assert (row.summary.success.successes, row.summary.success.n) == (2, 3)


def test_smoothness_that_is_measured_later_is_in_the_summary(bench):
    trial = bench.scored()
    assert selectors.statistics()[0].summary.smoothness is None
    Episode.objects.filter(pk=trial.episode_id).update(smoothness=-1.5)
    trial_changed(uuid=trial.episode_id)
    assert selectors.statistics()[0].summary.smoothness.value == -1.5


def test_a_name_that_means_another_row_now_has_that_ones_summary(bench):
    other = Checkpoint.objects.create(name="act-block")
    for success, checkpoint in ((True, bench.checkpoint), (False, other), (False, other)):
        bench.scored(success, checkpoint=checkpoint)
    names, asked = (bench.checkpoint.name, other.name), TrialFilters(checkpoint=other.name)
    assert selectors.statistics(asked)[0].summary.success.n == 2
    for row, name in ((bench.checkpoint, "meanwhile"), (other, names[0]), (bench.checkpoint, names[1])):
        Checkpoint.objects.filter(pk=row.pk).update(name=name)
    assert selectors.statistics(asked)[0].summary.success.n == 1
