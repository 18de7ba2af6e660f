import pytest

from evaweb.core.errors import EvaError
from evaweb.plans.draft_checks import problems, thoughts
from evaweb.plans.services import amend_plan, freeze_plan
from evaweb.trials.models import Checkpoint, Milestone


def said(rows):
    return {(row.step, row.text) for row in rows}


def test_all_that_is_in_the_way_is_said_and_a_freeze_says_the_first_of_it(draft, owner):
    assert list(problems(draft)) == []
    draft.positions.clear()
    draft.checkpoints.clear()
    found = list(problems(draft))
    assert [row.step for row in found] == ["conditions", "arms", "arms", "arms"]
    with pytest.raises(EvaError, match="has no position: choose initial conditions"):
        freeze_plan(user=owner, plan=draft)
    assert found[0].text == f"{draft} has no position: choose initial conditions"


def test_a_freeze_names_no_checkpoint_that_is_hidden_from_who_asks_for_it(draft, owner):
    """The owner's amendment is of the checkpoints that they compare blind."""
    frozen = freeze_plan(user=owner, plan=draft)
    made = amend_plan(user=owner, plan=frozen, reason="a checkpoint was switched off")
    Checkpoint.objects.filter(name="pi0-new").update(active=False)
    with pytest.raises(EvaError) as refused:
        freeze_plan(user=owner, plan=made)
    assert str(refused.value) == "checkpoint a hidden checkpoint is switched off"


def test_a_design_that_cannot_be_is_said_without_computing_it(draft):
    for changed, words in (
        (
            {"stopping": "late", "repetitions": 200},
            "400 pairs of a design with an exact boundary; allowed: 1 to 250",
        ),
        ({"stopping": "none", "look_after": [3]}, "looks = [3] with the design 'none'"),
        ({"repetitions": 20_000}, "allowed: 20000"),
        ({"repetitions": 2, "allocation": "random"}, "4 blocks of checkpoints in random order; allowed: 5"),
    ):
        for name, value in ({"stopping": "none", "look_after": [], "repetitions": 3} | changed).items():
            setattr(draft, name, value)
        (found,) = problems(draft)
        assert found.step == "design"
        assert words in found.text


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        (
            {"repetitions": 1},
            "2 pairs find nothing: even if one checkpoint won all of them, p = 0.12 is above 0.05.",
        ),
        ({"repetitions": 2, "outcome": "score"}, "4 pairs find nothing"),
        ({"repetitions": 2, "alpha": 0.001}, "is above 0.001."),
        ({"repetitions": 3, "outcome": "score"}, ""),
        ({"repetitions": 3}, ""),
    ],
)
def test_so_few_trials_that_nothing_can_be_found_are_said(draft, changed, words):
    for name, value in changed.items():
        setattr(draft, name, value)
    found = [row.text for row in thoughts(draft) if "find nothing" in row.text]
    assert len(found) == bool(words)
    assert all(words in text for text in found)


def test_a_milestone_that_no_bench_of_ours_reports_is_named(draft, bench):
    milestone = bench.scene.milestones.first()
    Milestone.objects.filter(pk=milestone.pk).update(truth="plced")
    (found,) = [row.text for row in thoughts(draft) if "plced" in row.text]
    assert str(milestone) in found
    assert "grasped, lifted, over_plate, placed" in found


def test_what_a_reader_will_ask_about_is_said_with_the_step_that_answers_it(draft):
    before = said(thoughts(draft))
    assert ("design", "No trial is scored a second time: how well raters agree is not known.") in before
    assert not any(step == "question" for step, _ in before)
    draft.question, draft.blind, draft.first, draft.second = "", False, None, None
    draft.second_rater_share = 0.2
    draft.positions.set(draft.positions.all()[:1])
    Checkpoint.objects.update(digest="sha256:abcdef")
    found = list(thoughts(draft))
    assert {row.step for row in found} == {"question", "arms", "conditions", "design"}
    words = " ".join(row.text for row in found)
    for part in (
        "No question",
        "No comparison",
        "no written criterion",
        "Only one position",
        "The plan is open",
    ):
        assert part in words
    for part in ("No digest", "second time"):
        assert part not in words
