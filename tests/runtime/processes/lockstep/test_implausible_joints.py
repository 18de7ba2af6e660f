"""A station whose joints cannot be where they are read: nothing begins to move, and the operator is told why."""

import numpy as np
import pytest

from runtime.core.errors import SetupError
from runtime.ipc.session_state import SessionState
from runtime.ipc.shared_state import SharedState
from tests.runtime.lockstep_station import MOVED, Station, stubbed

JOINT = "left_arm.joint0"
LEAP = 0.9  # [rad] beyond the following error
MOVES = [
    ("run", {}),
    ("run", {"mode": "manual"}),
    ("approach", {}),
    ("home", {}),
    ("gripper", {"action": "open"}),
]


def stay(observation, number):
    return np.tile(np.asarray(observation.qpos, float), (20, 1))


def ready(folder, home=True):
    made = stubbed(folder, rows=stay, setup={"home": home, "pose": "ready"}, recording={"enabled": False})
    station = Station(made).ready()
    station.go(45)
    return station


def misread(station, by, ticks=45):
    station.robot.misread[MOVED[0]] = by
    station.go(ticks)


def refused(station, moves=(("run", {}),)):
    """Why each of `moves` is refused; nothing is sent elsewhere meanwhile."""
    stood, said = station.robot.sent[-1], []
    for kind, arguments in moves:
        with pytest.raises(SetupError) as refusal:
            station.command(kind, **arguments)
        said.append(str(refusal.value))
    station.go(5)
    assert np.abs(station.robot.sent[-5:] - stood).max() <= 1e-6
    return said


def test_nothing_that_moves_begins_while_a_joint_has_leapt(tmp_path):
    station = ready(tmp_path)
    misread(station, LEAP, ticks=2)
    for said in refused(station, MOVES):
        assert f"{JOINT} reads" in said
    misread(station, LEAP)
    for said in refused(station, MOVES):
        assert f"{JOINT} reads" in said
        assert "set up again" in said
    assert not {kind for kind, _ in MOVES} & set(station.coordinator.session.allowed())
    misread(station, 0.0)  # it reads where it is held again
    station.command("run")
    station.go(30)
    assert station.state is SessionState.RUNNING
    misread(station, LEAP)
    assert station.state is SessionState.HOLDING
    for said in refused(station, [("resume", {}), ("gripper", {"action": "open"})]):
        assert JOINT in said


@pytest.mark.some(2)
@pytest.mark.parametrize("fault", ["no numbers", "noise", "small noise"])
def test_joints_that_are_no_numbers_or_noise_let_nothing_run_on(tmp_path, fault):
    """Noise that a joint can follow is none that can be told; what is sent then stays what the policy wants."""
    station = ready(tmp_path)
    rng = np.random.default_rng(3)
    reads = {"no numbers": lambda: np.nan, "noise": lambda: rng.normal(0.0, 1.0)}
    for _ in range(40):
        misread(station, reads.get(fault, lambda: rng.normal(0.0, 0.05))(), ticks=1)
    if fault == "small noise":
        station.command("run")
        assert station.state is SessionState.RUNNING
    else:
        refused(station)


def test_a_spike_costs_nothing_but_the_moment(tmp_path):
    station = ready(tmp_path)
    misread(station, LEAP, ticks=1)
    misread(station, 0.0, ticks=6)
    station.command("run")
    assert station.state is SessionState.RUNNING


@pytest.mark.some(1)
@pytest.mark.parametrize("home", [True, False])
def test_the_first_set_up_after_a_leap_takes_the_robot_over_where_it_is_read(tmp_path, home):
    """An arm that stands where it is read, and was seen on no way to there."""
    station = ready(tmp_path, home)
    if not home:  # what was moved once is held from then on
        station.command("home")
        station.until(lambda: station.state is SessionState.READY, 60.0, "home")
    station.robot.blocked = True
    station.robot.position[MOVED[0]] += LEAP
    station.go(45)
    refused(station)
    count = len(station.robot.sent)
    station.command("setup")
    meant = station.robot.position[MOVED[0]]
    station.until(lambda: abs(station.robot.sent[-1][MOVED[0]] - meant) < 0.15, 8.0, "the command there")
    station.robot.blocked = False
    station.until(lambda: station.state is not SessionState.SETTING_UP, 60.0, "set-up")
    assert station.state is SessionState.READY, station.reason
    assert not station.events("refusals")
    moved = np.abs(np.diff(station.robot.sent[count - 1 :], axis=0))
    assert (moved <= station.spec.limits.velocity / station.spec.rate * 1.05).all()
    station.command("run")
    station.go(30)
    assert station.state is SessionState.RUNNING


def test_a_set_up_that_cannot_follow_says_which_encoder_is_off(tmp_path):
    """The reading keeps its distance from wherever the joint is led."""
    station = ready(tmp_path)
    misread(station, LEAP)
    stood = station.robot.position[MOVED[0]]
    station.prepare()
    assert station.state is SessionState.IDLE
    assert JOINT in station.reason
    assert "is its encoder off" in station.reason
    station.go(60)
    assert abs(station.robot.position[MOVED[0]] - stood) <= LEAP + 0.1


def test_a_run_does_not_begin_where_a_joint_is_in_doubt_once_its_recording_is_open(tmp_path, monkeypatch):
    station = ready(tmp_path)
    station.command("run")  # accepted, and opened some ticks later
    monkeypatch.setattr(
        SharedState, "joint_problem", f"{JOINT} reads 0.450 rad and is held at 0.000"
    )  # said before, so no event
    station.go(30)
    assert station.state is SessionState.READY
    assert JOINT in station.reason
    assert station.coordinator.runs.open is None
