import io
import re
import zipfile
from dataclasses import replace
from datetime import timedelta
from html import unescape

import pytest
from django.db import connection
from django.test import Client
from django.test.utils import CaptureQueriesContext
from django.utils import timezone

from evaweb.episodes.folders import journal_folder, preview_folder
from evaweb.episodes.models import Episode
from evaweb.plans.services import close_plan
from evaweb.results.analysis import caching
from evaweb.results.presentation.facts import comparison_facts
from evaweb.results.presentation.plan_result import PlanResult
from evaweb.results.ratings import rating_queue
from evaweb.results.selectors import PlanRow
from evaweb.serving import computations
from evaweb.serving.computations import Questions
from evaweb.trials import services, voids
from evaweb.trials.models import Checkpoint, Trial
from tests.evaweb.trials import builders
from tests.processes import eventually

PLAN = "/result/plans/blocks/1/"


@pytest.fixture
def as_():
    def login(user):
        client = Client()
        client.force_login(user)
        return client

    return login


@pytest.fixture
def viewer(db):
    return builders.user("vera", "viewer")


SEALED = [PLAN, f"{PLAN}compare/", f"{PLAN}evidence/", f"{PLAN}trials/", "/result/plans/blocks/"]


@pytest.mark.parametrize("address", SEALED)
def test_before_the_reveal_nobody_sees_a_result(plan, owner, bench, carry_out, as_, viewer, address):
    carry_out(plan, 16)
    for user in (bench.operator, viewer, owner):
        page = as_(user).get(address)
        text = page.content.decode()
        assert page.status_code == 200
        assert "Sealed" in text
        assert "16/16" in text
        assert plan.commitment in text
        for secret in (
            plan.question,
            "pi0-new",
            "pi0-block",
            "<svg class",
            "succeeded",
            bytes(plan.key).hex(),
        ):
            assert secret not in text


@pytest.mark.parametrize(
    "rest",
    [
        "results",
        "results/pi0-new",
        "comparison?first=a&second=b",
        "outcomes",
        "outcomes?format=csv",
        "scores",
        "ratings",
        "preferences",
    ],
)
def test_nor_does_a_program(plan, owner, carry_out, as_, rest):
    carry_out(plan, 4)
    answer = as_(owner).get(f"/api/v1/plans/blocks/1/{rest}")
    assert answer.status_code == 403
    assert "is blind until it is revealed" in answer.json()["error"]
    assert as_(owner).get(f"{PLAN}report.zip").status_code == 403


def test_the_owner_looks_by_an_act_of_their_own(plan, owner, bench, carry_out, as_):
    carry_out(plan, 16)
    client = as_(owner)
    assert "Look behind the blind" in client.get(PLAN).content.decode()
    assert as_(bench.operator).post(f"{PLAN}look").status_code == 403
    assert client.post(f"{PLAN}look").status_code == 302
    assert "pi0-new" in client.get(PLAN).content.decode()
    meter = client.get(f"{PLAN}evidence/").content.decode()
    assert "Evidence (e-value) after each pair" in meter
    assert "do not show this page" in meter
    assert "at any time (95 %): by success [" in meter
    assert "Sealed" in as_(bench.operator).get(f"{PLAN}evidence/").content.decode()


@pytest.mark.exhaustive
def test_closed_and_revealed_on_the_page(plan, owner, carry_out, as_, viewer):
    carry_out(plan, 14)
    client = as_(owner)
    refused = client.post(f"{PLAN}reveal")
    assert refused.status_code == 409
    assert "closed first" in refused.content.decode()
    assert client.post(f"{PLAN}close", {"reason": ""}).status_code == 400
    assert client.post(f"{PLAN}close", {"reason": "all made"}).status_code == 302
    assert client.post(f"{PLAN}reveal").status_code == 302
    text = as_(viewer).get(PLAN).content.decode()
    assert bytes(plan.key).hex() in text
    assert "pi0-new" in text


def test_the_page_says_the_comparison_with_n_and_interval(revealed, as_, viewer):
    text = as_(viewer).get(PLAN).content.decode()
    found = caching.cached_analysis(revealed).comparisons[0]
    assert f"difference {100 * found.difference.value:.0f} points [" in text
    for method in (
        "Newcombe",
        "Barnard",
        "McNemar",
        "e-process",
        "confidence sequence, 95 %",
        "uniform priors",
        "would be missed",
        "the plan's own interval",
    ):
        assert method in text
    assert text.count('<svg class="drawing') >= 7
    assert "Clopper-Pearson" in text
    assert "Holm" in text


@pytest.mark.parametrize(
    ("rule", "outcome", "own"),
    [
        ("none", "success", ["How much better?"]),
        ("none", "score", []),
        ("evidence", "success", ["How much better, at any time?"]),
        ("evidence", "score", ["With partial credit, how much at any time?"]),
        ("late", "success", []),  # that of its boundary stands with the headline
    ],
)
def test_of_several_intervals_the_plans_own_is_marked(revealed, rule, outcome, own):
    revealed.stopping = rule
    revealed.document["stopping"] |= {"rule": rule, "outcome": outcome}
    result = PlanResult(revealed)
    facts = comparison_facts(result, result.analysis.comparisons[0])["facts"]
    assert [fact.question for fact in facts if fact.own] == own


def test_every_number_leads_to_its_trials(revealed, as_, viewer):
    client = as_(viewer)
    arm = caching.cached_analysis(revealed).arms[0]
    listed = client.get(f"{PLAN}trials/?checkpoint={arm.checkpoint}&success=yes")
    assert f'<span class="muted">{arm.success.successes} trial' in listed.content.decode()
    failed = client.get(f"{PLAN}trials/?failure=%3Ddropped&success=no").content.decode()
    assert "=dropped" in failed
    assert "success</span>" not in failed
    missed = client.get(f"{PLAN}trials/?missed=lifted").content.decode()
    assert "Without the milestone: lifted" in missed
    wrong = client.get(f"{PLAN}trials/?success=maybe")
    assert wrong.status_code == 400
    assert "allowed: yes, no" in wrong.content.decode()


@pytest.mark.exhaustive
def test_every_count_of_failures_leads_to_its_trials_and_all_failures_are_counted(
    revealed, as_, viewer, bench
):
    builders.failure_terms()
    failed = list(Trial.objects.filter(verdict__success=False).order_by("pk"))
    said = [{"failure_phase": "grasp", "failure": "dropped"}, {"failure_phase": "approach"}, {}]
    for trial, given in zip(failed, said, strict=False):
        ticks = bench.ticks(True, False, False)
        services.score_trial(
            user=bench.operator, trial=trial, milestones=ticks, reason="on the video", **given
        )
    client = as_(viewer)
    text = client.get(PLAN).content.decode()
    part = text[text.index('id="why-head"') : text.index('id="changes-head"')]
    assert "Not planned: a lead for another evaluation" in part
    assert "Clopper-Pearson" in part
    counts = re.findall(r'<a href="([^"]+)">(\d+)</a>', part)
    for address, n in counts:
        listed = client.get(unescape(address)).content.decode()
        assert f'<span class="muted">{n} trial' in listed, address
    assert {"failure=not+specified", "failure_phase=grasp", "failure=%3Ddropped"} <= {
        named for address, _ in counts for named in unescape(address).partition("?")[2].split("&")
    }
    tables = re.findall(r'<tr><th scope="row">all</th>(.*?)</tr>', part)
    totals = [re.findall(r">(\d+)</a>", row)[-1] for row in tables]
    assert sum(map(int, totals)) == len(failed)
    assert part.count('<svg class="drawing pareto"') == len(tables) == 2


def test_filters_are_in_the_address_and_wrong_ones_are_named(revealed, as_, viewer):
    client = as_(viewer)
    part = client.get(f"{PLAN}?position=1").content.decode()
    assert "Only some of the trials" in part
    assert "/4, " in part
    wrong = client.get(f"{PLAN}?scene=none")
    assert wrong.status_code == 400
    assert "allowed: block-on-plate" in wrong.content.decode()
    assert client.get(f"{PLAN}compare/?first=pi0-new&second=nobody").status_code == 400
    assert client.get("/result/plans/blocks/7/").status_code == 404


def test_pairs_stand_beside_each_other_with_their_last_pictures(revealed, as_, viewer):
    Episode.objects.update(fps=30.0)
    text = as_(viewer).get(f"{PLAN}compare/?first=pi0-new&second=pi0-block").content.decode()
    assert text.count('class="pair-side"') == 16
    assert text.count('data-still="12.483"') == 16  # the middle of the last of 375 rows
    gone = Episode.objects.filter(trial__checkpoint__name="pi0-new").first()
    preview_folder(gone.uuid).rmdir()
    text = as_(viewer).get(f"{PLAN}compare/").content.decode()
    assert (text.count("data-still"), text.count("no pictures here")) == (15, 1)
    assert text.count("Replay side by side") == 8


def test_only_what_differs_and_the_grid_are_in_the_address(revealed, as_, viewer):
    client = as_(viewer)
    whole = client.get(f"{PLAN}compare/").content.decode()
    differing = int(re.search(r"8 pairs, (\d+) differ", whole)[1])
    assert 0 < differing < 8
    part = client.get(f"{PLAN}compare/?differs=1").content.decode()
    assert part.count('class="pair-side"') == 2 * differing
    assert 'href="?#pairs-head">Show all pairs' in part
    grid = client.get(f"{PLAN}compare/?differs=1&view=grid").content.decode()
    assert "pair-table" not in grid
    assert grid.count('class="pair-side"') == 2 * differing
    assert '<input type="hidden" name="view" value="grid">' in grid
    for query, said in (
        ("differs=yes", "differs = &#x27;yes&#x27;; allowed: 1"),
        ("view=list", "allowed: table, grid"),
    ):
        answer = client.get(f"{PLAN}compare/?{query}")
        assert (answer.status_code, said in answer.content.decode()) == (400, True)


def test_side_by_side_lists_pairs_of_the_same_condition(revealed, as_, viewer):
    text = as_(viewer).get(f"{PLAN}compare/").content.decode()
    assert "8 pairs" in text
    assert text.count("block-on-plate/") >= 8


@pytest.mark.exhaustive
def test_a_correction_and_a_void_are_seen_at_once(plan, owner, bench, carry_out, as_):
    carry_out(plan, 15)
    client = as_(owner)
    client.post(f"{PLAN}look")
    assert "15/16" in client.get(PLAN).content.decode()
    before = caching.cached_analysis(plan)
    assert caching.cached_analysis(plan) is before
    trial = plan.handouts.first().trial
    flipped = not trial.verdict.success
    services.score_trial(
        user=bench.operator,
        trial=trial,
        milestones=bench.ticks(True, flipped, flipped),
        reason="seen on the video",
    )
    after = caching.cached_analysis(plan)
    assert sum(a.success.successes for a in after.arms) != sum(a.success.successes for a in before.arms)
    voids.void_trial(user=bench.operator, trial=plan.handouts.last().trial, reason="a camera had moved")
    assert caching.cached_analysis(plan).n == 14
    Checkpoint.objects.filter(name="pi0-new").update(name="renamed")
    plan.refresh_from_db()
    assert "renamed" in {arm.checkpoint for arm in caching.cached_analysis(plan).arms}


def test_another_blind_plan_of_the_same_checkpoint_hides_the_results(revealed, owner, bench, as_, viewer):
    from evaweb.plans.models import Plan
    from evaweb.plans.services import freeze_plan

    again = Plan.objects.create(name="again", title="Again", owner=owner)
    again.checkpoints.set(revealed.checkpoints.all())
    again.positions.set(bench.scene.positions.all())
    freeze_plan(user=owner, plan=again)
    text = as_(viewer).get(PLAN).content.decode()
    assert "compared blind in Again v1" in text
    assert "ask its owner, olga, or an administrator to close and reveal it" in text
    assert "pi0-new" not in text
    assert (
        "close and reveal it there, or look behind its blind there" in as_(owner).get(PLAN).content.decode()
    )
    assert (
        "compared blind in Again v1"
        in as_(viewer).get(f"/api/v1{PLAN.removeprefix('/result')}results").json()["error"]
    )
    third = Checkpoint.objects.create(name="pi0-third", policy={})
    apart = Plan.objects.create(name="apart", title="Apart", owner=owner)
    apart.checkpoints.set([third])
    apart.positions.set(bench.scene.positions.all())
    freeze_plan(user=owner, plan=apart)
    both = as_(viewer).get(PLAN).content.decode()
    assert "compared blind in one or more of Again v1, Apart v1" in both  # which of them is not said
    assert "pi0-third" not in both
    close_plan(user=owner, plan=again, reason="not now")


def test_what_is_wide_on_the_labs_page_scrolls_by_itself(plan, bench, carry_out, as_):
    carry_out(plan, 1)
    page = as_(bench.operator).get("/result/lab/").content.decode()
    assert 0 < page.count("<table") == page.count('<div class="table-scroll"><table')


def test_lab_and_wall_name_no_checkpoint_of_a_blind_plan(plan, bench, carry_out, as_):
    carry_out(plan, 3)
    client = as_(bench.operator)
    for address in ("/result/lab/", "/result/wall/"):
        for headers in ({}, {"HTTP_HX_REQUEST": "true"}):
            text = client.get(address, **headers).content.decode()
            assert "Blocks" in text
            assert "pi0-new" not in text
            assert "pi0-block" not in text
    assert "<button" not in client.get("/result/wall/", HTTP_HX_REQUEST="true").content.decode()
    assert "success" not in client.get("/result/lab/", HTTP_HX_REQUEST="true").content.decode()


def test_the_wall_comes_with_its_alarms(bench, as_):
    text = as_(bench.operator).get("/result/wall/").content.decode()
    assert "Needs attention" in text  # what came later would push all the rest down


def test_queries_do_not_grow_with_trials(plan, owner, carry_out, as_):
    client = as_(owner)
    client.post(f"{PLAN}look")

    def asked():
        caching.clear_caches()
        found = []
        for address in (PLAN, f"{PLAN}compare/", f"{PLAN}trials/", "/result/lab/", "/result/plans/"):
            with CaptureQueriesContext(connection) as captured:
                assert client.get(address).status_code == 200
            found.append(len(captured))
        return found

    carry_out(plan, 4)
    few = asked()
    carry_out(plan, 10)
    assert asked() == few
    assert max(few) <= 53


def test_the_report_comes_as_an_archive(revealed, as_, viewer):
    answer = as_(viewer).get(f"{PLAN}report.zip")
    names = zipfile.ZipFile(io.BytesIO(answer.content)).namelist()
    assert {"blocks-v1/index.html", "blocks-v1/data/numbers.json", "blocks-v1/recompute/__main__.py"} <= set(
        names
    )


def test_rating_again_shows_the_code_and_nothing_that_was_said(plan, carry_out, as_):
    carry_out(plan, 16)
    rater = builders.user("rita")
    client = as_(rater)
    handout, _ = rating_queue.next_to_rate(rater)[:2]
    text = client.get("/result/rate/").content.decode()
    assert handout.code in text
    for secret in ("pi0-new", "pi0-block", "=dropped", f"/result/trials/{handout.trial_id}"):
        assert secret not in text
    given = {"plan": "blocks", "version": "1", "code": handout.code, "success": ""}
    assert client.post("/result/rate/", given).status_code == 302
    assert handout.trial.ratings.get().success is False
    assert client.post("/result/rate/", given).status_code == 302, "sent twice it is one rating"
    assert client.post("/result/rate/", {**given, "note": "slips"}).status_code == 409
    assert client.post("/result/rate/", {**given, "version": "x"}).status_code == 400


def test_a_rating_that_is_refused_keeps_its_ticks_and_another_trial_gets_none_of_them(
    plan, carry_out, as_, bench
):
    carry_out(plan, 16)
    rater = builders.user("rita")
    client = as_(rater)
    handout, _ = rating_queue.next_to_rate(rater)[:2]
    first = bench.scene.milestones.order_by("order").first()
    given = {
        "plan": "blocks",
        "version": "1",
        "code": handout.code,
        "milestone": first.pk,
        "note": "n" * 9000,
    }
    ticked = f'value="{first.pk}" checked'
    refused = client.post("/result/rate/", given)
    assert refused.status_code == 400
    assert ticked in refused.content.decode()
    assert client.post("/result/rate/", {**given, "note": "slow"}).status_code == 302
    twice = client.post("/result/rate/", {**given, "note": "slow"}).content.decode()
    assert ticked not in twice
    assert "slow" not in twice


def test_without_pictures_nothing_is_judged(plan, carry_out, as_):
    carry_out(plan, 16)
    client = as_(builders.user("rita"))
    for episode in Episode.objects.all():
        preview_folder(episode.uuid).rmdir()
    for page in ("rate", "prefer"):
        text = client.get(f"/result/{page}/").content.decode()
        assert "What is left for you has no pictures on this machine" in text
        assert "Skipped, because they have no pictures on this machine" in text
    Episode.objects.update(frames=9)
    for episode in Episode.objects.all():
        journal_folder(episode.uuid).mkdir(parents=True)
    for page in ("rate", "prefer"):
        text = client.get(f"/result/{page}/").content.decode()
        assert "pictures are needed to judge" in text
        assert 'disabled aria-describedby="unable"' in text


def test_preferring_asks_why(plan, carry_out, as_):
    carry_out(plan, 16)
    rater = builders.user("rita")
    client = as_(rater)
    pair, _ = rating_queue.next_to_compare(rater)[:2]
    text = client.get("/result/prefer/").content.decode()
    assert pair.first.code in text
    assert "pi0" not in text
    given = {
        "plan": "blocks",
        "version": "1",
        "first": pair.first.code,
        "second": pair.second.code,
        "outcome": "first",
    }
    assert client.post("/result/prefer/", {**given, "why": ""}).status_code == 400
    assert client.post("/result/prefer/", {**given, "why": "gentler"}).status_code == 302
    assert plan.preferences.count() == 1


@pytest.mark.exhaustive
def test_the_planner_answers_and_names_what_is_not_allowed(as_, viewer):
    client = as_(viewer)
    text = client.get("/result/planner/?rate=0.5&better=0.7").content.decode()
    for word in ("fixed", "anytime", "group sequential late", "group sequential early"):
        assert word in text
    for query in ("rate=2", "rate=x", "rate=0.5&better=0.5", "stations=0", "comparing=each"):
        wrong = client.get(f"/result/planner/?{query}")
        assert wrong.status_code == 400
        assert 'role="alert"' in wrong.content.decode()


def test_the_planner_shows_its_form_at_once_and_asks_again_by_itself(as_, viewer, monkeypatch):
    never = Questions(lambda work, *given: (work(*given), 0.0), soon_s=0)
    monkeypatch.setattr(computations, "questions", never)
    client, address = as_(viewer), "/result/planner/?rate=0.5&better=0.7"
    answer = client.get(address)
    assert (answer.status_code, "Computing" in answer.content.decode()) == (200, True)
    assert f'hx-get="{address.replace("&", "&amp;")}"' in answer.content.decode()
    eventually(lambda: "anytime" in client.get(address).content.decode(), "what was asked for")


def test_a_pace_that_runs_backwards_is_none(plan):
    begun = timezone.now()
    row = PlanRow(plan, 16, 4, 4, begun, begun + timedelta(hours=2))
    assert row.hours_left == pytest.approx(6.0)
    assert replace(row, until=begun - timedelta(hours=2)).hours_left is None
    assert replace(row, counted=16).hours_left is None


def test_smoothness_stands_with_its_interval_and_how_many_trials_it_is_of(revealed, as_, viewer):
    text = as_(viewer).get(PLAN).content.decode()
    assert "Smoothness, SPARC" in text
    assert text.count("−5.30 [−5.39, −5.21], 6 of 8 trials") == 3  # one of them as what was sent
    assert "as sent −4.80 [−4.89, −4.71], 6 of 8 trials" in text
    mine = Episode.objects.filter(trial__handout__plan=revealed)
    mine.update(smoothness=None, smoothness_commanded=None)
    again = as_(viewer).get(PLAN).content.decode()
    assert "6 of 8 trials" not in again
    assert "as sent" not in again


def test_a_smoothness_that_is_measured_later_is_shown(revealed, as_, viewer):
    before = caching.cached_analysis(revealed).arm("pi0-new").smoothness
    missing = Episode.objects.filter(trial__handout__plan=revealed, smoothness=None).first()
    Episode.objects.filter(pk=missing.pk).update(smoothness=-9.0)
    after = [arm.smoothness for arm in caching.cached_analysis(revealed).arms]
    assert (before.n, sorted(found.n for found in after)) == (6, [6, 7])


def test_a_draft_says_what_a_freeze_makes_of_it(bench, owner, as_):
    from evaweb.plans.models import Plan

    draft = Plan.objects.create(name="drafted", title="Drafted", owner=owner, repetitions=3)
    draft.checkpoints.set([bench.checkpoint])
    draft.positions.set(bench.scene.positions.all())
    text = as_(owner).get("/result/plans/drafted/1/").content.decode()
    assert "0/0" not in text
    assert "none yet: a draft" in text
    assert "Continue this draft" in text
    assert "/freeze/" not in text
    steps = as_(owner).get("/result/plans/drafted/1/draft/").content.decode()
    assert "2 positions × 3 × 1 checkpoint" in steps
    assert "Freeze “Drafted”, version 1?" in steps
    assert "Only an amended version changes them" in steps
