"""Deployment files that are written from choices: what the runtime loads, and what is refused with a sentence."""

import tomllib

import pytest

import robots
from evaweb.core.errors import (
    Conflict,
    EvaError,
    NotFound,
    StationGone,
)
from evaweb.lab import deployments, lifetime
from evaweb.lab.deployments import Standing
from evaweb.plans.models import Plan
from evaweb.stations.models import Station
from evaweb.trials.models import Trial, TrialStatus
from runtime.config import draft as runtime_draft
from runtime.config.loader import load
from tests.evaweb.trials import builders

pytestmark = pytest.mark.django_db
REAL = {
    "transport": {"kind": "zmq", "sub_endpoint": "tcp://127.0.0.1:7000"},
    "policy": {"kind": "openpi", "url": "ws://127.0.0.1:9000"},
    "cameras.cam_high": {"kind": "v4l2", "device": "/dev/video0"},
    "cameras.cam_left_wrist": {"kind": "mjpeg", "url": "http://127.0.0.1/a"},
}


@pytest.fixture(autouse=True)
def data(settings, tmp_path):
    settings.DATA_DIR = tmp_path
    return tmp_path


def draft(name="real-1", robot="agilex_piper", **parts):
    return deployments.write_draft(name=name, robot=robot, task='say "hi"', parts=REAL | parts)


@pytest.mark.parametrize("robot", robots.robot_names())
def test_a_simulated_station_of_every_robot_is_one_that_the_lab_brings(robot):
    kept = deployments.write_simulated(name="bench-2", robot=robot)
    resolved = kept.resolved()
    assert deployments.is_simulated(resolved)
    assert (resolved.deployment.station, resolved.deployment.robot) == ("bench-2", robot)
    assert deployments.stored_deployments() == [kept]


def test_a_draft_has_what_was_chosen_and_its_command():
    kept = draft()
    table = tomllib.loads(kept.path.read_text())
    assert table["transport"] == {"kind": "zmq", "sub_endpoint": "tcp://127.0.0.1:7000"}
    assert table["cameras"]["cam_high"] == {"kind": "v4l2", "device": "/dev/video0"}
    assert table["task"] == 'say "hi"'
    assert not deployments.is_simulated(kept.resolved())
    assert f"-m runtime {kept.path}" in kept.path.read_text()


@pytest.mark.parametrize(
    ("parts", "said"),
    [
        (
            {"transport": {"kind": "zmq", "stalled_after_s": "soon"}},
            "stalled_after_s = 'soon'; allowed: a number",
        ),
        (
            {"transport": {"kind": "pigeon"}},
            r"transport.kind = 'pigeon'; allowed: dataset, lerobot, ros1, ros2, zmq",
        ),
        ({"cameras.cam_high": {"kind": "v4l2", "device": "webcam"}}, r"cameras.cam_high.device = 'webcam'"),
        ({"cameras.cam_high": {"kind": "v4l2"}}, r"cameras.cam_high.device is missing"),
        ({"transport": {"kind": "zmq", "sub_endpoint": "tcp://10.0.0.1:1"}}, "insecure_link = true"),
    ],
)
def test_what_the_runtime_could_not_load_is_refused_and_nothing_is_left(data, parts, said):
    with pytest.raises(EvaError, match=said):
        draft(**parts)
    assert list((data / "deployments").glob("*")) == []


@pytest.mark.parametrize(
    ("transport", "said"),
    [
        ({"kind": "zmq", "simulated": "yes"}, "transport.simulated = 'yes'; allowed here: no; a simulated"),
        ({"kind": "ros1", "python": "/a/b"}, "transport.python = '/a/b'; allowed here: /usr/bin/python3; "),
    ],
)
def test_what_this_machine_would_run_is_written_by_hand(transport, said):
    with pytest.raises(EvaError, match=said):
        draft(transport=transport)
    assert deployments.stored_deployments() == []
    assert not draft("real-2", transport={"kind": "zmq", "simulated": "no"}).chosen


def test_no_part_of_a_draft_that_is_offered_names_a_program():
    keys = {
        (part, entry.key)
        for part in runtime_draft.PACKAGES
        for kind in runtime_draft.kinds(part)
        for entry in runtime_draft.entries(part, kind)
    }
    programs = {one for one in keys if one[1] in ("python", "program", "command", "executable", "ssh")}
    assert programs | {("transport", "simulated")} == set(deployments.BY_HAND)


def test_a_name_that_a_program_of_the_lab_has_is_not_given_again():
    Station.objects.create(name="bench-1", robot="ur5e", deployment="deployments/tabletop.toml")
    with pytest.raises(Conflict, match=r"the program of bench-1 tabletop, after .*tabletop\.toml"):
        draft("tabletop")


def test_names_and_robots_that_cannot_be_are_refused():
    for name in ("", "../x", "a b", ".hidden"):
        with pytest.raises(EvaError, match="allowed: letters, digits"):
            deployments.write_simulated(name=name, robot="ur5e")
        assert deployments.stored_deployment(name) is None
    with pytest.raises(EvaError, match="robot = 'r2d2'; allowed: agibot_g2"):
        deployments.write_simulated(name="a", robot="r2d2")


def test_a_station_that_is_there_is_not_written_over():
    Station.objects.create(name="bench-1", robot="ur5e")
    with pytest.raises(Conflict, match="there is a station bench-1 already"):
        deployments.write_simulated(name="bench-1", robot="ur5e")
    draft("real-1")
    with pytest.raises(Conflict, match="there is a station real-1 already"):
        draft("real-1")


def test_of_two_pages_that_write_one_name_at_once_one_is_told_and_neither_is_lost(data, monkeypatch):
    real = deployments.load

    def meanwhile(path):
        monkeypatch.setattr(deployments, "load", real)
        draft()
        return real(path)

    monkeypatch.setattr(deployments, "load", meanwhile)
    with pytest.raises(Conflict, match="there is a station real-1 already"):
        draft(policy={"kind": "openpi", "url": "ws://127.0.0.1:9999"})
    assert (
        tomllib.loads((data / "deployments" / "real-1.toml").read_text())["policy"]["url"]
        == "ws://127.0.0.1:9000"
    )
    assert [path.name for path in (data / "deployments").iterdir()] == ["real-1.toml"]


def test_cameras_of_the_deployments_own_exchange_their_names():
    kept = draft()
    left, high = "cam_left_wrist", "cam_high"
    deployments.cameras_exchanged(
        name="real-1", shown={high: left, left: high, "cam_right_wrist": "cam_right_wrist"}
    )
    cameras = load(kept.path).tree["cameras"]
    assert (cameras[left]["kind"], cameras[high]["kind"]) == ("v4l2", "mjpeg")


def test_cameras_that_the_robots_node_names_are_exchanged_there():
    draft()
    shown = {"cam_high": "cam_right_wrist", "cam_left_wrist": "cam_left_wrist", "cam_right_wrist": "cam_high"}
    with pytest.raises(EvaError, match="cam_right_wrist: the robot's own node names"):
        deployments.cameras_exchanged(name="real-1", shown=shown)
    with pytest.raises(EvaError, match="each camera once"):
        deployments.cameras_exchanged(
            name="real-1", shown={"cam_high": "cam_high", "cam_left_wrist": "cam_high"}
        )


def test_what_the_lab_says_of_a_deployment_is_what_the_page_reads():
    draft()
    assert deployments.standing_of("real-1") == Standing()
    deployments.write_status("real-1", Standing(failed="no room"))
    assert deployments.standing_of("real-1") == Standing(failed="no room")


def test_trying_again_is_another_time_of_change():
    kept = draft()
    before = kept.changed_ns
    deployments.try_again(name="real-1")
    assert kept.changed_ns > before
    with pytest.raises(NotFound, match="'nobody' has no deployment"):
        deployments.try_again(name="nobody")


def test_a_station_that_was_used_is_switched_off_when_its_deployment_is_removed(ann):
    draft()
    station = Station.objects.create(name="real-1", robot="agilex_piper")
    station.commands.create(user=ann, kind="home")
    deployments.remove(name="real-1")
    station.refresh_from_db()
    assert not station.active
    assert deployments.stored_deployments() == []
    with pytest.raises(NotFound, match="'real-1' has no deployment"):
        deployments.remove(name="real-1")


def test_a_station_that_a_plan_names_stays_in_it_switched_off(alma):
    draft()
    station = Station.objects.create(name="real-1", robot="agilex_piper")
    plan = Plan.objects.create(name="blocks", title="Blocks", owner=alma, repetitions=1)
    plan.stations.set([station])
    deployments.remove(name="real-1")
    assert [one.active for one in plan.stations.all()] == [False]


@pytest.mark.parametrize("status", [TrialStatus.PREPARED, TrialStatus.RUNNING, TrialStatus.PAUSED])
def test_a_station_is_not_removed_under_an_open_trial(data, status):
    bench = builders.bench()
    (data / "deployments").mkdir()
    (data / "deployments" / f"{bench.station}.toml").write_text("")
    trial = bench.prepare()
    Trial.objects.filter(pk=trial.pk).update(status=status)
    with pytest.raises(Conflict, match=rf"trial {trial.pk} of .* is {status.label}: end or abandon it first"):
        deployments.remove(name=bench.station.name)
    assert len(deployments.stored_deployments()) == 1
    assert Station.objects.get().active


def test_a_station_that_somebody_has_is_not_removed(monkeypatch):
    draft()
    station = Station.objects.create(name="real-1", robot="agilex_piper")
    station.leases.create(holder="web:ann:1", epoch=1)

    class Wire:
        def status(self, timeout):
            return {"lease": {"holder": "web:ann:1"}}

    monkeypatch.setattr(deployments, "connection_to", lambda name: Wire())
    with pytest.raises(Conflict, match="web:ann:1 has real-1: it is given back first"):
        deployments.remove(name="real-1")

    def gone(name):
        raise StationGone("it does not answer")

    monkeypatch.setattr(deployments, "connection_to", gone)
    deployments.remove(name="real-1")
    assert deployments.stored_deployments() == []


def test_a_lab_is_seen_as_long_as_it_runs(data):
    assert not deployments.lab_runs()
    with lifetime.hold_data_folder(data):
        assert deployments.lab_runs()
    assert not deployments.lab_runs()


@pytest.mark.exhaustive
@pytest.mark.slow
def test_the_runtimes_own_check_finds_what_loading_does_not(data):
    kept = draft()
    assert deployments.faults_of(kept.path) == ""
    kept.path.write_text(kept.path.read_text() + '\n[setup]\npose = "nowhere"\n')
    assert "nowhere" in deployments.faults_of(kept.path)
