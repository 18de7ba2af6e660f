"""First steps: which step is to be done, by what the lab has; what is pressed there, and who may."""

import re

import pytest

from evaweb.accounts.roles import Role, set_role
from evaweb.lab import demo_rows, deployments, first_steps
from evaweb.lab.deployments import Standing
from evaweb.lab.first_steps import Progress, walk
from evaweb.plans.models import CameraCheck
from evaweb.stations.models import Command, CommandStatus, Station
from evaweb.trials.models import Scene
from evaweb.trials.services import score_trial
from tests.evaweb.trials import builders

pytestmark = pytest.mark.django_db


@pytest.fixture(autouse=True)
def data(settings, tmp_path):
    settings.DATA_DIR = tmp_path
    return tmp_path


@pytest.fixture
def lea(client, alma):
    """An administrator's browser."""
    set_role(user=alma, role=Role.ADMIN)
    client.force_login(alma)
    return client


def standing(name=""):
    return {step.name: step.progress.value for step in walk(name=name).steps}


def now(name=""):
    found = walk(name=name).now
    return found.name if found else "nothing"


def page(lea, path="/first-steps/"):
    return lea.get(path, headers={"Accept": "text/html"}).content.decode()


def test_an_empty_lab_begins_with_a_station_and_everything_else_comes_later():
    assert standing() == {
        "deployment": "now",
        **dict.fromkeys(["station", "cameras", "home", "scene", "trial"], "later"),
    }


def test_each_step_is_done_by_what_the_lab_has(monkeypatch, alma):
    deployments.write_simulated(name="bench-2", robot="agilex_piper")
    assert now() == "station"  # the database does not know it yet
    station = demo_rows.station_registered(
        name="bench-2", robot="agilex_piper", deployment="d", simulated=True
    )
    assert now() == "station"
    monkeypatch.setattr(first_steps, "_snapshot", lambda station: {"state": "idle"})
    assert now() == "cameras"
    CameraCheck.objects.create(station=station, boot="b", seen={}, by=alma)
    assert now() == "home"
    refused = Command.objects.create(station=station, kind="home", status=CommandStatus.REFUSED)
    assert now() == "home"
    Command.objects.filter(pk=refused.pk).update(status=CommandStatus.ACCEPTED)
    assert now() == "scene"
    scene = first_steps.starter_scene()
    assert now() == "trial"
    checkpoint = demo_rows.demo_checkpoint(name="c", description="", policy={"url": "ws://127.0.0.1:1"})
    bench = builders.TrialBench(station, scene, checkpoint, builders.user("ann"))
    trial = bench.ended()
    assert now() == "trial"
    score_trial(user=bench.operator, trial=trial, milestones=bench.ticks(True, True, True, True))
    assert now() == "nothing"
    monkeypatch.setattr(first_steps, "_snapshot", lambda station: {})
    assert now() == "nothing"  # a station that is switched off for the night begins nothing anew


def test_a_scene_without_a_milestone_is_none_yet(alma):
    Scene.objects.create(name="bare", title="Bare")
    assert walk().steps[4].progress is not Progress.DONE


def test_the_newest_station_is_walked_and_another_one_by_its_name():
    for name in ("bench-1", "bench-2"):
        demo_rows.station_registered(name=name, robot="ur5e", deployment="", simulated=False)
    assert walk().name == "bench-2"
    assert walk(name="bench-1").name == "bench-1"
    assert [one.name for one in walk().others] == ["bench-1"]
    assert walk(name="nobody").name == "bench-2"


def test_a_simulated_station_is_one_press_and_the_page_goes_on_with_it(lea):
    assert 'value="bench-1"' in page(lea)
    answer = lea.post("/first-steps/simulated", {"station": "bench-1", "robot": "ur5e"})
    assert answer["Location"] == "/first-steps/?station=bench-1"
    assert "No lab is watching this data folder" in page(lea, answer["Location"])
    assert deployments.is_simulated(deployments.stored_deployment("bench-1").resolved())


def test_what_the_lab_says_is_shown_and_a_start_that_failed_is_tried_again(lea, monkeypatch):
    monkeypatch.setattr(deployments, "lab_runs", lambda: True)
    kept = deployments.write_simulated(name="bench-1", robot="ur5e")
    deployments.write_status("bench-1", Standing(doing="the simulated bench"))
    assert "The lab is starting the simulated bench" in page(lea)
    deployments.write_status("bench-1", Standing(failed="no room <here>"))
    assert "no room &lt;here&gt;" in page(lea)
    before = kept.changed_ns
    assert lea.post("/first-steps/bench-1/again").status_code == 302
    assert kept.changed_ns > before


def test_a_station_that_was_a_mistake_is_removed_and_the_page_begins_anew(lea):
    lea.post("/first-steps/simulated", {"station": "bench-1", "robot": "ur5e"})
    assert "Remove bench-1" in page(lea)
    told = lea.post("/first-steps/bench-1/remove", follow=True).content.decode()
    assert "bench-1 is removed" in told
    assert "Create a simulated station" in told


def test_a_refusal_shows_the_reason_and_what_was_typed(lea):
    answer = lea.post("/first-steps/simulated", {"station": "no name", "robot": "ur5e"})
    told = answer.content.decode()
    assert answer.status_code == 400
    assert "station = &#x27;no name&#x27;; allowed: letters" in told
    assert 'value="no name"' in told


DRAFT = {
    "station": "real-1",
    "robot": "agilex_piper",
    "task": "stack",
    "transport.kind": "zmq",
    "transport.sub_endpoint": "tcp://127.0.0.1:7000",
    "policy.kind": "openpi",
    "policy.url": "ws://127.0.0.1:9000",
    "cameras.cam_high.kind": "v4l2",
    "cameras.cam_high.device": "/dev/video0",
}


def test_a_draft_is_written_registered_and_given_with_its_command(lea):
    answer = lea.post("/first-steps/draft", DRAFT)
    assert answer["Location"] == "/first-steps/?station=real-1"
    station = Station.objects.get(name="real-1")
    assert (station.simulated, station.deployment) == (
        False,
        str(deployments.stored_deployment("real-1").path),
    )
    told = page(lea, answer["Location"])
    assert f"-m runtime {station.deployment}" in told
    given = b"".join(lea.get("/first-steps/real-1/deployment.toml").streaming_content)
    assert given == deployments.stored_deployment("real-1").path.read_bytes()


def test_a_draft_that_the_runtime_could_not_load_comes_back_as_it_was_typed(lea):
    typed = DRAFT | {"cameras.cam_high.device": "webcam", "task": "keep <me>"}
    answer = lea.post("/first-steps/draft", typed)
    told = answer.content.decode()
    assert answer.status_code == 400
    assert "cameras.cam_high.device = &#x27;webcam&#x27;" in told
    assert 'value="webcam"' in told
    assert 'value="keep &lt;me&gt;"' in told
    assert not Station.objects.exists()


def test_another_robot_or_kind_asks_for_other_things_and_keeps_the_rest(lea):
    first = lea.get("/first-steps/draft", DRAFT).content.decode()
    assert 'value="/dev/video0"' in first
    other = lea.get(
        "/first-steps/draft", DRAFT | {"robot": "r1_lite", "transport.kind": "ros2"}
    ).content.decode()
    assert 'name="transport.domain"' in other
    assert 'name="transport.sub_endpoint"' not in other
    assert 'value="ws://127.0.0.1:9000"' in other


def test_what_is_written_by_hand_has_no_field_and_is_refused_when_it_is_sent(lea):
    for wrong in (
        {"transport.simulated": "yes"},
        {"transport.kind": "ros1", "transport.python": "/bin/true"},
    ):
        key, value = list(wrong.items())[-1]
        answer = lea.post("/first-steps/draft", DRAFT | wrong)
        told = answer.content.decode()
        assert answer.status_code == 400
        assert f"{key} = &#x27;{value}&#x27;; allowed here: " in told
        assert f'name="{key}"' not in told
    assert deployments.stored_deployments() == []


def test_a_robot_or_a_kind_that_there_is_not_is_refused_and_never_another_one_taken(lea):
    for wrong, said in ({"robot": "r2d2"}, "r2d2"), ({"transport.kind": "pigeon"}, "pigeon"):
        answer = lea.post("/first-steps/draft", DRAFT | wrong)
        assert answer.status_code == 400
        assert said in answer.content.decode()
    assert deployments.stored_deployments() == []


def test_a_camera_that_has_another_ones_name_is_exchanged_in_the_deployment(lea, monkeypatch):
    lea.post(
        "/first-steps/draft",
        DRAFT | {"cameras.cam_left_wrist.kind": "file", "cameras.cam_left_wrist.path": "/a"},
    )
    monkeypatch.setattr(first_steps, "_snapshot", lambda station: {"state": "idle"})
    shown = {"shows.cam_high": "cam_left_wrist", "shows.cam_left_wrist": "cam_high"}
    answer = lea.post("/first-steps/real-1/cameras", shown, follow=True)
    assert "start real-1 anew" in answer.content.decode()
    assert (
        deployments.stored_deployment("real-1").resolved().deployment.cameras["cam_left_wrist"].kind == "v4l2"
    )
    refused = lea.post("/first-steps/real-1/cameras", {"shows.cam_high": "cam_right_wrist"})
    assert "each camera once" in refused.content.decode()


def test_a_station_that_shows_no_picture_is_not_confirmed(lea):
    demo_rows.station_registered(name="bench-1", robot="ur5e", deployment="", simulated=True)
    assert lea.post("/first-steps/bench-1/cameras", {}).status_code >= 400
    assert not CameraCheck.objects.exists()
    assert lea.get("/first-steps/bench-1/cameras/nothing.jpg").status_code == 404


def test_the_page_is_told_to_load_again_once_something_went_on(lea):
    mark = re.search(r"mark=(\w+)", page(lea, "/first-steps/?station=x"))
    assert mark is None  # nothing is waited for: a station is described first
    deployments.write_simulated(name="bench-1", robot="ur5e")
    mark = re.search(r"mark=(\w+)", page(lea))[1]
    asked = {"station": "bench-1", "mark": mark}
    assert "HX-Refresh" not in lea.get("/first-steps/news", asked)
    deployments.write_status("bench-1", Standing(up=True))
    assert lea.get("/first-steps/news", asked)["HX-Refresh"] == "true"


def test_the_starter_scene_is_made_once(lea):
    for _ in range(2):
        assert (
            lea.post("/first-steps/scene", {"station": "bench-1"})["Location"]
            == "/first-steps/?station=bench-1"
        )
    assert Scene.objects.get().milestones.count() == 4


READ = ("", "news", "draft", "bench-1/deployment.toml", "bench-1/check", "bench-1/cameras/cam_high.jpg")
POSTED = ("simulated", "draft", "scene", "bench-1/again", "bench-1/cameras", "bench-1/remove")


def test_they_are_for_administrators(client, ann, vera):
    for user in (ann, vera):
        client.force_login(user)
        assert {client.get(f"/first-steps/{path}").status_code for path in READ} == {403}
        assert {client.post(f"/first-steps/{path}").status_code for path in POSTED} == {403}
    client.logout()
    assert {client.get(f"/first-steps/{path}").status_code for path in READ} == {302}


def test_an_empty_list_of_stations_leads_there(lea, ann):
    assert 'href="/first-steps/"' in page(lea, "/")
    lea.force_login(ann)
    assert "An administrator sets up the first one" in page(lea, "/")
