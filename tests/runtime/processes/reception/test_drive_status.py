import pytest

from runtime.ipc.session_state import SessionState
from runtime.processes.reception.drive_status import DriveStatus
from tests.runtime.lockstep_station import Station, stubbed

GOOD = {"enabled": True, "faults": []}
OFF = {"enabled": False, "faults": []}


@pytest.fixture
def drives():
    return DriveStatus()


def test_what_is_as_it_should_be_needs_no_line(drives):
    assert drives.newest == {}
    assert drives.update(GOOD, 1.0) == ""
    assert drives.newest == GOOD


def test_every_change_is_told_once_in_one_sentence(drives):
    assert (
        drives.update(OFF | {"faults": ["axis 2 is hot"]}, 1.0)
        == "drives disabled; drive fault: axis 2 is hot"
    )
    assert drives.update(OFF | {"faults": ["axis 2 is hot"]}, 2.0) == ""
    assert (
        drives.update(OFF | {"faults": ["no phase"]}, 3.0)
        == "drive fault: no phase; drive fault gone: axis 2 is hot"
    )
    assert drives.update(GOOD, 4.0) == "drives enabled; drive fault gone: no phase"


def test_a_node_that_does_not_say_is_no_change_and_known_of_no_drives(drives):
    drives.update(OFF, 1.0)
    assert drives.update(None, 2.0) == ""
    assert drives.newest == {}
    assert drives.update(OFF, 3.0) == ""


def test_a_node_that_says_something_else_in_every_frame_floods_no_log(drives):
    told = [drives.update(GOOD | {"faults": [f"at {k}"]}, 10 + k / 30) for k in range(60)]
    assert 0 < sum(map(bool, told)) <= 10
    assert drives.newest["faults"] == ["at 59"]


def test_a_change_that_stays_is_told_although_it_came_too_soon(drives):
    assert drives.update(OFF, 1.0) == "drives disabled"
    assert drives.update(GOOD, 1.1) == ""
    assert drives.update(GOOD, 1.3) == "drives enabled"


def test_a_robot_whose_drives_are_off_is_not_set_up_until_they_are_on(tmp_path):
    station = Station(stubbed(tmp_path))
    station.robot.drives = {"enabled": False, "faults": ["axis 2 is hot"]}
    station.prepare()
    assert station.state is SessionState.IDLE
    assert "drives are disabled (axis 2 is hot)" in station.reason
    assert station.coordinator.snapshot()["drives"] == station.robot.drives
    assert station.events("drives") == ["drives disabled; drive fault: axis 2 is hot"]
    station.robot.drives = GOOD
    station.ready()
    assert station.events("drives")[1:] == ["drives enabled; drive fault gone: axis 2 is hot"]


def test_drives_that_switch_off_in_a_run_are_told_in_its_episode(tmp_path):
    station = Station(stubbed(tmp_path)).running()
    station.robot.drives = OFF
    station.robot.blocked = True
    station.go(30)
    assert station.events("drives") == ["drives disabled"]
    assert "drives disabled" in [event["text"] for event in station.stop().events]
