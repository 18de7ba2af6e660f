import pytest
from django.contrib.admin import site
from django.core.files.uploadedfile import SimpleUploadedFile
from django.core.management import CommandError, call_command
from django.forms import JSONField
from django.urls import reverse

from evaweb.plans.counting import ENDS
from evaweb.plans.models import Plan
from evaweb.plans.services import freeze_plan
from evaweb.plans.toml_exchange import export_toml
from evaweb.trials.admin import Table
from tests.evaweb.trials import builders


@pytest.fixture
def admin(client, db):
    user = builders.user("adam", "admin")
    client.force_login(user)
    return user


def form_of(plan, **changed):
    return {
        "title": plan.title,
        "name": plan.name,
        "question": plan.question,
        "owner": plan.owner_id,
        "positions": [row.pk for row in plan.positions.all()],
        "checkpoints": [row.pk for row in plan.checkpoints.all()],
        "repetitions": plan.repetitions,
        "strategy": "",
        "blind": "on",
        "allocation": "paired",
        "comparing": "pair",
        "stopping": "none",
        "outcome": "success",
        "alpha": "0.05",
        "second_rater_share": "0",
        **dict.fromkeys(ENDS, "judged"),
        "events-TOTAL_FORMS": 0,
        "events-INITIAL_FORMS": 0,
        **changed,
    }


def test_a_draft_is_edited_and_a_frozen_plan_only_read(client, admin, draft):
    page = reverse("admin:plans_plan_change", args=[draft.pk])
    assert client.post(page, form_of(draft, repetitions=7)).status_code == 302
    draft.refresh_from_db()
    assert (draft.repetitions, draft.strategy) == (7, None)
    freeze_plan(user=admin, plan=draft)
    assert 'name="repetitions"' not in client.get(page).content.decode()
    client.post(page, form_of(draft, repetitions=9))
    draft.refresh_from_db()
    assert draft.repetitions == 7
    assert client.post(reverse("admin:plans_plan_delete", args=[draft.pk])).status_code == 403


def test_lists_within_each_other_beyond_all_bounds_are_refused_with_a_sentence(client, admin, draft):
    page = reverse("admin:plans_plan_change", args=[draft.pk])
    answer = client.post(page, form_of(draft, look_after="[" * 5000, strategy="[" * 5000))
    assert answer.status_code == 200
    assert answer.content.decode().count("lists within each other; allowed: at most 40") == 2
    assert client.post(page, form_of(draft, look_after="[5, 10]")).status_code == 302
    draft.refresh_from_db()
    assert draft.look_after == [5, 10]


def test_every_field_for_json_in_the_administration_is_bounded(admin, rf):
    request = rf.get("/admin/")
    request.user = admin
    for of in (of for of in site._registry.values() if of.has_change_permission(request)):
        for form in (of.get_form(request), *(made.form for made, _ in of.get_formsets_with_inlines(request))):
            for name, field in form.base_fields.items():
                assert not isinstance(field, JSONField) or isinstance(field, Table), f"{of}: {name}"


def test_positions_of_several_scenes_are_told_apart_by_their_scene(client, admin, draft):
    other = builders.scene("fold-towel")
    shown = client.get(reverse("admin:plans_plan_change", args=[draft.pk])).content.decode()
    first = other.positions.get(number=1)
    assert f'<option value="{first.pk}">fold towel, 1</option>' in shown
    assert shown.count(", 1</option>") == 2
    wanted = [first.pk, *draft.positions.values_list("pk", flat=True)]
    page = reverse("admin:plans_plan_change", args=[draft.pk])
    assert client.post(page, form_of(draft, positions=wanted)).status_code == 302
    assert set(draft.positions.values_list("pk", flat=True)) == set(wanted)


def test_the_key_is_on_no_page_of_the_administration(client, admin, draft):
    plan = freeze_plan(user=admin, plan=draft)
    for name, given in (("changelist", []), ("change", [plan.pk]), ("history", [plan.pk]), ("export", [])):
        shown = client.get(reverse(f"admin:plans_plan_{name}", args=given)).content.decode()
        assert bytes(plan.key).hex() not in shown


def test_files_go_out_and_in(client, admin, draft):
    text = client.get(reverse("admin:plans_plan_export")).content.decode()
    assert text == export_toml(plans=[draft])
    upload = SimpleUploadedFile("lab.toml", text.replace('title = "Blocks"', 'title = "Cubes"').encode())
    page = client.post(reverse("admin:plans_plan_import"), {"file": upload}, follow=True).content.decode()
    assert "Plan blocks: draft changed" in page
    assert Plan.objects.get().title == "Cubes"
    refused = SimpleUploadedFile("lab.toml", b"[[scene]]\nname = 1")
    page = client.post(reverse("admin:plans_plan_import"), {"file": refused}).content.decode()
    assert "scene.0.name" in page
    refused = SimpleUploadedFile("lab.toml", b"\xff\xfe")
    assert "not a text" in client.post(reverse("admin:plans_plan_import"), {"file": refused}).content.decode()


def test_the_action_exports_what_was_chosen(client, admin, draft):
    chosen = {"action": "export", "_selected_action": [draft.pk]}
    answer = client.post(reverse("admin:plans_plan_changelist"), chosen)
    assert answer["Content-Disposition"] == 'attachment; filename="blocks.toml"'
    assert answer.content.decode() == export_toml(plans=[draft])


def test_operators_do_not_come_in(client, db):
    client.force_login(builders.user("ann"))
    assert client.get(reverse("admin:plans_plan_import")).status_code in (302, 403)


def test_the_command_reads_and_writes_files(admin, draft, tmp_path, capsys):
    call_command("plans", "export", "blocks")
    text = capsys.readouterr().out
    file = tmp_path / "lab.toml"
    file.write_text(text)
    call_command("plans", "import", str(file), "--user", "adam")
    assert "plan blocks: draft changed" in capsys.readouterr().out
    with pytest.raises(CommandError, match="plan cups does not exist; there are: blocks"):
        call_command("plans", "export", "cups")
    with pytest.raises(CommandError, match="there is no such user"):
        call_command("plans", "import", str(file), "--user", "nobody")
    with pytest.raises(CommandError, match=r"none\.toml"):
        call_command("plans", "import", str(tmp_path / "none.toml"), "--user", "adam")


def test_a_frozen_plan_lists_its_positions_scene_by_scene(client, admin, draft):
    other = builders.scene("fold-towel")
    draft.positions.add(other.positions.get(number=1))
    freeze_plan(user=admin, plan=draft)
    shown = client.get(reverse("admin:plans_plan_change", args=[draft.pk])).content.decode()
    assert "block on plate: 1; 2<br>fold towel: 1" in shown
