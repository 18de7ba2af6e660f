import json
import re

import pytest
from django.test import Client

from evaweb.trials.models import Checkpoint, Scene
from tests.evaweb.trials import builders

LISTS = ["trials/scene", "trials/checkpoint", "trials/evaluation", "trials/trial", "trials/score"]


@pytest.fixture
def admin(bench):
    made = Client()
    made.force_login(builders.user("root", "admin"))
    return made


def scene_form(**given):
    return {
        "title": "Cup in sink",
        "name": "cup-in-sink",
        "instruction": "put the cup in the sink",
        "active": "on",
        "layout": "",
        "bench": "tabletop",
        "criterion": "",
        "time_limit_s": "60",
        "positions-TOTAL_FORMS": "1",
        "positions-INITIAL_FORMS": "0",
        "positions-0-number": "1",
        "positions-0-bench": "",
        "milestones-TOTAL_FORMS": "1",
        "milestones-INITIAL_FORMS": "0",
        "milestones-0-order": "1",
        "milestones-0-text": "held",
        "milestones-0-points": "1",
        **given,
    }


def errors(answer):
    assert answer.status_code == 200
    return answer.content.decode()


@pytest.mark.some(2)
@pytest.mark.parametrize("where", LISTS)
def test_every_list_and_row_opens_for_an_admin(admin, bench, where):
    trial = bench.scored()
    rows = {
        "trials/scene": bench.scene,
        "trials/checkpoint": bench.checkpoint,
        "trials/evaluation": trial.evaluation,
        "trials/trial": trial,
        "trials/score": trial.verdict,
    }
    assert admin.get(f"/admin/{where}/", {"q": "a"}).status_code == 200
    assert admin.get(f"/admin/{where}/{rows[where].pk}/change/").status_code == 200


@pytest.mark.parametrize("role", ["viewer", "operator"])
def test_nobody_else_comes_in(bench, role):
    browser = Client()
    browser.force_login(builders.user("bob", role))
    assert browser.get("/admin/").status_code == 302
    assert browser.get("/admin/trials/checkpoint/").status_code == 302
    assert browser.post("/admin/trials/checkpoint/add/", {"name": "x"}).status_code == 302
    assert Checkpoint.objects.count() == 1


def test_an_admin_adds_a_scene_with_its_positions_and_milestones(admin):
    answer = admin.post("/admin/trials/scene/add/", scene_form())
    assert answer.status_code == 302
    made = Scene.objects.get(name="cup-in-sink")
    assert made.positions.get().number == 1
    assert made.milestones.get().text == "held"


@pytest.mark.parametrize(
    ("given", "sentence"),
    [
        ({"positions-TOTAL_FORMS": "0"}, "at least 1"),
        ({"positions-0-bench": "{block: 1}"}, "The table: is not valid JSON"),
        ({"positions-0-bench": '{"cup": [0, 0]}'}, "cup: unknown key; allowed: plate, block"),
        ({"time_limit_s": "0"}, "greater than or equal to 1"),
        ({"milestones-0-points": "0"}, "greater than or equal to 1"),
        (
            {
                "milestones-TOTAL_FORMS": "2",
                "milestones-1-order": "2",
                "milestones-1-text": " held ",
                "milestones-1-points": "1",
            },
            "two milestones are &#x27;held&#x27;; allowed: different words for each",
        ),
    ],
)
def test_a_scene_that_cannot_be_is_refused_with_a_sentence(admin, given, sentence):
    text = errors(admin.post("/admin/trials/scene/add/", scene_form(**given)))
    assert sentence in text
    assert not Scene.objects.filter(name="cup-in-sink").exists()


@pytest.mark.parametrize(
    ("policy", "sentence"),
    [
        ('{"url": ', "The table: is not valid JSON: Expecting value: line 1 column 9"),
        ('{"a":' * 5000, "allowed: at most 40"),
        (json.dumps({"url": "x" * 65_536}), "allowed: at most 65536"),
        ('{"kind": "gpt"}', "allowed: gr00t, lerobot, mock, openpi"),
        ('["ws://x"]', "allowed: a table such as"),
    ],
)
def test_a_policy_that_cannot_be_is_refused_with_a_sentence(admin, policy, sentence):
    text = errors(admin.post("/admin/trials/checkpoint/add/", {"name": "new", "policy": policy}))
    assert sentence in text
    assert not Checkpoint.objects.filter(name="new").exists()


def test_a_checkpoint_without_a_table_is_reached_as_deployed(admin):
    assert admin.post("/admin/trials/checkpoint/add/", {"name": "new", "policy": ""}).status_code == 302
    assert Checkpoint.objects.get(name="new").policy == {}


def test_a_checkpoint_behind_a_tunnel_says_through_which_host_it_is_reached(admin):
    policy = {"url": "ws://127.0.0.1:9000", "tunnel": {"host": "gpu-1.lab", "user": "lab"}}
    form = {"name": "far", "policy": json.dumps(policy), "active": "on"}
    assert admin.post("/admin/trials/checkpoint/add/", form).status_code == 302
    assert Checkpoint.objects.get(name="far").policy == policy
    listed = admin.get("/admin/trials/checkpoint/").content.decode()
    assert "ws://127.0.0.1:9000 through gpu-1.lab" in listed


def test_weights_lineage_and_tags_are_written_and_weights_that_were_tried_stay(admin, bench):
    bench.scored()
    page = f"/admin/trials/checkpoint/{bench.checkpoint.pk}/change/"
    base = Checkpoint.objects.create(name="base")
    form = {"policy": "{}", "active": "on", "digest": "sha256:0123abcd", "tags": "block,  v2, block"}
    assert admin.post(page, form | {"parent": base.pk}).status_code == 302
    bench.checkpoint.refresh_from_db()
    assert (bench.checkpoint.digest, bench.checkpoint.tags) == ("sha256:0123abcd", ["block", "v2"])
    assert bench.checkpoint.lineage == [base]
    assert 'value="block, v2"' in admin.get(page).content.decode()
    admin.post(page, form | {"digest": "sha256:9999ffff"})
    bench.checkpoint.refresh_from_db()
    assert bench.checkpoint.digest == "sha256:0123abcd"  # what was tried were these
    assert "words of at most 40" in errors(admin.post(page, form | {"tags": "two words"}))


def test_a_change_of_a_tried_policy_is_warned_about(admin, bench):
    bench.scored()
    form = {"policy": '{"url": "ws://127.0.0.1:9000"}', "active": "on"}
    answer = admin.post(f"/admin/trials/checkpoint/{bench.checkpoint.pk}/change/", form, follow=True)
    assert "are of checkpoint pi0-block with another policy or strategy table" in answer.content.decode()
    bench.checkpoint.refresh_from_db()
    assert (bench.checkpoint.name, bench.checkpoint.policy) == ("pi0-block", {"url": "ws://127.0.0.1:9000"})


def test_scenes_and_checkpoints_are_switched_off_together(admin, bench):
    form = {"action": "switch_off", "_selected_action": [bench.checkpoint.pk]}
    assert admin.post("/admin/trials/checkpoint/", form).status_code == 302
    bench.checkpoint.refresh_from_db()
    assert bench.checkpoint.active is False


@pytest.mark.parametrize("where", ["trials/trial", "trials/score", "trials/evaluation"])
def test_what_happened_is_neither_made_nor_changed_nor_deleted(admin, bench, where):
    trial = bench.scored()
    pk = {
        "trials/trial": trial.pk,
        "trials/score": trial.verdict.pk,
        "trials/evaluation": trial.evaluation.pk,
    }
    assert admin.get(f"/admin/{where}/add/").status_code == 403
    assert admin.post(f"/admin/{where}/{pk[where]}/change/", {"status": "voided"}).status_code == 403
    assert admin.post(f"/admin/{where}/{pk[where]}/delete/", {"post": "yes"}).status_code == 403


def test_what_was_tried_is_not_deleted(admin, bench):
    bench.scored()
    chosen = {"action": "delete_selected", "_selected_action": [bench.checkpoint.pk]}
    for address, form, said in (
        (f"scene/{bench.scene.pk}/delete/", {}, "Cannot delete scene"),
        (f"checkpoint/{bench.checkpoint.pk}/delete/", {}, "Not allowed"),
        ("checkpoint/", chosen, "Checkpoint pi0-block: trials, or a plan that was frozen, are of it"),
    ):
        answer = admin.post(f"/admin/trials/{address}", {**form, "post": "yes"})
        assert said in answer.content.decode()
    bench.scene.refresh_from_db()
    bench.checkpoint.refresh_from_db()


def test_every_field_of_the_scene_form_has_a_label(admin, bench):
    text = admin.get(f"/admin/trials/scene/{bench.scene.pk}/change/").content.decode()
    labelled = set(re.findall(r'<label[^>]* for="([^"]+)"', text))
    fields = re.findall(r"<(?:input|select|textarea)\b[^>]*>", text)
    seen = [field for field in fields if not re.search(r'type="(hidden|submit|search)"', field)]
    bare = [
        field
        for field in seen
        if "aria-label=" not in field
        and (found := re.search(r' id="([^"]+)"', field))
        and found[1] not in labelled
    ]
    assert len(seen) > 20
    assert bare == []
