import tomllib

import pytest
from django.core.exceptions import ValidationError

from evaweb.core.errors import Conflict, EvaError, NotAllowed
from evaweb.plans.frozen_document import document_of
from evaweb.plans.models import Plan
from evaweb.plans.services import freeze_plan
from evaweb.plans.toml_exchange import export_toml, import_file
from evaweb.trials.models import Checkpoint, Milestone, Position, Scene
from tests.evaweb.trials import builders

KEY = bytes(32)


@pytest.fixture
def admin(db):
    return builders.user("adam", "admin")


def test_what_was_exported_is_the_same_when_it_is_read_again(draft, admin):
    draft.strategy = {"kind": "async", "blend_window": 4}
    draft.stations.add(builders.Station.objects.get(name="bench-1"))
    draft.save()
    text = export_toml(plans=[draft])
    before = document_of(draft, KEY)
    assert import_file(user=admin, text=text) == [
        "scene block-on-plate: the same",
        "checkpoint pi0-block: the same",
        "checkpoint pi0-new: the same",
        "plan blocks: draft changed",
    ]
    assert document_of(Plan.objects.get(pk=draft.pk), KEY) == before


def test_choices_travel_as_well(draft, admin):
    laid = {"choices": {"task": "reach-v3", "pictures": "plain"}}
    Scene.objects.update(bench="metaworld")
    Position.objects.update(bench=laid)
    text = export_toml(plans=[draft])
    draft.delete()
    Scene.objects.all().delete()
    import_file(user=admin, text=text)
    assert Position.objects.get(number=1).bench == laid


def test_factors_travel_as_well(draft, admin):
    Position.objects.filter(number=1).update(bench={"block": [0.1, 0.3, 0], "factors": {"light": 0.5}})
    text = export_toml(plans=[draft])
    draft.delete()
    Scene.objects.all().delete()
    import_file(user=admin, text=text)
    assert Position.objects.get(number=1).bench == {"block": [0.1, 0.3, 0], "factors": {"light": 0.5}}


def test_another_lab_reads_it(draft, admin):
    Scene.objects.update(failure_required=True)
    text = export_toml(plans=[draft])
    before = document_of(draft, KEY)
    draft.delete()
    Scene.objects.all().delete()
    Checkpoint.objects.all().delete()
    assert [line.split(": ")[1] for line in import_file(user=admin, text=text)] == [
        "new",
        "new",
        "new",
        "new draft",
    ]
    found = Plan.objects.get()
    assert found.owner == admin
    assert Scene.objects.get().failure_required
    assert document_of(found, KEY) == {**before, "owner": "adam"}
    assert freeze_plan(user=admin, plan=found).slots.count() == 12


def test_what_trials_were_made_with_is_not_changed_by_a_file(bench, admin):
    text = export_toml(scenes=[bench.scene]).replace("points = 2", "points = 3")
    assert import_file(user=admin, text=text) == ["scene block-on-plate: changed"]
    assert list(bench.scene.milestones.values_list("points", flat=True)) == [1, 1, 3]
    bench.scored()
    with pytest.raises(Conflict, match=r"is in use .*milestone\[2\]\.points: 3 -> 4"):
        import_file(user=admin, text=text.replace("points = 3", "points = 4"))
    policy = export_toml(checkpoints=[bench.checkpoint]).replace("8000", "8009")
    with pytest.raises(Conflict, match="checkpoint pi0-block is in use"):
        import_file(user=admin, text=policy)


def test_a_new_scene_with_the_same_milestone_twice_is_refused_and_an_old_one_stays(bench, admin):
    Milestone.objects.filter(scene=bench.scene, text="lifted").update(text="held")
    text = export_toml(scenes=[bench.scene])
    assert import_file(user=admin, text=text) == ["scene block-on-plate: the same"]
    with pytest.raises(EvaError, match="scene other: two milestones are 'held'; allowed: different words"):
        import_file(user=admin, text=text.replace('name = "block-on-plate"', 'name = "other"'))
    assert not Scene.objects.filter(name="other").exists()


def test_a_frozen_plan_is_not_changed_by_a_file(draft, owner, admin):
    text = export_toml(plans=[freeze_plan(user=owner, plan=draft)])
    with pytest.raises(Conflict, match="plan blocks is running: amend it"):
        import_file(user=admin, text=text)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[[scene", "the file: is not valid TOML"),
        ("[" + ".".join("a" * 20_000) + "]", "allowed: at most 40"),
        (
            "[[scene]]\nname='a'\ntitle='A'\ninstruction='go'\ncolour='red'\n[[scene.position]]\nnumber=1",
            "colour",
        ),
        ("[[scene]]\nname='a'\ntitle='A'\ninstruction='go'", "position"),
        (
            "[[scene]]\nname='a b'\ntitle='A'\ninstruction='go'\n[[scene.position]]\nnumber=1",
            "scene a b: name",
        ),
        ("[[checkpoint]]\nname='x'\n[checkpoint.policy]\nkind='nobody'", "nobody"),
        (
            "[[plan]]\nname='p'\ntitle='P'\npositions=[{scene='none',number=1}]\ncheckpoints=['pi0-block']",
            "position 1 of scene 'none' does not exist",
        ),
        (
            "[[plan]]\nname='p'\ntitle='P'\npositions=[{scene='block-on-plate',number=1}]\ncheckpoints=['gone']",
            "checkpoint 'gone' does not exist",
        ),
    ],
)
def test_a_file_that_cannot_be_taken_is_refused_whole(bench, admin, text, said):
    good = "[[checkpoint]]\nname='good'\n"
    with pytest.raises(EvaError, match=said):
        import_file(user=admin, text=good + text)
    assert not Checkpoint.objects.filter(name="good").exists()


def test_only_administrators_import(bench):
    with pytest.raises(NotAllowed):
        import_file(user=bench.operator, text="")


def test_the_export_is_toml_that_people_read(draft):
    read = tomllib.loads(export_toml(plans=[draft]))
    assert set(read) == {"scene", "checkpoint", "plan"}
    assert read["scene"][0]["position"][0]["bench"] == {"block": [0.1, 0.3, 0], "plate": [-0.1, 0.3]}
    assert read["plan"][0]["comparison"] == ["pi0-new", "pi0-block"]


def test_several_comparisons_and_random_order_travel(draft, admin):
    for changed, wanted in (
        ({"comparing": "all", "first": None, "second": None, "drop_arms": True, "stopping": "early"}, []),
        ({"comparing": "control", "first": draft.first, "second": None}, ["pi0-new"]),
        ({"comparing": "pair", "first": draft.first, "second": draft.second, "allocation": "random"}, None),
    ):
        Plan.objects.filter(pk=draft.pk).update(**changed)
        text = export_toml(plans=[Plan.objects.get(pk=draft.pk)])
        assert wanted is None or tomllib.loads(text)["plan"][0]["comparison"] == wanted
        Plan.objects.filter(pk=draft.pk).update(comparing="pair", drop_arms=False, allocation="paired")
        assert "plan blocks: draft changed" in import_file(user=admin, text=text)
        again = Plan.objects.get(pk=draft.pk)
        assert {name: getattr(again, name) for name in changed} == changed
    with pytest.raises(EvaError, match="comparing = 'all'; allowed: 0 checkpoints"):
        import_file(user=admin, text=text.replace('comparing = "pair"', 'comparing = "all"'))


def test_weights_lineage_and_tags_travel_the_older_before_the_younger(draft, admin):
    old = Checkpoint.objects.create(name="zero", policy={}, tags=["pretrained"])
    Checkpoint.objects.filter(name="pi0-new").update(
        parent=old, digest="sha256:0123abcd", tags=["block", "v2"]
    )
    text = export_toml(plans=[draft])
    assert [row["name"] for row in tomllib.loads(text)["checkpoint"]] == ["pi0-block", "zero", "pi0-new"]
    assert set(
        import_file(user=admin, text=export_toml(checkpoints=[Checkpoint.objects.get(name="pi0-new")]))
    ) == {
        "checkpoint zero: the same",
        "checkpoint pi0-new: the same",
    }
    draft.delete()
    Checkpoint.objects.filter(name="pi0-new").delete()
    Checkpoint.objects.all().delete()
    import_file(user=admin, text=text)
    found = Checkpoint.objects.get(name="pi0-new")
    assert (found.lineage, found.digest, found.tags) == (
        [Checkpoint.objects.get(name="zero")],
        "sha256:0123abcd",
        ["block", "v2"],
    )


@pytest.mark.parametrize(
    ("line", "says"),
    [
        ('parent = "nobody"', "checkpoint a: parent = 'nobody' does not exist"),
        ('digest = "abc"', "checkpoint a: digest: abc was given; allowed: 7 to 128"),
        ('tags = ["x y"]', "checkpoint a: tags: .*words of at most 40"),
        ('tags = ["x", "x"]', "checkpoint a: tags: .*each tag once"),
    ],
)
def test_weights_lineage_and_tags_that_cannot_be_are_named(admin, line, says):
    with pytest.raises(EvaError, match=says):
        import_file(user=admin, text=f'[[checkpoint]]\nname = "a"\n{line}\n')
    assert not Checkpoint.objects.exists()


def test_nothing_is_trained_on_from_itself(db):
    first = Checkpoint.objects.create(name="first", policy={})
    first.parent = Checkpoint.objects.create(name="second", policy={}, parent=first)
    with pytest.raises(ValidationError, match="second was trained on from first"):
        first.full_clean()


def test_other_weights_are_another_document_and_other_tags_are_not(draft):
    before = document_of(draft, KEY)
    Checkpoint.objects.filter(name="pi0-new").update(tags=["v3"])
    assert document_of(Plan.objects.get(pk=draft.pk), KEY) == before
    Checkpoint.objects.filter(name="pi0-new").update(digest="sha256:0123abcd")
    assert document_of(Plan.objects.get(pk=draft.pk), KEY) != before
