"""What the lab makes of files in its folder of deployments while it runs."""

import pytest

from evaweb.lab import deployments, pickup, simulated
from evaweb.lab.deployments import Standing
from evaweb.lab.pickup import Pickup
from evaweb.lab.processes import LabError, ProgramSpec
from evaweb.lab.simulated import POLICIES, Benches
from evaweb.stations.models import Station
from evaweb.trials.models import Checkpoint

pytestmark = pytest.mark.django_db


class Started:
    """Processes that are ready at the second look, but for those that `fail`."""

    def __init__(self):
        self.programs, self.fail = [], ""

    def pids(self):
        return {program.name: 1 for program in self.programs}

    def starting(self, program):
        yield
        if self.fail and program.name.startswith(self.fail):
            raise LabError(f"{program.name} did not start: no room")
        self.programs.append(program)
        port = 7000 + len(self.programs)
        return {
            "url": f"ws://127.0.0.1:{port}",
            "obs_endpoint": "tcp://127.0.0.1:1",
            "action_endpoint": "tcp://127.0.0.1:2",
        }

    def start(self, program):
        self.programs.append(program)

    def ending(self):
        return set()

    def drop(self, name):
        self.programs = [program for program in self.programs if program.name != name]


@pytest.fixture
def lab(settings, tmp_path, monkeypatch):
    settings.DATA_DIR = tmp_path
    monkeypatch.setattr(pickup, "close_old_connections", lambda: None)
    monkeypatch.setattr(simulated, "known_port", lambda name: 0)
    started = Started()
    return started, Pickup(started, Benches(pictures=(400, 300), assignments=("lease.ttl_s=20",)))


def looks(found, most=50):
    for _ in range(most):
        found.poll()


def test_a_simulated_station_comes_with_its_bench_and_policies_and_is_known_to_the_database(lab):
    started, found = lab
    looks(found)
    assert started.programs == []
    deployments.write_simulated(name="bench-2", robot="ur5e")
    found.poll()
    assert deployments.standing_of("bench-2") == Standing(doing="the simulated bench")
    looks(found)
    names = [program.name for program in started.programs]
    assert names == ["bench-bench-2", *(f"policy-{policy}-ur5e" for policy in POLICIES), "station-bench-2"]
    assert deployments.standing_of("bench-2") == Standing(up=True)
    station = Station.objects.get(name="bench-2")
    assert (station.robot, station.simulated) == ("ur5e", True)
    assert Checkpoint.objects.get(name="pick-place-40k-ur5e").policy == {"url": "ws://127.0.0.1:7002"}
    arguments = started.programs[-1].arguments
    assert {'policy.url="ws://127.0.0.1:7002"', "lease.ttl_s=20"} <= set(arguments)
    assert {"--width", "400"} <= set(started.programs[0].arguments)


def test_a_second_station_with_the_robot_has_its_own_bench_and_the_same_policies(lab):
    started, found = lab
    deployments.write_simulated(name="bench-2", robot="ur5e")
    deployments.write_simulated(name="bench-3", robot="ur5e")
    looks(found)
    names = [program.name for program in started.programs]
    assert len(names) == len(set(names)) == 2 + len(POLICIES) + 2
    assert {"bench-bench-3", "station-bench-3"} <= set(names)


def test_what_cannot_be_started_says_why_and_is_tried_again_when_it_is_asked_for(lab):
    started, found = lab
    started.fail = "policy"
    deployments.write_simulated(name="bench-2", robot="ur5e")
    looks(found)
    assert "did not start: no room" in deployments.standing_of("bench-2").failed
    assert started.programs == []  # its bench does not stay behind
    looks(found)
    assert started.programs == []
    started.fail = ""
    deployments.try_again(name="bench-2")
    looks(found)
    assert deployments.standing_of("bench-2") == Standing(up=True)


def test_what_is_removed_is_ended_and_its_name_can_be_used_again(lab):
    started, found = lab
    deployments.write_simulated(name="bench-2", robot="ur5e")
    looks(found)
    deployments.remove(name="bench-2")
    looks(found)
    assert {program.name for program in started.programs} == {f"policy-{policy}-ur5e" for policy in POLICIES}
    assert not Station.objects.exists()
    deployments.write_simulated(name="bench-2", robot="ur5e")
    looks(found)
    assert deployments.standing_of("bench-2") == Standing(up=True)


def test_what_is_removed_while_it_is_started_does_not_stay_behind(lab):
    started, found = lab
    deployments.write_simulated(name="bench-2", robot="ur5e")
    found.poll()
    deployments.remove(name="bench-2")
    looks(found)
    assert not any("bench-2" in program.name for program in started.programs)
    assert not Station.objects.exists()
    assert deployments.standing_of("bench-2") == Standing()


def test_a_draft_is_never_started(lab):
    started, found = lab
    parts = {"transport": {"kind": "zmq"}, "policy": {"kind": "openpi"}}
    deployments.write_draft(name="real-1", robot="ur5e", task="", parts=parts)
    looks(found)
    assert started.programs == []
    assert deployments.standing_of("real-1") == Standing()


def test_a_file_that_is_no_deployment_is_said_and_stops_nothing_else(lab, settings):
    _, found = lab
    deployments.write_simulated(name="bench-3", robot="ur5e")
    (settings.DATA_DIR / "deployments" / "bench-2.toml").write_text("station = [")
    text = (settings.DATA_DIR / "deployments" / "bench-3.toml").read_text()
    (settings.DATA_DIR / "deployments" / "bench-4.toml").write_text(text)
    looks(found)
    assert "bench-2.toml" in deployments.standing_of("bench-2").failed
    assert "is of station 'bench-3'" in deployments.standing_of("bench-4").failed
    assert deployments.standing_of("bench-3").up


def test_what_is_simulated_by_hand_is_not_started_without_a_person(lab):
    started, found = lab
    path = deployments.write_simulated(name="bench-2", robot="ur5e").path
    own = [line for line in path.read_text().splitlines() if not line.startswith("#")]
    camera = ["[cameras.cam_high]", 'kind = "rtsp"', 'url = "rtsp://203.0.113.9/x"', 'password_env = "OTHER"']
    for task in ("", f'task = "# {deployments._CHOSEN}"'):
        kept_task = [line for line in own if not (task and line.startswith("task"))]
        path.write_text("\n".join(["# by hand", task, *kept_task, *camera]))
        assert deployments.is_simulated(deployments.stored_deployment("bench-2").resolved())
        looks(found)
        assert started.programs == []
    assert deployments.standing_of("bench-2") == Standing()


def test_exchanged_cameras_leave_a_simulated_station_the_labs(lab):
    deployments.write_simulated(name="bench-2", robot="ur5e")
    deployments.cameras_exchanged(name="bench-2", shown={"cam_high": "cam_high"})
    assert deployments.stored_deployment("bench-2").chosen


@pytest.mark.parametrize(
    ("policy", "said"), [(None, "was deleted while its policy runs"), ({}, "has no url in its policy")]
)
def test_a_checkpoint_that_cannot_be_used_is_said_and_stops_nothing_else(lab, policy, said):
    started, found = lab
    deployments.write_simulated(name="bench-2", robot="ur5e")
    looks(found)
    row = Checkpoint.objects.filter(name="pick-place-40k-ur5e")
    row.delete() if policy is None else row.update(policy=policy)
    deployments.write_simulated(name="bench-3", robot="ur5e")
    deployments.write_simulated(name="bench-4", robot="agilex_piper")
    looks(found)
    assert said in deployments.standing_of("bench-3").failed
    assert deployments.standing_of("bench-2").up
    assert deployments.standing_of("bench-4").up
    assert "bench-bench-3" not in started.pids()


def test_whatever_goes_wrong_ends_no_other_station(lab, monkeypatch, caplog):
    started, found = lab
    deployments.write_simulated(name="bench-2", robot="ur5e")
    monkeypatch.setattr(started, "start", lambda program: 1 / 0)
    looks(found)
    assert deployments.standing_of("bench-2").failed.startswith("ZeroDivisionError: division by zero")
    assert "bench-bench-2" not in started.pids()
    monkeypatch.setattr(deployments, "stored_deployments", lambda: {}["odd"])
    looks(found)
    assert caplog.text.count("the folder of deployments cannot be looked at") == 1


@pytest.mark.parametrize("url", ["ws://gpu:80800", "ws://[", 5, "", None, "ws://gpu"])
def test_an_address_without_a_port_is_no_free_port(url):
    assert simulated.free_port_of(url) == 0


def test_programs_that_it_did_not_start_are_left_alone(lab):
    started, found = lab
    others = [ProgramSpec("station-tabletop", ("-m", "runtime")), ProgramSpec("bench-tabletop", ())]
    started.programs += others
    parts = {"transport": {"kind": "zmq"}, "policy": {"kind": "openpi"}}
    deployments.write_draft(name="tabletop", robot="ur5e", task="", parts=parts)
    looks(found)
    deployments.remove(name="tabletop")
    looks(found)
    assert started.programs == others
    deployments.write_simulated(name="tabletop", robot="ur5e")
    looks(found)
    assert "is a program of this lab already" in deployments.standing_of("tabletop").failed
    assert started.programs == others


def test_a_name_is_used_again_once_what_had_it_has_ended(lab, monkeypatch):
    started, found = lab
    monkeypatch.setattr(started, "ending", lambda: {"station-bench-2"})
    deployments.write_simulated(name="bench-2", robot="ur5e")
    looks(found)
    assert started.programs == []
    monkeypatch.setattr(started, "ending", set)
    looks(found)
    assert deployments.standing_of("bench-2").up
