import pytest

from evaweb.blinding.visibility import visibility_for_user
from evaweb.core.errors import Conflict, EvaError, NotAllowed
from evaweb.plans.drafting import HIDDEN, digest_of, merged, values_of
from evaweb.plans.models import Plan
from evaweb.plans.services import freeze_plan, plan_change, plan_draft
from evaweb.trials.models import Checkpoint
from tests.evaweb.trials import builders

SHOWN = {"alpha": 0.05, "repetitions": 3, "title": "Blocks"}


@pytest.mark.parametrize(
    ("now", "wanted", "keep", "written", "conflicts"),
    [
        ({}, {"alpha": 0.01}, (), {"alpha": 0.01}, []),
        ({"alpha": 0.1}, {"alpha": 0.01}, (), {}, ["alpha"]),  # both changed it
        ({"alpha": 0.1}, {"alpha": 0.1}, (), {}, []),  # to the same
        ({"alpha": 0.1}, {"alpha": 0.05, "repetitions": 5}, (), {"repetitions": 5}, []),  # each another one
        ({"alpha": 0.1}, {"alpha": 0.05}, ("alpha",), {"alpha": 0.05}, []),  # said to be written all the same
        ({}, {"nothing": 1}, (), {}, []),
    ],
)
def test_a_change_is_held_against_what_its_author_was_shown(now, wanted, keep, written, conflicts):
    assert merged(SHOWN | now, SHOWN, SHOWN | wanted, keep) == (written, conflicts)


def test_a_change_of_a_draft_is_whole_or_none(draft, owner):
    was = values_of(draft)
    with pytest.raises(EvaError, match="alpha"):
        plan_change(
            user=owner, plan=draft, was=was, wanted={"alpha": 0.9, "repetitions": 9, "checkpoints": []}
        )
    draft.refresh_from_db()
    assert values_of(draft) == was
    changed = plan_change(user=owner, plan=draft, was=was, wanted={"alpha": 0.01})
    assert (changed.now["alpha"], changed.conflicts) == (0.01, ())
    assert digest_of(changed.now) != digest_of(was)


def test_a_draft_is_written_by_its_owner_and_administrators_and_never_once_it_is_frozen(draft, owner, db):
    was = values_of(draft)
    other, admin = builders.user("otto"), builders.user("adam", "admin")
    with pytest.raises(NotAllowed, match="ask them, or an administrator"):
        plan_change(user=other, plan=draft, was=was, wanted={"alpha": 0.01})
    with pytest.raises(NotAllowed, match="made by administrators"):
        plan_draft(user=owner, title="Mine")
    with pytest.raises(NotAllowed):
        plan_change(user=owner, plan=draft, was=was, wanted={"owner": other.pk})
    plan_change(user=admin, plan=draft, was=was, wanted={"owner": other.pk})
    plan = freeze_plan(user=admin, plan=draft)
    with pytest.raises(Conflict, match="only a draft is edited"):
        plan_change(user=admin, plan=plan, was=was, wanted={"alpha": 0.01})


def test_a_control_that_is_hidden_from_who_changes_the_comparison_stays_the_control(draft, owner):
    new, base = draft.first, draft.second
    third = Checkpoint.objects.create(name="third", policy={})
    blind = Plan.objects.create(name="blind", title="Blind", owner=owner, repetitions=1)
    blind.checkpoints.set([base, new])
    blind.positions.set(draft.positions.all())
    freeze_plan(user=owner, plan=blind)
    draft.checkpoints.add(third)
    for comparing, first, second in (("control", base, None), ("pair", None, base)):
        was = values_of(draft, visibility_for_user(owner))
        assert was["control"] == HIDDEN
        plan_change(user=owner, plan=draft, was=was, wanted={"comparing": comparing})
        draft.refresh_from_db()
        assert (draft.comparing, draft.first, draft.second) == (comparing, first, second)
