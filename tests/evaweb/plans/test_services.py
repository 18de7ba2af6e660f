from collections import Counter

import pytest
from django.db import IntegrityError, transaction

from evaweb.blinding.visibility import HIDDEN, visibility_for_user
from evaweb.core.canonical_json import digest
from evaweb.core.errors import Conflict, EvaError, NotAllowed
from evaweb.episodes.reconcile import reconcile
from evaweb.plans.allocation import allocate_trial, plan_progress, release_slots
from evaweb.plans.blinding_rules import is_sealed_for, record_unblinding
from evaweb.plans.commitment import make_commitment, schedule_digest
from evaweb.plans.frozen_document import conditions_of, scene_of
from evaweb.plans.models import Handout, Look, Plan, PlanEvent, PlanState, Slot
from evaweb.plans.schedule import schedule
from evaweb.plans.services import amend_plan, close_plan, freeze_plan, reveal_plan
from evaweb.results.presentation.integrity import integrity_document
from evaweb.stations.models import Station
from evaweb.trials import services as trials
from evaweb.trials.models import Checkpoint, Milestone, Scene, Trial
from runtime.benches.schema import FILE, FOLDER, load_schema
from tests.evaweb.trials import builders
from tests.evaweb.unguarded import without_triggers


def done(bench, trial, success=True):
    """As if it had been run and scored."""
    builders.finished_trial(trial, 10.0)
    trials.score_trial(user=bench.operator, trial=trial, milestones=bench.ticks(True, success, success))


@pytest.fixture
def plan(draft, owner):
    return freeze_plan(user=owner, plan=draft)


def test_frozen_it_is_a_document_with_a_schedule(plan):
    assert plan.state == PlanState.FROZEN
    assert plan.digest == digest(plan.document)
    assert plan.document["scenes"][0]["milestones"][2]["text"] == "on the plate"
    assert [(row["name"], row["policy"]["url"]) for row in plan.document["checkpoints"]] == [
        ("pi0-block", "ws://127.0.0.1:8000"),
        ("pi0-new", "ws://127.0.0.1:8001"),
    ]
    assert plan.slots.count() == 12
    cells = Counter(plan.slots.values_list("checkpoint__name", "position__number"))
    assert set(cells.values()) == {3}
    assert plan.commitment in plan.events.get(what="frozen").text
    assert plan.evaluation.kind == "plan"


def test_what_is_missing_is_said_before_it_is_frozen(draft, owner, bench):
    draft.positions.clear()
    with pytest.raises(EvaError, match="has no position"):
        freeze_plan(user=owner, plan=draft)
    draft.positions.set(bench.scene.positions.all())
    Plan.objects.filter(pk=draft.pk).update(second=None)
    with pytest.raises(EvaError, match="needs two checkpoints, or none"):
        freeze_plan(user=owner, plan=draft)
    Plan.objects.filter(pk=draft.pk).update(first=None, stopping="evidence")
    with pytest.raises(EvaError, match="needs the comparison"):
        freeze_plan(user=owner, plan=draft)
    draft.checkpoints.clear()
    with pytest.raises(EvaError, match="has no checkpoint"):
        freeze_plan(user=owner, plan=draft)
    assert Plan.objects.get(pk=draft.pk).state == PlanState.DRAFT


def test_only_its_owner_or_an_administrator_freezes_it(draft):
    with pytest.raises(NotAllowed, match="is olga's"):
        freeze_plan(user=builders.user("eve"), plan=draft)
    with pytest.raises(NotAllowed, match="needs an operator"):
        freeze_plan(user=builders.user("vera", "viewer"), plan=draft)
    assert freeze_plan(user=builders.user("adam", "admin"), plan=draft).state == PlanState.FROZEN


def test_a_plan_that_was_lost_is_frozen_again_by_an_administrator_and_revealed(bench, plan, draft):
    """Its trials are its own again, more are made with an amendment alone."""
    adam, again = (
        builders.user("adam", "admin"),
        {"name": plan.name, "title": plan.title, "owner": draft.owner},
    )
    trial = allocate_trial(user=bench.operator, station=bench.station, plan=plan).trial
    done(bench, trial)
    chosen = {name: list(getattr(plan, name).all()) for name in ("checkpoints", "positions")}
    with without_triggers("plans"):
        for model in (PlanEvent, Handout, Slot):
            model.objects.all().delete()
        plan.delete()
    (told,) = (each for each in reconcile().problems if " of plan " in each)
    assert told.startswith("1 trials are of plan blocks v1, which is not in the database: ")
    assert all(visibility_for_user(user).hides(trial) for user in (bench.operator, draft.owner, adam))
    assert visibility_for_user(bench.operator).checkpoint_label(trial) == HIDDEN
    made = Plan.objects.create(**again)
    for name, rows in chosen.items():
        getattr(made, name).set(rows)
    with pytest.raises(NotAllowed):
        freeze_plan(user=draft.owner, plan=made)
    freeze_plan(user=adam, plan=made)
    assert (made.state, made.evaluation_id) == (PlanState.CLOSED, trial.evaluation_id)
    assert visibility_for_user(draft.owner).hides(trial)
    Plan.objects.update(owner=bench.operator)
    with pytest.raises(NotAllowed, match="you have run trials"):
        record_unblinding(made, bench.operator)
    reveal_plan(user=adam, plan=made)
    assert not visibility_for_user(bench.operator).hides(trial)
    assert not any(" of plan " in each for each in reconcile().problems)


def test_what_a_frozen_plan_foresees_and_where_it_stands_is_never_changed_back(plan, owner):
    for change in ({"checkpoint": plan.second}, {"position": plan.slots.last().position}, {"repetition": 9}):
        with pytest.raises(IntegrityError, match="never"), transaction.atomic():
            plan.slots.update(**change)
    for state in ("draft", "revealed"):
        with pytest.raises(IntegrityError, match="never"), transaction.atomic():
            Plan.objects.filter(pk=plan.pk).update(state=state)
    close_plan(user=owner, plan=plan, reason="enough")
    reveal_plan(user=owner, plan=plan)
    with pytest.raises(IntegrityError, match="never"), transaction.atomic():
        Plan.objects.filter(pk=plan.pk).update(state="frozen")


def test_trials_come_in_the_order_of_the_plan_each_under_a_code_of_its_own(bench, plan):
    handed = []
    for _ in range(12):
        handout = allocate_trial(user=bench.operator, station=bench.station, plan=plan)
        handed.append(handout)
        done(bench, handout.trial)
    assert [h.slot.index for h in handed] == list(range(12))
    assert len({h.code for h in handed}) == 12
    assert [h.trial.checkpoint_id for h in handed] == list(plan.slots.values_list("checkpoint_id", flat=True))
    plan.refresh_from_db()
    assert plan.state == PlanState.CLOSED
    assert plan.closed_because == "all pairs of its comparison are made, after 6 pairs"
    with pytest.raises(
        Conflict, match="Blocks v1 has ended: all pairs of its comparison are made, after 6 pairs"
    ):
        allocate_trial(user=bench.operator, station=bench.station, plan=plan)
    assert (plan_progress(plan).counted, plan_progress(plan).attempts) == (12, 12)


def test_one_block_meets_the_same_conditions(bench, plan):
    first = allocate_trial(user=bench.operator, station=bench.station, plan=plan)
    done(bench, first.trial)
    second = allocate_trial(user=bench.operator, station=bench.station, plan=plan)
    assert first.trial.checkpoint_id != second.trial.checkpoint_id
    for name in ("position_id", "number", "seed", "instruction"):
        assert getattr(first.trial, name) == getattr(second.trial, name)


def test_what_does_not_count_is_repeated_under_another_code(bench, plan):
    first = allocate_trial(user=bench.operator, station=bench.station, plan=plan)
    Trial.objects.filter(pk=first.trial_id).update(status="interrupted", reason="the e-stop was pressed")
    again = allocate_trial(user=bench.operator, station=bench.station, plan=plan)
    assert again.slot == first.slot
    assert again.trial.attempt == 2
    assert again.code != first.code
    assert again.reason == "attempt 1 was interrupted: the e-stop was pressed"


def test_a_station_with_an_unfinished_trial_gets_no_other(bench, plan):
    allocate_trial(user=bench.operator, station=bench.station, plan=plan)
    with pytest.raises(Conflict, match="is prepared: run it, or abandon it"):
        allocate_trial(user=bench.operator, station=bench.station, plan=plan)
    assert plan.handouts.count() == 1


def test_several_stations_share_a_plan_block_by_block(bench, plan):
    other = Station.objects.create(name="bench-2", robot="agilex_piper", simulated=True, boot="b")
    blocks = {bench.station.pk: set(), other.pk: set()}
    for _ in range(6):
        for station in (bench.station, other):
            handout = allocate_trial(user=bench.operator, station=station, plan=plan)
            blocks[station.pk].add(handout.slot.block)
            done(bench, handout.trial)
    assert not blocks[bench.station.pk] & blocks[other.pk]
    assert len(blocks[bench.station.pk]) == len(blocks[other.pk]) == 3


def test_what_a_broken_station_has_not_begun_is_given_to_others(bench, plan, owner):
    other = Station.objects.create(name="bench-2", robot="agilex_piper", simulated=True, boot="b")
    done(bench, allocate_trial(user=bench.operator, station=bench.station, plan=plan).trial)
    assert release_slots(user=owner, plan=plan, station=bench.station, reason="its gripper broke") == 1
    handout = allocate_trial(user=bench.operator, station=other, plan=plan)
    assert (handout.slot.index, handout.trial.station) == (1, other)


def test_who_has_looked_at_another_plan_of_the_same_checkpoints_runs_none_of_this_one(bench, draft, owner):
    def twin(name, checkpoints):
        made = Plan.objects.create(name=name, title=name, question="And?", owner=owner, repetitions=3)
        made.checkpoints.set(checkpoints)
        made.positions.set(bench.scene.positions.all())
        return freeze_plan(user=owner, plan=made)

    both = list(draft.checkpoints.all())
    others = [
        Checkpoint.objects.create(name=f"other-{n}", policy={"url": f"ws://127.0.0.1:{n}"}) for n in (1, 2)
    ]
    plan = freeze_plan(user=owner, plan=draft)
    record_unblinding(twin("elsewhere", [both[0], *others]), owner)
    trial = allocate_trial(user=owner, station=bench.station, plan=plan).trial
    done(bench, trial)
    record_unblinding(twin("again", both), alma := builders.user("alma", "admin"))
    with pytest.raises(NotAllowed, match="you have seen results"):
        allocate_trial(user=alma, station=bench.station, plan=plan)
    record = integrity_document(plan)
    assert [(row["plan"], row["version"], row["trials"]) for row in record["beside"]] == [("again", 1, 0)]
    assert any("again v1 (0 trials)" in said for said in record["remarks"])


def test_a_plan_for_some_stations_is_not_carried_out_on_others(bench, draft, owner):
    other = Station.objects.create(name="bench-2", robot="agilex_piper", simulated=True, boot="b")
    draft.stations.set([other])
    plan = freeze_plan(user=owner, plan=draft)
    with pytest.raises(Conflict, match="is for bench-2, not for bench-1"):
        allocate_trial(user=bench.operator, station=bench.station, plan=plan)


def test_another_bench_of_the_scene_stops_the_plan(bench, plan, draft, owner, tmp_path):
    Scene.objects.update(bench="sorting")
    with pytest.raises(Conflict, match=r"bench was None, is 'sorting'"):
        allocate_trial(user=bench.operator, station=bench.station, plan=plan)


def test_the_content_of_a_bench_of_ones_own_belongs_to_the_plan(bench, draft, owner, tmp_path):
    for number, radius in ((1, "0.075"), (2, "0.08")):
        (tmp_path / f"bench{number}").mkdir()
        text = (FOLDER / "tabletop" / FILE).read_text().replace("radius = 0.075", f"radius = {radius}")
        (tmp_path / f"bench{number}" / FILE).write_text(text)
    own = tmp_path / "bench"
    own.symlink_to(tmp_path / "bench1")
    Scene.objects.update(bench=str(own))
    plan = freeze_plan(user=owner, plan=draft)
    load_schema.cache_clear()
    own.unlink()
    own.symlink_to(tmp_path / "bench2")
    with pytest.raises(Conflict, match="bench_digest was 'sha256:"):
        allocate_trial(user=bench.operator, station=bench.station, plan=plan)


def test_a_scene_or_a_checkpoint_that_was_changed_stops_the_plan(bench, plan):
    milestone = bench.scene.milestones.first()
    milestone.points = 5
    milestone.save()
    with pytest.raises(Conflict, match="scene block-on-plate was changed since"):
        allocate_trial(user=bench.operator, station=bench.station, plan=plan)
    milestone.points = 1
    milestone.save()
    for checkpoint in plan.checkpoints.all():
        checkpoint.policy = {"url": "ws://127.0.0.1:9"}
        checkpoint.save()
    with pytest.raises(Conflict, match="a checkpoint was changed since") as said:
        allocate_trial(user=bench.operator, station=bench.station, plan=plan)
    assert not any(row.name in str(said.value) for row in plan.checkpoints.all())
    plan.checkpoints.update(active=False)
    with pytest.raises(Conflict, match="is switched off") as said:
        allocate_trial(user=bench.operator, station=bench.station, plan=plan)
    assert not any(row.name in str(said.value) for row in plan.checkpoints.all())


CHANGES = {  # of a scene, each with what is said of it
    "required": (
        lambda scene: scene.milestones.filter(order=1).update(required=True),
        "milestone 1: required was False",
    ),
    "points": (lambda scene: scene.milestones.filter(order=2).update(points=7), "milestone 2: points was"),
    "one more": (
        lambda scene: Milestone.objects.create(scene=scene, order=9, text="and back", points=1),
        "milestone 9 is new",
    ),
    "criterion": (
        lambda scene: Scene.objects.filter(pk=scene.pk).update(criterion="anything"),
        "criterion was",
    ),
    "order": (
        lambda scene: Scene.objects.filter(pk=scene.pk).update(ordered=True),
        "ordered was False, is True",
    ),
}


@pytest.mark.parametrize("change", CHANGES)
def test_a_trial_is_scored_and_corrected_by_the_scene_that_was_frozen_and_by_no_other(bench, plan, change):
    trial = allocate_trial(user=bench.operator, station=bench.station, plan=plan).trial
    before = scene_of(bench.scene, list(bench.scene.positions.all()))
    builders.finished_trial(trial, 10.0)
    changed, said = CHANGES[change]

    ticks = bench.ticks(True, True, True)

    def score(**words):
        return trials.score_trial(user=bench.operator, trial=trial, milestones=ticks, **words)

    with transaction.atomic():
        changed(bench.scene)
        with pytest.raises(Conflict, match=f"scene block-on-plate was changed since .*{said}"):
            score()
        assert not trial.scores.exists()
        transaction.set_rollback(True)
    assert scene_of(Scene.objects.get(), list(bench.scene.positions.all())) == before
    assert score().success
    changed(bench.scene)
    with pytest.raises(Conflict, match=said):
        score(reason="looked again")
    assert trial.scores.count() == 1


def test_an_amendment_is_the_next_version_and_ends_the_one_before(bench, plan, owner):
    with pytest.raises(EvaError, match="reason is empty"):
        amend_plan(user=owner, plan=plan, reason=" ")
    draft = amend_plan(user=owner, plan=plan, reason="the plate was replaced")
    assert (draft.version, draft.state) == (2, PlanState.DRAFT)
    done(
        bench, allocate_trial(user=bench.operator, station=bench.station, plan=plan).trial
    )  # it goes on meanwhile
    draft.repetitions = 5
    draft.save()
    frozen = freeze_plan(user=owner, plan=draft)
    plan.refresh_from_db()
    assert plan.state == PlanState.CLOSED
    assert "the plate was replaced" in plan.closed_because
    assert "repetitions: 3 -> 5" in frozen.events.get(what="frozen").text
    assert frozen.key != plan.key
    handout = allocate_trial(user=bench.operator, station=bench.station, plan=frozen)
    assert (handout.trial.evaluation.version, handout.trial.number, handout.trial.attempt) == (2, 1, 1)
    with pytest.raises(Conflict, match="no trial of it is handed out"):
        allocate_trial(user=bench.operator, station=bench.station, plan=plan)
    with pytest.raises(Conflict, match="is amended by version 2 already"):
        amend_plan(user=owner, plan=plan, reason="again")


def test_it_is_revealed_once_closed_by_its_owner_and_anybody_can_check(bench, plan, owner):
    handout = allocate_trial(user=bench.operator, station=bench.station, plan=plan)
    with pytest.raises(Conflict, match="it is closed first"):
        reveal_plan(user=owner, plan=plan)
    with pytest.raises(Conflict, match=f"{handout.code} on bench-1 is prepared"):
        close_plan(user=owner, plan=plan, reason="enough")
    done(bench, handout.trial)
    close_plan(user=owner, plan=plan, reason="enough")
    with pytest.raises(NotAllowed):
        reveal_plan(user=bench.operator, plan=plan)
    assert plan.sealed
    plan = reveal_plan(user=owner, plan=plan)
    assert not plan.sealed
    key = bytes.fromhex(plan.events.get(what="revealed").text[4:68])
    units = schedule(
        checkpoints=[row["name"] for row in plan.document["checkpoints"]],
        conditions=conditions_of(plan.document),
        repetitions=plan.document["repetitions"],
        key=key,
    )
    assert make_commitment(digest(plan.document), units, key) == plan.commitment
    assert len(schedule_digest(units)) == 64
    with pytest.raises(Conflict, match="make another plan"):
        amend_plan(user=owner, plan=plan, reason="more")


def test_the_database_itself_keeps_what_was_frozen_and_done(bench, plan):
    handout = allocate_trial(user=bench.operator, station=bench.station, plan=plan)
    for change in (
        lambda: Plan.objects.filter(pk=plan.pk).update(document={**plan.document, "question": "?"}),
        lambda: Plan.objects.filter(pk=plan.pk).update(blind=False),
        lambda: type(handout).objects.filter(pk=handout.pk).update(code="AAAAA"),
        lambda: handout.delete(),
        lambda: plan.events.all().delete(),
    ):
        with pytest.raises(IntegrityError, match="never"), transaction.atomic():
            change()


def test_a_changed_document_is_not_revealed(plan, owner):
    close_plan(user=owner, plan=plan, reason="enough")
    document = {**plan.document, "question": "Is old better?"}
    with without_triggers("plans"):
        Plan.objects.filter(pk=plan.pk).update(document=document)
    with pytest.raises(EvaError, match="someone has changed the database"):
        reveal_plan(user=owner, plan=plan)
    assert Plan.objects.get(pk=plan.pk).state == PlanState.CLOSED


def test_who_runs_trials_does_not_look_and_who_looked_runs_none(bench, plan, owner):
    admin = builders.user("adam", "admin")
    assert is_sealed_for(plan, bench.operator)
    with pytest.raises(NotAllowed, match="blind until its owner, olga, reveals it"):
        record_unblinding(plan, bench.operator)
    assert is_sealed_for(plan, owner)
    assert visibility_for_user(owner).names == {"pi0-block", "pi0-new"}
    record_unblinding(plan, owner)
    record_unblinding(plan, owner)
    assert not is_sealed_for(plan, owner)
    assert visibility_for_user(owner).hides_nothing
    assert plan.events.filter(what="looked", by=owner).count() == 1
    assert Look.objects.filter(plan=plan, user=owner).count() == 1
    with pytest.raises(NotAllowed, match="you have seen results"):
        allocate_trial(user=owner, station=bench.station, plan=plan)
    allocate_trial(user=admin, station=bench.station, plan=plan)
    with pytest.raises(NotAllowed, match="you have run trials of Blocks v1"):
        record_unblinding(plan, admin)


def test_an_open_plan_hides_nothing(bench, draft, owner):
    draft.blind = False
    draft.save()
    plan = freeze_plan(user=owner, plan=draft)
    assert not is_sealed_for(plan, bench.operator)
    record_unblinding(plan, bench.operator)
    assert not plan.looks.exists()
    assert allocate_trial(user=bench.operator, station=bench.station, plan=plan).number == 1


def test_the_database_keeps_a_frozen_plan_with_its_document(plan):
    with pytest.raises(IntegrityError):
        Plan.objects.filter(pk=plan.pk).update(document=None)
