import pytest
from django.contrib.auth.models import User

from evaweb.accounts.roles import Role, role_of
from evaweb.lab import demo_rows
from evaweb.stations.models import Station
from evaweb.trials.models import Milestone, Scene

pytestmark = pytest.mark.django_db


def test_a_login_works_with_its_fresh_password_and_the_old_one_no_more():
    first = demo_rows.demo_login(username="operator", role=Role.OPERATOR)
    second = demo_rows.demo_login(username="operator", role=Role.OPERATOR)
    assert first.password != second.password
    user = User.objects.get()
    assert not user.check_password(first.password)
    assert user.check_password(second.password)
    assert role_of(user) is Role.OPERATOR


def test_nobody_can_log_in_until_there_is_an_account_that_is_switched_on():
    assert demo_rows.has_no_accounts()
    demo_rows.demo_login(username="operator", role=Role.OPERATOR)
    assert not demo_rows.has_no_accounts()
    User.objects.update(is_active=False)
    assert demo_rows.has_no_accounts()


def test_a_second_start_keeps_what_an_administrator_changed():
    scene = demo_rows.demo_scene()
    scene.title = "Our own title"
    scene.save()
    scene.milestones.filter(order=1).delete()
    demo_rows.demo_scene()
    assert Scene.objects.get().title == "Our own title"
    assert Milestone.objects.count() == 3


def test_a_checkpoint_is_led_to_where_its_server_listens_now():
    demo_rows.demo_checkpoint(name="a", description="first words", policy={"url": "ws://127.0.0.1:1"})
    found = demo_rows.demo_checkpoint(name="a", description="other words", policy={"url": "ws://127.0.0.1:2"})
    assert found.policy == {"url": "ws://127.0.0.1:2"}
    assert found.description == "first words"


def test_a_station_keeps_its_title_when_its_deployment_is_started_again():
    facts = {"robot": "agilex_piper", "deployment": "a.toml", "simulated": True}
    Station.objects.filter(pk=demo_rows.station_registered(name="bench-1", **facts).pk).update(
        title="The red table"
    )
    again = demo_rows.station_registered(name="bench-1", **(facts | {"deployment": "b.toml"}))
    assert (again.title, again.deployment) == ("The red table", "b.toml")


def test_the_scene_of_a_benchmark_s_task_has_its_choice_and_what_counts_as_success():
    parts = {"bench": "metaworld", "task": "door-open-v3", "instruction": "open it"}
    parts |= {"time_limit_s": 10.0, "pictures": "plain"}
    scene = demo_rows.benchmark_scene(**parts)
    assert (scene.name, scene.bench, scene.instruction) == (
        "metaworld-door-open-v3",
        "metaworld",
        "open it",
    )
    assert [row.bench for row in scene.positions.all()] == [
        {"choices": {"task": "door-open-v3", "pictures": "plain"}}
    ]
    assert [(row.truth, row.required) for row in scene.milestones.all()] == [("success", True)]
    scene.milestones.all().delete()
    assert not demo_rows.benchmark_scene(**parts).milestones.exists(), "an administrator's change stays"
