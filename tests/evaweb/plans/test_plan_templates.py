"""A checkpoint that is registered gets a plan like another one, once, frozen and started."""

from __future__ import annotations

import json

import pytest

from evaweb.blinding.visibility import visibility_for_user
from evaweb.jobs.models import Job
from evaweb.jobs.services import run_queue
from evaweb.plans import copies
from evaweb.plans.covered_jobs import Cover, cover_of
from evaweb.plans.models import Plan, PlanTemplate
from evaweb.stations.models import Station
from evaweb.trials.models import Checkpoint
from tests.evaweb.plans.test_copies import WINS, bench, plan_of  # noqa: F401
from tests.evaweb.trials import builders

pytestmark = pytest.mark.django_db(transaction=True)
HTTP = "https://wandb.example/lab/runs/7"


@pytest.fixture(autouse=True)
def _data_dir(settings, tmp_path):
    settings.DATA_DIR = tmp_path


@pytest.fixture
def template(bench):  # noqa: F811
    plan = plan_of(bench)
    return PlanTemplate.objects.create(
        name="nightly",
        title="Every night",
        plan=plan,
        arm=Checkpoint.objects.get(name=WINS),
        tag="nightly",
        policy={"url": "ws://127.0.0.1:8001/{name}"},
        station=bench.station,
        copies=2,
    )


def register(client, template, name="pi0 new", **facts):
    answer = client.post(
        f"/api/v1/templates/{template.name}/checkpoints",
        json.dumps({"name": name, **facts}),
        content_type="application/json",
    )
    return answer.status_code, answer.json()


def made(template):
    return [use.plan for use in template.uses.order_by("pk")]


def test_a_program_registers_a_checkpoint_whose_plan_is_made_frozen_and_started(bench, client, template):  # noqa: F811
    client.force_login(bench.operator)
    status, answer = register(client, template, digest="sha256:12345678", training_run=HTTP)
    assert status == 202, answer
    checkpoint = Checkpoint.objects.get(name="pi0 new")
    assert (checkpoint.training_run, checkpoint.tags, checkpoint.digest) == (
        HTTP,
        ["nightly"],
        "sha256:12345678",
    )
    assert checkpoint.policy == {"url": "ws://127.0.0.1:8001/pi0%20new"}
    assert run_queue("cpu") == 1
    (plan,) = made(template)
    assert (plan.title, plan.state, plan.owner) == ("Every night 1", "frozen", template.plan.owner)
    assert {row["name"] for row in plan.document["checkpoints"]} == {"pi0 new", bench.checkpoint.name}
    assert plan.document["comparisons"] == [["pi0 new", bench.checkpoint.name]]
    for field in ("repetitions", "stopping", "blind", "alpha"):
        assert getattr(plan, field) == getattr(template.plan, field)
    assert list(plan.positions.all()) == list(template.plan.positions.all())
    assert len(copies.jobs_at_work(plan)) == 2


def test_a_repetition_changes_nothing_and_other_values_are_refused(bench, client, template):  # noqa: F811
    client.force_login(bench.operator)
    for _ in range(2):
        assert register(client, template, training_run=HTTP)[0] == 202
        run_queue("cpu")
    assert len(made(template)) == 1
    assert len(copies.jobs_at_work(made(template)[0])) == 2
    status, answer = register(client, template, training_run="https://elsewhere.example")
    assert (status, "with another training_run" in str(answer)) == (409, True)


def test_whatever_way_it_is_registered_the_tag_counts_and_only_then(template):
    Checkpoint.objects.create(name="a", tags=["nightly"], policy={})
    Checkpoint.objects.create(name="b", tags=["weekly"], policy={})
    run_queue("cpu")
    Checkpoint.objects.get(name="a").save()
    Checkpoint.objects.create(name="c", tags=["nightly"], policy={})
    run_queue("cpu")
    assert [use.checkpoint.name for use in template.uses.order_by("pk")] == ["a", "c"]
    assert [plan.name for plan in made(template)] == ["every-night-1", "every-night-2"]
    PlanTemplate.objects.update(active=False)
    Checkpoint.objects.create(name="d", tags=["nightly"], policy={})
    assert not Job.objects.filter(kind="template", status="queued").exists()


def test_a_plan_that_cannot_be_started_says_why_and_is_made_once(bench, template):  # noqa: F811
    Station.objects.update(simulated=False)
    Checkpoint.objects.create(name="a", tags=["nightly"], policy={})
    run_queue("cpu")
    job = Job.objects.get(kind="template")
    assert "has a real robot" in job.error
    Station.objects.update(simulated=True)
    job.not_before = None
    job.save()
    run_queue("cpu")
    job.refresh_from_db()
    assert (job.status, job.result) == ("done", {"plan": "every-night-1"})
    assert Plan.objects.filter(title="Every night 1").count() == 1


@pytest.mark.parametrize(
    ("body", "status", "why"),
    [
        ({"name": ""}, 422, "name"),
        ({"training_run": "javascript:alert(1)"}, 400, "training_run"),
        ({"policy": {"url": "ws://evil:1"}}, 422, "policy"),
        ({"digest": "x"}, 400, "digest"),
    ],
)
def test_what_is_not_a_checkpoint_is_refused(bench, client, template, body, status, why):  # noqa: F811
    client.force_login(bench.operator)
    code, answer = register(client, template, **body)
    assert (code, why in str(answer)) == (status, True), answer
    assert not Job.objects.exists()


def test_who_may_not_and_what_is_not_there(bench, client, template):  # noqa: F811
    client.force_login(builders.user("vera", "viewer"))
    assert register(client, template)[0] == 403
    client.force_login(bench.operator)
    template.name = "moon"
    status, answer = register(client, template)
    assert (status, "there are: nightly" in str(answer)) == (404, True)
    PlanTemplate.objects.update(active=False, name="moon")
    assert register(client, template)[0] == 409


def test_the_job_does_not_tell_an_operator_which_checkpoint_a_blind_plan_has(bench, client, template):  # noqa: F811
    client.force_login(bench.operator)
    register(client, template)
    run_queue("cpu")
    job = Job.objects.get(kind="template")
    assert cover_of(job, visibility_for_user(bench.operator)) is Cover.ALL
    assert "every-night" not in client.get("/api/v1/jobs").content.decode()


@pytest.mark.parametrize(
    ("fields", "why"),
    [
        ({"arm": "other"}, "is no checkpoint of Blocks v1"),
        ({"policy": '{"uri": "{name}"}'}, "uri"),
        ({"station": "real"}, "has a real robot"),
    ],
)
def test_a_template_that_makes_no_sense_is_refused_by_its_form(bench, client, template, fields, why):  # noqa: F811
    other = Checkpoint.objects.create(name="other", policy={})
    real = Station.objects.create(name="real", robot=bench.station.robot, simulated=False)
    client.force_login(builders.user("root", "admin"))
    values = {
        "name": "second",
        "plan": template.plan_id,
        "arm": template.arm_id,
        "copies": 1,
        "policy": "{}",
        "uses-TOTAL_FORMS": 0,
        "uses-INITIAL_FORMS": 0,
        **fields,
    }
    values["arm"] = other.pk if values["arm"] == "other" else values["arm"]
    if values.get("station") == "real":
        values["station"] = real.pk
    page = client.post("/admin/plans/plantemplate/add/", values).content.decode()
    assert why in page
    assert PlanTemplate.objects.count() == 1
