"""A scene is written as a whole: every place that is wrong is named, and nothing is written over unseen."""

from __future__ import annotations

import pytest
from django.contrib.admin.models import LogEntry

from evaweb.core.errors import Conflict, NotAllowed
from evaweb.plans.models import Plan, Reference
from evaweb.plans.services import freeze_plan
from evaweb.stations.models import Station
from evaweb.trials.models import Milestone, Scene
from evaweb.trials.scene_reading import protected_positions, running_plans, scene_digest, scene_table
from evaweb.trials.scene_writing import ChangedMeanwhile, SceneRefused, scene_write
from tests.evaweb.trials import builders

pytestmark = pytest.mark.django_db


@pytest.fixture
def scene(db):
    return builders.scene()


@pytest.fixture
def write(alma, scene):
    """Writes the scene as it is, changed by a function."""

    def written(change, user=alma, seen=None):
        table = scene_table(scene)
        change(table)
        return scene_write(user=user, name=scene.name, given=table, seen=seen or scene_digest(scene))

    return written


def faults(refused):
    return {fault.place: fault.text for fault in refused.value.faults}


def test_a_new_scene_has_its_positions_and_milestones_in_their_order(alma):
    milestones = [{"text": "held"}, {"text": "placed", "points": 2, "required": True}]
    positions = [{"number": 1, "bench": {"block": [0.1, 0.3, 20]}}, {"number": 2, "label": "far"}]
    given = {"name": "cups", "title": "Cups", "instruction": "stack the cups"}
    made, said = scene_write(
        user=alma, name=None, given={**given, "positions": positions, "milestones": milestones}
    )
    assert [row.number for row in made.positions.all()] == [1, 2]
    assert [(row.order, row.text) for row in made.milestones.all()] == [(1, "held"), (2, "placed")]
    assert said == []
    assert LogEntry.objects.get().object_id == str(made.pk)


def test_milestones_change_places_and_stay_the_same_ones(write, scene):
    before = list(scene.milestones.values_list("pk", flat=True))
    write(lambda table: table["milestones"].insert(0, table["milestones"].pop()))
    assert list(scene.milestones.values_list("pk", flat=True)) == [before[2], before[0], before[1]]
    assert list(scene.milestones.values_list("order", flat=True)) == [1, 2, 3]
    write(lambda table: table["milestones"].pop(1))
    assert list(scene.milestones.values_list("order", flat=True)) == [1, 2]


def test_every_place_that_is_wrong_is_named_and_nothing_is_written(write, scene):
    def wrong(table):
        table["title"], table["instruction"] = "", ""

    with pytest.raises(SceneRefused) as refused:
        write(wrong)
    assert set(faults(refused)) == {"title", "instruction"}

    def positions_wrong(table):
        table["title"] = "another"
        table["positions"][0]["bench"] = {"block": [0.5, 0.3, 0]}
        table["positions"][1]["bench"] = {"block": [0.1, 0.3, 0], "plate": [0.1, 0.35]}
        table["milestones"][1]["points"] = 0

    with pytest.raises(SceneRefused) as refused:
        write(positions_wrong)
    told = faults(refused)
    assert (
        "block at x 500, y 300 mm; allowed on a simulated bench: x -220 to 220" in told["positions.0.bench"]
    )
    assert "50 mm apart; allowed: 150 mm or more" in told["positions.1.bench"]
    assert "milestone 2: points" in told["milestones.1.points"]
    scene.refresh_from_db()
    assert scene.title != "another"


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (lambda table: table.update(positions=[]), "positions: none; allowed: at least one"),
        (lambda table: table["positions"][1].update(number=1), "the number 1; allowed: each once"),
        (lambda table: table["positions"][1].update(number=7), "position 2: its number stays"),
        (lambda table: table["positions"][1].update(id=10**6), "id 1000000 is not one of this scene"),
        (lambda table: table["milestones"].append({"text": "held"}), "two milestones are 'held'"),
        (
            lambda table: table["milestones"].append({"text": ""}),
            "milestone 4: text: This field cannot be blank",
        ),
        (lambda table: table.update(layout="a\x00b"), "allowed: text without NUL and half characters"),
        (lambda table: table["milestones"][0].update(points=10**30), "milestone 1: points: Ensure"),
        (lambda table: table.update(colour="red"), "colour = 'red': Extra inputs are not permitted"),
        (lambda table: table.update(time_limit_s=0.5), "time limit [s]: Ensure this value is greater"),
    ],
)
def test_what_a_scene_cannot_be_is_refused_in_a_sentence(write, change, sentence):
    with pytest.raises(SceneRefused) as refused:
        write(change)
    assert sentence in str(refused.value)


def test_two_people_do_not_write_over_each_other(write, scene, alma):
    seen = scene_digest(scene)
    write(lambda table: table.update(title="hers"))
    with pytest.raises(ChangedMeanwhile) as refused:
        write(lambda table: table.update(title="his"), seen=seen)
    assert "changed meanwhile by alma" in str(refused.value)
    scene.refresh_from_db()
    assert scene.title == "hers"
    write(lambda table: table.update(title="his"), seen=refused.value.seen)
    scene.refresh_from_db()
    assert scene.title == "his"


def test_what_was_written_and_whose_answer_was_lost_is_written_once(write, alma, scene):
    seen = scene_digest(scene)
    write(lambda table: table.update(title="another"))
    assert write(lambda table: table.update(title="another"), seen=seen)[0] == scene
    given = {"name": "cups", "title": "Cups", "instruction": "stack", "positions": [{"number": 1}]}
    made, _ = scene_write(user=alma, name=None, given=given)
    assert scene_write(user=alma, name=None, given=given)[0] == made
    assert LogEntry.objects.count() == 2
    with pytest.raises(SceneRefused, match="already exists"):
        scene_write(user=alma, name=None, given={**given, "title": "Other cups"})


def test_a_change_in_the_administration_is_seen_too(write, scene):
    seen = scene_digest(scene)
    Milestone.objects.filter(scene=scene, order=1).update(text="gripped")
    with pytest.raises(ChangedMeanwhile):
        write(lambda table: table.update(title="another"), seen=seen)


def test_a_scene_that_is_gone_says_so(alma, scene):
    with pytest.raises(Conflict, match="does not exist any more"):
        scene_write(user=alma, name="nowhere", given=scene_table(scene))


def test_only_administrators_write(write, ann):
    with pytest.raises(NotAllowed):
        write(lambda table: None, user=ann)


def test_a_position_of_a_trial_stays_as_it_is_and_the_others_change(bench, alma):
    bench.prepare(position=1)
    scene = bench.scene
    assert list(protected_positions(scene).values()) == ["1 trial"]
    table, seen = scene_table(scene), scene_digest(scene)
    table["positions"][0]["bench"]["block"][0] += 0.01
    with pytest.raises(SceneRefused, match="position 1 is not changed, because of 1 trial"):
        scene_write(user=alma, name=scene.name, given=table, seen=seen)
    del table["positions"][0]
    with pytest.raises(SceneRefused, match="position 1 is not removed"):
        scene_write(user=alma, name=scene.name, given=table, seen=seen)
    table = scene_table(scene)
    table["positions"][1]["bench"]["block"][0] -= 0.01
    _, said = scene_write(user=alma, name=scene.name, given=table, seen=seen)
    assert "1 trial made before keep the old positions and milestones" in said[0]


def test_a_text_with_the_line_ends_of_a_form_is_no_change_of_a_position(bench, alma):
    scene = bench.scene
    scene.positions.filter(number=1).update(description="left\r\nright ")
    bench.prepare(position=1)
    table = scene_table(scene)
    table["positions"][0]["description"] = "left\nright"
    scene_write(user=alma, name=scene.name, given=table, seen=scene_digest(scene))


def test_positions_of_a_draft_move_and_those_of_a_frozen_plan_do_not(bench, alma):
    scene = bench.scene
    draft = Plan.objects.create(name="blocks", title="Blocks", owner=bench.operator)
    draft.positions.set(scene.positions.all())
    draft.checkpoints.set([bench.checkpoint])
    assert protected_positions(scene) == {}
    freeze_plan(user=bench.operator, plan=draft)
    assert set(protected_positions(scene).values()) == {"plan Blocks v1"}
    assert running_plans(scene) == ["Blocks v1"]
    table, seen = scene_table(scene), scene_digest(scene)
    table["instruction"] = "other words"
    _, said = scene_write(user=alma, name=scene.name, given=table, seen=seen)
    assert said == ["This stops Blocks v1 until it is changed back, or the plan is amended."]
    table["positions"][0]["label"] = "left"
    with pytest.raises(SceneRefused, match="position 1 is not changed, because of plan Blocks v1"):
        scene_write(user=alma, name=scene.name, given=table, seen=scene_digest(Scene.objects.get()))


def test_reference_pictures_are_named_where_their_position_moves_or_goes(write, scene, alma):
    station = Station.objects.create(name="bench-7", robot="agilex_piper")
    position = scene.positions.get(number=1)
    Reference.objects.create(station=station, camera="cam_high", position=position, picture="0" * 64, by=alma)

    def moved(table):
        table["positions"][0]["bench"]["block"][0] = 0.05

    assert write(moved)[1] == ["Position 1 has reference pictures of how it was: take them anew."]
    with pytest.raises(SceneRefused, match="not removed, because of reference pictures"):
        write(lambda table: table["positions"].pop(0))
