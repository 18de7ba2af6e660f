"""The page of a draft: who may write it, what of it is saved, what two people make of it, and how it is frozen."""

import json
import re
from threading import Event

import pytest
from django.urls import reverse

from evaweb.plans.counting import ENDS
from evaweb.plans.models import Plan, PlanState
from evaweb.plans.services import amend_plan
from evaweb.results.analysis import power
from evaweb.statistics.score_courses import Scores, score_course
from evaweb.trials.models import Checkpoint
from tests.evaweb.trials import builders
from tests.processes import PATIENCE_S

NEW = "/result/plans/new/"
ON = {
    "kind": "difference",
    "outcome": "success",
    "comparing": "pair",
    "stopping": "none",
    "allocation": "paired",
}


@pytest.fixture
def as_(client):
    def log_in(user):
        client.force_login(user)
        return client

    return log_in


@pytest.fixture
def alma(db):
    return builders.user("alma", "admin")


@pytest.fixture
def two(bench):
    return [bench.checkpoint, Checkpoint.objects.create(name="pi0-new", policy={}, digest="sha256:abcdef")]


@pytest.fixture
def draft(as_, alma):
    """As the page makes it."""
    answer = as_(alma).post(NEW, {"title": "Block on plate", "question": "Is new better?"})
    assert answer.status_code == 302
    return Plan.objects.get(name="block-on-plate")


def address(plan, more=""):
    return f"/result/plans/{plan.name}/{plan.version}/draft/{more}"


def shown(client, plan):
    """What the page was shown, and the form as it is filled in with it."""
    text = client.get(address(plan)).content.decode()
    was = json.loads(re.search(r'id="draft-was" value="([^"]*)"', text)[1].replace("&quot;", '"'))
    form = ON | {
        "title": was["title"], "question": was.get("question", ""), "owner": was["owner"], "alpha": was["alpha"],
        "repetitions": was["repetitions"], "second_rater_share": 100 * was["second_rater_share"],
        "checkpoints": was["checkpoints"], "positions": was["positions"], "control": was["control"],
        "challenger": was["challenger"], "blind": "on" if was["blind"] else "", "comparing": was["comparing"],
        "stopping": was["stopping"], **{name: was[name] for name in ENDS},
    }  # fmt: skip
    return was, {name: value for name, value in form.items() if value != ""}


def saved(client, plan, was, form, **more):
    answer = client.post(
        address(plan), {"was": json.dumps(was), **form, **more}, headers={"HX-Request": "true"}
    )
    plan.refresh_from_db()
    return answer, answer.content.decode()


def filled(client, plan, bench, two):
    """A draft with everything that a freeze needs."""
    was, form = shown(client, plan)
    form |= {
        "checkpoints": [row.pk for row in two],
        "control": str(two[0].pk),
        "positions": [row.pk for row in bench.scene.positions.all()],
        "repetitions": 3,
    }
    return saved(client, plan, was, form)[1]


def test_administrators_begin_plans_and_others_are_told_why_they_do_not(as_, alma, ann, vera):
    for user in (ann, vera):
        client = as_(user)
        refused = client.get(NEW, headers={"Accept": "text/html"})
        assert refused.status_code == 403
        assert "ask one to make it with you as its owner" in refused.content.decode()
        assert client.post(NEW, {"title": "Mine"}).status_code == 403
        assert "Administrators create plans" in client.get("/result/plans/").content.decode()
    assert not Plan.objects.exists()
    client = as_(alma)
    assert f'href="{NEW}"' in client.get("/result/plans/").content.decode()
    assert client.get(NEW).status_code == 200


def test_a_draft_has_a_name_of_its_own_and_the_numbers_of_the_planner(as_, alma):
    client = as_(alma)
    query = {"stopping": "late", "alpha": "0.01", "comparing": "control", "rate": "0.4", "better": "0.6"}
    assert 'name="stopping" value="late"' in client.get(NEW, query).content.decode()
    answers = [client.post(NEW, {"title": title, **query}) for title in ("New", "New", "?!")]
    assert [plan.name for plan in Plan.objects.order_by("pk")] == ["new-2", "new-3", "plan"]
    assert answers[0].headers["Location"].endswith("/draft/?rate=0.4&better=0.6#arms")
    plan = Plan.objects.first()
    assert (plan.stopping, plan.alpha, plan.comparing, plan.owner) == ("late", 0.01, "control", alma)
    for wrong, words in (
        ({"title": ""}, "title"),
        ({"title": "A", "stopping": "soon"}, "stopping = &#x27;soon&#x27;"),
    ):
        refused = client.post(NEW, wrong)
        assert refused.status_code == 400
        assert words in refused.content.decode()


def test_what_is_typed_is_saved_and_answered_with_what_is_missing(as_, alma, draft, bench, two):
    client = as_(alma)
    page = client.get(address(draft)).content.decode()
    assert "no position yet" in page
    assert "has no checkpoint: choose at least one" in page
    text = filled(client, draft, bench, two)
    assert set(draft.checkpoints.all()) == set(two)
    assert (draft.first, draft.second, draft.repetitions) == (two[1], two[0], 3)
    assert "6 trials of each, 12 together" in text
    assert "Freeze “Block on plate”" in text
    assert "one of each checkpoint, order drawn at freezing" in text
    assert "No digest of the weights: pi0-40k." in text or "No digest" in text
    history = client.get(reverse("admin:plans_plan_history", args=[draft.pk])).content.decode()
    assert "changed checkpoints, control, positions, repetitions" in history


def test_a_field_that_cannot_be_is_named_and_the_others_are_saved(as_, alma, draft, bench, two):
    client = as_(alma)
    filled(client, draft, bench, two)
    was, form = shown(client, draft)
    wrong = {"alpha": "0.9", "repetitions": "many", "look_after": "9, 3", "kind": "margin", "margin": ""}
    _, text = saved(client, draft, was, form | wrong | {"title": "Another"})
    assert (draft.title, draft.alpha, draft.repetitions, draft.margin) == ("Another", 0.05, 3, None)
    for name in ("alpha", "repetitions", "look_after", "margin"):
        assert re.search(rf'id="fault-{name}" hx-swap-oob="true">[^<]*ot saved', text), name
    assert "Freeze “Another”" not in text
    long = saved(client, draft, was, {**form, "title": "Another", "look_after": "9" * 5000})[1]
    assert 'id="fault-look_after" hx-swap-oob="true">&#x27;999' in long
    refused = saved(client, draft, was, {**form, "title": "a\u202eb"})[1]
    assert re.search(r'id="fault-title"[^>]*>[^<]*U\+202E', refused)


def test_of_two_people_neither_writes_over_the_other(as_, alma, draft, bench, two):
    client = as_(alma)
    filled(client, draft, bench, two)
    was, form = shown(client, draft)
    saved(client, draft, was, form | {"repetitions": 7})
    _, text = saved(client, draft, was, form | {"repetitions": 5, "question": "Other?"})
    assert (draft.repetitions, draft.question) == (7, "Other?")
    assert "Someone else has changed this draft" in text
    assert '<span class="strong">Trials at each position</span> 7' in text
    assert "Someone else has changed this draft: look at it first." in text
    # What only the other one changed is theirs, however often the first one saves.
    _, text = saved(client, draft, was, form | {"alpha": 0.01, "question": "Other?"})
    assert (draft.repetitions, draft.alpha) == (7, 0.01)
    saved(
        client, draft, was, form | {"repetitions": 5, "alpha": 0.01, "question": "Other?"}, keep="repetitions"
    )
    assert draft.repetitions == 5


def test_it_is_frozen_as_it_was_seen_and_by_its_owner(as_, alma, draft, bench, two):
    client = as_(alma)
    text = filled(client, draft, bench, two)
    seen = re.search(r'name="seen" value="([0-9a-f]{64})"', text)[1]
    assert "12 in all: " in text
    assert "these checkpoints leave everybody" in text
    Plan.objects.filter(pk=draft.pk).update(repetitions=4)
    freeze = reverse("result-freeze", args=[draft.name, 1])
    late = client.post(freeze, {"seen": seen})
    assert late.status_code == 409
    assert "was changed since this page was loaded" in late.content.decode()
    Plan.objects.filter(pk=draft.pk).update(repetitions=3)
    assert as_(bench.operator).post(freeze, {"seen": seen}).status_code == 403
    assert as_(alma).post(freeze, {"seen": seen}).status_code == 302
    power = as_(alma).get(
        address(draft, "power/")
    )  # its page, which goes on asking until the next one is there
    assert (power.status_code, power.content) == (204, b"")
    draft.refresh_from_db()
    assert (draft.state, draft.slots.count()) == (PlanState.FROZEN, 12)
    assert client.get(address(draft)).status_code == 302
    was = {"title": draft.title}
    assert client.post(address(draft), {"was": json.dumps(was), "title": "Other"}).status_code == 409


def test_an_operator_writes_the_draft_that_is_theirs_and_no_other(as_, alma, vera, draft, bench, two):
    assert as_(bench.operator).get(address(draft)).status_code == 404
    assert (
        "Continue this draft"
        not in as_(bench.operator).get("/result/plans/block-on-plate/1/").content.decode()
    )
    client = as_(alma)
    was, form = shown(client, draft)
    saved(client, draft, was, form | {"owner": bench.operator.pk})
    client = as_(bench.operator)
    assert "Continue this draft" in client.get("/result/plans/block-on-plate/1/").content.decode()
    filled(client, draft, bench, two)
    was, form = shown(client, draft)
    saved(client, draft, was, form | {"owner": vera.pk})
    assert draft.owner == bench.operator
    assert "Freeze “Block on plate”" in client.get(address(draft)).content.decode()


def test_checkpoints_that_are_hidden_are_not_told_and_stay(as_, bench, plan, owner):
    """The draft of an amendment of a plan that is blind for its own owner."""
    amended = amend_plan(user=owner, plan=plan, reason="more positions")
    client = as_(owner)
    text = client.get(address(amended)).content.decode()
    names = [row.name for row in plan.checkpoints.all()]
    assert not any(name in text for name in names)
    assert "2 of this plan are hidden from you" in text
    assert 'name="checkpoints"' not in text
    assert plan.question not in text
    was, form = shown(client, amended)
    _, text = saved(client, amended, was, form | {"repetitions": 9})
    assert not any(name in text for name in names)
    assert set(amended.checkpoints.values_list("name", flat=True)) == set(names)
    assert (amended.repetitions, amended.first, amended.second) == (9, plan.first, plan.second)
    assert amended.question == plan.question
    beside = client.get(f"/result/plans/{plan.name}/2/").content.decode()
    assert plan.question not in beside
    assert "more positions" not in beside
    assert client.get(f"/api/v1/plans/{plan.name}?version=2").json()["question"] == ""
    Checkpoint.objects.filter(name=names[0]).update(active=False)
    assert (
        "checkpoint a hidden checkpoint is switched off"
        in client.get(address(amended)).content.decode().lower()
    )


def asked(client, plan, **query):
    """The fragment once all of it is computed."""
    while "progress" in (text := client.get(address(plan, "power/"), query).content.decode()):
        assert '<svg class="drawing power"' in text
    return text


@pytest.mark.exhaustive
def test_the_power_is_that_of_the_draft_at_the_rates_that_are_assumed(as_, alma, draft, bench, two):
    client = as_(alma)
    assert (
        "computed once a comparison and positions are chosen"
        in client.get(address(draft, "power/")).content.decode()
    )
    filled(client, draft, bench, two)
    text = asked(client, draft, rate="0.2", better="0.9", cycle_s="600")
    expected = power.design_power("none", 6, 0.9, 0.2, 0.05).power
    assert f"{100 * expected:.0f} of 100" in text
    assert "6 trials of each" in text
    assert "<dd>2.0</dd>" in text  # hours: 12 trials of ten minutes
    was, form = shown(client, draft)
    saved(client, draft, was, form | {"repetitions": 20})
    assert f"{100 * power.design_power('none', 40, 0.9, 0.2, 0.05).power:.0f} of 100" in asked(
        client, draft, rate="0.2", better="0.9"
    )
    assert "rate and better are both 0.5" in asked(client, draft, rate="0.5", better="0.5")
    saved(client, draft, was, form | {"kind": "margin", "margin": "20"})
    assert "is not worse than 0.5 by 20 points" in asked(client, draft, rate="0.5", better="0.5")


@pytest.mark.exhaustive
def test_the_power_of_scores_is_that_of_their_own_test_and_says_what_is_assumed_of_them(
    as_, alma, draft, bench, two
):
    client = as_(alma)
    filled(client, draft, bench, two)
    was, form = shown(client, draft)
    saved(client, draft, was, form | {"outcome": "score", "repetitions": 10})
    points = sum(bench.scene.milestones.values_list("points", flat=True))
    text = asked(client, draft, rate="0.4", better="0.8", spread="0.35")
    assert f"shares of {points} points, beta-binomial, with means 0.4 and 0.8" in text
    assert "standard deviations 0.35 and 0.35, independent within a pair" in text
    expected = score_course("none", 20, Scores(0.8, 0.4, 0.35, points), 0.05).power
    assert f"{100 * expected:.0f} of 100" in text
    assert "group sequential" not in text
    assert "(as near to 0.5 as such means allow)" in asked(
        client, draft, rate="0.4", better="0.8", spread="0.5"
    )
    assert "allowed: 0.01 to 0.5" in asked(client, draft, rate="0.4", better="0.8", spread="1")


def test_what_nobody_asks_for_any_more_is_given_up(monkeypatch):
    desk, began, superseded = power._Desk(), [], Event()
    question = power.Question(rate=0.2, better=0.9)
    one = power.PowerRequest("none", 6, 0.05, None, (), question, True)
    other = power.PowerRequest("none", 7, 0.05, None, (), question, True)

    def step(asked):
        def run(so_far):
            began.append(asked.pairs)
            if asked is one:
                desk.query("ann", other, 0)
                superseded.set()
            return so_far

        return run

    monkeypatch.setattr(power, "_steps", lambda asked: [step(asked) for _ in range(3)])
    desk.query("ann", one, 0)
    assert superseded.wait(PATIENCE_S)
    assert desk.query("ann", other, 60).whole
    assert began == [6, 7, 7, 7]
    assert desk.query("bob", one, 60).whole
    assert began == [6, 7, 7, 7, 6, 6]


def test_who_is_compared_with_whom_is_said_by_the_control(as_, alma, draft, bench, two):
    client = as_(alma)
    filled(client, draft, bench, two)
    third = Checkpoint.objects.create(name="pi0-third")
    was, form = shown(client, draft)
    form |= {"checkpoints": [row.pk for row in (*two, third)], "control": two[1].pk}
    _, text = saved(client, draft, was, form)
    assert "The comparison needs two checkpoints, or none" in text
    wanted = {"pair": (third, two[1]), "control": (two[1], None), "all": (None, None)}
    for comparing, pair in wanted.items():
        was, form = shown(client, draft)
        form |= {"comparing": comparing, "control": two[1].pk, "challenger": third.pk}
        _, text = saved(client, draft, was, form)
        assert (draft.comparing, (draft.first, draft.second)) == (comparing, pair)
        assert "data-whole" in text
        assert "Freeze “Block on plate”" in text
    was, form = shown(client, draft)
    _, text = saved(client, draft, was, form | {"comparing": "control", "control": ""})
    assert "No control is chosen" in text


def test_the_lines_of_a_question_are_no_change(as_, alma, draft):
    Plan.objects.filter(pk=draft.pk).update(question="one\ntwo")
    client = as_(alma)
    was, form = shown(client, draft)
    Plan.objects.filter(pk=draft.pk).update(question="three")
    _, text = saved(client, draft, was, form | {"question": "one\r\ntwo", "alpha": 0.02})
    assert (draft.question, draft.alpha) == ("three", 0.02)
    assert '<span class="strong">Question</span> three' in text


@pytest.mark.exhaustive
def test_a_row_of_the_planner_begins_a_plan_with_its_numbers(as_, alma, vera):
    planner = "/result/planner/?rate=0.3&better=0.8&alpha=0.02&cycle_s=30"
    assert "Use these numbers" not in as_(vera).get(planner).content.decode()
    client = as_(alma)
    links = re.findall(r'href="(/result/plans/new/\?[^"]*)"', client.get(planner).content.decode())
    assert len(links) == 4
    page = client.get(links[2].replace("&amp;", "&")).content.decode()
    hidden = dict(re.findall(r'type="hidden" name="(\w+)" value="([^"]*)"', page))
    hidden.pop("csrfmiddlewaretoken", None)
    assert hidden == {
        "rate": "0.3", "better": "0.8", "power": "0.8", "cycle_s": "30.0", "alpha": "0.02", "comparing": "all",
        "stopping": "late",
    }  # fmt: skip
    made = client.post(NEW, {"title": "From the planner", **hidden}).headers["Location"]
    assert 'name="cycle_s" min="1" max="36000" step="any" value="30.0"' in client.get(made).content.decode()
