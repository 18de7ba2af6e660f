"""What is shown of preflights, where, and to whom."""

from datetime import timedelta

import pytest
from django.test import Client
from django.urls import reverse
from django.utils import timezone

from evaweb.plans.blinding_rules import record_unblinding
from evaweb.plans.models import Plan
from evaweb.plans.services import freeze_plan, reveal_plan
from evaweb.preflights.blinding_rules import visible_preflight
from evaweb.preflights.models import Preflight
from evaweb.preflights.report_view import STAGES, time_since, view_report
from evaweb.preflights.services import start_preflight
from evaweb.trials.models import Checkpoint
from runtime.preflight.verdict import PreflightStage
from tests.evaweb.preflights.conftest import CLOSED, OK
from tests.evaweb.trials import builders

pytestmark = pytest.mark.django_db
SECRETS = ("gpu-7.lab", "24 ms", "secret", "109 ms", "[50, 14]", "no policy server")


def client_of(user):
    made = Client()
    made.force_login(user)
    return made


@pytest.fixture
def operator(bench):
    return client_of(bench.operator)


@pytest.fixture
def row(bench, checkpoint):
    made = Preflight.objects.create(
        checkpoint=checkpoint, station=bench.station, user=bench.operator, by="station"
    )

    def ended(report=None, reason=""):
        Preflight.objects.filter(pk=made.pk).update(
            status="done" if report else "lost", report=report, reason=reason, ended_at=timezone.now()
        )
        made.refresh_from_db()
        return made

    made.ended = ended
    return made


def fragment(client, row):
    answer = client.get(reverse("preflight", args=[row.pk]), headers={"HX-Request": "true"})
    assert answer.status_code == 200
    return answer.content.decode()


def test_one_under_way_asks_for_itself_again(operator, row, runtime):
    runtime.told[str(row.pk)] = {"running": True, "report": None, "failure": ""}
    text = fragment(operator, row)
    assert f'hx-get="/preflights/{row.pk}/"' in text
    assert "under way" in text


def test_one_that_is_well_shows_latency_shape_and_stages(operator, row):
    text = fragment(operator, row.ended(OK))
    assert "hx-get" not in text
    for said in (
        "usable",
        "24 ms",
        "109 ms (the first: it may compile the model)",
        "[50, 14] absolute joint at 30 Hz, 1.67 s",
    ):
        assert said in text
    for said in ("openpi, secret-policy, ws://gpu-7.lab:8000", "ckpt_path", "gave 50"):
        assert said in text
    assert text.count('data-state="done"') == len(STAGES)


def test_one_that_failed_says_where_and_what_to_do(operator, row):
    text = fragment(operator, row.ended(CLOSED))
    for said in ("port closed", "no policy server listens", "start the policy server"):
        assert said in text
    assert '<li data-state="failed"><span aria-hidden="true">✕</span> connect</li>' in text
    assert "without a report" in fragment(operator, row.ended(reason="the station was restarted"))


def test_what_the_server_says_of_itself_is_text(operator, row):
    text = fragment(operator, row.ended({**OK, "metadata": {"<b>k</b>": "<script>alert(1)</script>"}}))
    assert "<script>" not in text
    assert "<b>" not in text


def test_it_is_a_page_too(operator, row):
    answer = operator.get(reverse("preflight", args=[row.ended(OK).pk]))
    assert "<title>Preflight of" in answer.content.decode()


def test_the_newest_of_a_checkpoint_is_what_is_known_of_it(operator, row, bench):
    address = reverse("preflight-newest")
    row.ended(CLOSED)
    text = operator.get(address, {"checkpoint": bench.checkpoint.name}).content.decode()
    assert "port closed" in text
    Checkpoint.objects.create(name="fresh")
    assert "not asked yet" in operator.get(address, {"checkpoint": "fresh"}).content.decode()
    assert operator.get(address, {"checkpoint": "nobody"}).status_code == 404
    assert operator.get(address).status_code == 404


def test_nobody_sees_one_without_logging_in(row):
    answer = Client().get(reverse("preflight", args=[row.pk]))
    assert (answer.status_code, answer["Location"].partition("?")[0]) == (302, "/login/")


def test_stages_and_verdicts_are_those_of_the_runtime():
    assert tuple(PreflightStage) == STAGES
    assert view_report(None) is None
    assert [stage.state for stage in view_report({"stage": "infer"}).stages][3:6] == [
        "done",
        "failed",
        "waiting",
    ]
    assert {stage.state for stage in view_report({"stage": "nowhere"}).stages} == {"waiting"}


@pytest.mark.parametrize(
    ("seconds", "said"),
    [(-3, "0 s ago"), (59, "59 s ago"), (60, "1 min ago"), (7300, "2 h ago"), (1e6, "11 d ago")],
)
def test_how_long_ago_is_said_in_its_largest_unit(seconds, said):
    now = timezone.now()
    assert time_since(now - timedelta(seconds=seconds), now) == said


# --- who is shown what


def test_a_viewer_is_told_the_verdict_alone(row, bench):
    viewer = builders.user("vic", "viewer")
    text = fragment(client_of(viewer), row.ended(OK))
    assert "usable" in text
    assert "are shown to operators" in text
    assert not any(secret in text for secret in SECRETS)
    lost = fragment(client_of(viewer), row.ended(reason="ws://gpu-7.lab has gone"))
    assert "gpu-7" not in lost
    assert "ended without a report" in lost


def test_a_blind_plan_hides_what_tells_checkpoints_apart_until_its_reveal(row, bench, checkpoint, operator):
    olga = builders.user("olga")
    plan = Plan.objects.create(name="blocks", title="Blocks", question="?", owner=olga, repetitions=2)
    other = Checkpoint.objects.create(name="pi0-new", policy={"url": "ws://127.0.0.1:8001"})
    plan.checkpoints.set([checkpoint, other])
    plan.positions.set(bench.scene.positions.all())
    plan.first, plan.second = other, checkpoint
    plan.save()
    row.ended(OK)
    assert "24 ms" in fragment(operator, row)
    plan = freeze_plan(user=olga, plan=plan)
    for address in (
        reverse("preflight", args=[row.pk]),
        reverse("preflight-newest") + "?checkpoint=pi0-block",
    ):
        answer = operator.get(address)
        assert answer.status_code == 404
        assert not any(secret in answer.content.decode().partition("does not exist")[2] for secret in SECRETS)
    assert "is blind" in visible_preflight(row, olga).hidden
    record_unblinding(plan, olga)
    assert visible_preflight(row, olga).report == OK
    Plan.objects.filter(pk=plan.pk).update(state="closed")
    assert operator.get(reverse("preflight", args=[row.pk])).status_code == 404
    plan.refresh_from_db()
    reveal_plan(user=olga, plan=plan)
    assert "24 ms" in fragment(operator, row)


# --- administration


@pytest.fixture
def admin(bench):
    return client_of(builders.user("root", "admin"))


def change_page(admin, checkpoint):
    answer = admin.get(f"/admin/trials/checkpoint/{checkpoint.pk}/change/")
    assert answer.status_code == 200
    return answer.content.decode()


def test_a_checkpoints_page_of_administration_asks_and_shows(admin, checkpoint, runtime, bench):
    assert "not asked yet" in change_page(admin, checkpoint)
    address = f"/admin/trials/checkpoint/{checkpoint.pk}/preflight/"
    answer = admin.post(address, {"station": bench.station.name})
    assert answer["Location"] == f"/admin/trials/checkpoint/{checkpoint.pk}/change/#preflight"
    row = Preflight.objects.get()
    assert f'hx-get="/preflights/{row.pk}/"' in change_page(admin, checkpoint)
    runtime.told[str(row.pk)] = {"running": False, "report": OK, "failure": ""}
    assert "[50, 14]" in change_page(admin, checkpoint)
    assert admin.get(address).status_code == 405
    runtime.refuses = "not allowed while running"
    answer = admin.post(address, follow=True)
    assert "Preflight: not allowed while running" in answer.content.decode()


def test_operators_do_not_come_to_administration_that_way(operator, checkpoint, runtime):
    answer = operator.post(f"/admin/trials/checkpoint/{checkpoint.pk}/preflight/")
    assert answer.status_code == 302
    assert not Preflight.objects.exists()


def test_a_checkpoint_that_is_yet_to_be_made_has_none(admin):
    assert "preflight-station" not in admin.get("/admin/trials/checkpoint/add/").content.decode()


def test_a_checkpoint_goes_with_its_preflights(admin, row, checkpoint):
    address = f"/admin/trials/checkpoint/{checkpoint.pk}/delete/"
    assert admin.post(address, {"post": "yes"}).status_code == 302
    assert not Preflight.objects.exists()


def test_preflights_are_listed_and_not_edited(admin, row):
    assert admin.get("/admin/preflights/preflight/", {"q": ""}).status_code == 200
    assert admin.get(f"/admin/preflights/preflight/{row.pk}/change/").status_code == 200
    assert admin.get("/admin/preflights/preflight/add/").status_code == 403


# --- the console


def test_the_console_has_its_button_where_a_checkpoint_is_chosen(operator, bench):
    page = operator.get(f"/stations/{bench.station.name}/eval/").content.decode()
    assert 'data-checkpoint-choice="#checkpoint-choice"' in page
    assert page.count("data-preflight-ask") == 1
    debug = operator.get(f"/stations/{bench.station.name}/debug/").content.decode()
    assert 'data-checkpoint-choice="#checkpoint"' in debug
    bench.prepare()
    page = operator.get(f"/stations/{bench.station.name}/eval/").content.decode()
    assert f'data-checkpoint="{bench.checkpoint.name}"' in page


def test_the_chronicle_fetches_what_nobody_looks_at(bench, checkpoint, runtime):
    from evaweb.console.event_ingest import StationEventIngester
    from evaweb.console.feed import Feeds, LinkState

    row = start_preflight(user=bench.operator, checkpoint=checkpoint, station=bench.station)
    runtime.told[str(row.pk)] = {"running": False, "report": OK, "failure": ""}
    scribe = StationEventIngester(bench.station.name, Feeds())
    scribe._feed.link = LinkState(True)
    scribe._write()
    row.refresh_from_db()
    assert row.verdict == "ok"
