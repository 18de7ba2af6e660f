"""A robot whose servos follow what they are told, seen through an encoder that is off: it must not run away."""

import numpy as np
import pytest

from runtime.ipc.shared_state import EStop
from tests.runtime.tick_bench import PERIOD, TWO_JOINTS, Bench, following, wave

BEGINS, FOR = 1.0, 8.0  # [s] after the fault began
ONE_DISPLACEMENT = 0.9  # [rad]: the following error, and what a joint may move while samples agree


class Servo(Bench):
    """Joint a is read by `fault(true, seconds since it began)`; it goes on towards its command after `lag` ticks."""

    def __init__(self, fault, lag=0, **given):
        self.fault, self.began, self.lag = None, 0.0, lag
        self.true = np.zeros(2)
        super().__init__({"kind": "naive"}, **given)
        self.moves = []
        self._to_be = fault

    def break_encoder(self):
        self.fault, self.began = self._to_be, self.clock.now()

    def observe(self, **changes):
        read = self.true.copy()
        if self.fault is not None:
            read[0] = self.fault(read[0], self.clock.now() - self.began)
        super().observe(qpos=read.astype(np.float32), **changes)

    def go(self, seconds):
        """The true joint a, tick by tick."""
        for _ in range(round(seconds / PERIOD)):
            self.run()
            told = self.sent[-1 - self.lag] if len(self.sent) > self.lag else self.true
            most = 2.0 * TWO_JOINTS.velocity * PERIOD  # what it is told is slower
            self.true = self.true + np.clip(told - self.true, -most, most)
            self.moves.append(self.true[0])


FAULTS = {
    "offset": lambda true, since: true + 0.9,
    "offset below": lambda true, since: true - 0.6,
    "small offset": lambda true, since: true + 0.25,
    "ramping": lambda true, since: true + min(1.0 * since, 0.9),
    "ramping on": lambda true, since: true + 0.6 * since,
    "flipped": lambda true, since: -true,
    "scaled": lambda true, since: 1.2 * true,
    "alternating": lambda true, since: true + (0.7 if since % 1.0 < 0.5 else -0.7),
    "returning": lambda true, since: true + (0.7 if since % 0.6 < 0.3 else 0.0),
}


def told(bench, state):
    if state == "estop":
        bench.shared.set_estop(EStop.LATCHED)
    elif state == "hold":
        bench.say("hold", run=1)


@pytest.mark.some(8)
@pytest.mark.parametrize("lag", [0, 5])
@pytest.mark.parametrize("state", ["estop", "hold", "running, then hold", "running, then estop"])
@pytest.mark.parametrize("fault", FAULTS)
def test_an_encoder_that_is_off_never_makes_a_robot_run_away(fault, state, lag):
    bench = following(Servo(FAULTS[fault], lag), wave(60, 0.4))
    bench.go(1.0)
    if state in ("estop", "hold"):
        told(bench, state)
        bench.go(1.0)
    bench.break_encoder()
    bench.go(0.3)
    told(bench, state.split()[-1])
    begins = bench.true[0]
    bench.go(FOR)
    way = np.diff(bench.sent[:, 0])
    assert np.abs(way).max() <= 3.0 * PERIOD * 1.05
    assert np.ptp([begins, *bench.moves[-round(FOR / PERIOD) :]]) <= ONE_DISPLACEMENT
    assert np.ptp(bench.moves[-round(FOR / 2 / PERIOD) :]) <= 1e-3  # it stands


@pytest.mark.some(4)
@pytest.mark.parametrize("state", ["estop", "hold"])
@pytest.mark.parametrize("fault", ["offset", "offset below", "flipped", "alternating", "returning"])
def test_a_joint_that_leapt_is_not_followed_at_all(fault, state):
    bench = following(Servo(FAULTS[fault]), wave(60, 0.4))
    bench.go(1.5)
    told(bench, state)
    bench.go(1.0)
    stood = bench.sent[-1].copy()
    bench.said()
    bench.break_encoder()
    bench.go(FOR)
    assert np.abs(bench.sent[-round(FOR / PERIOD) :] - stood).max() <= 1e-6
    assert bench.said("implausible")[0].text.startswith("a reads")


@pytest.mark.parametrize("state", ["estop", "hold"])
def test_a_joint_that_keeps_its_distance_when_its_command_followed_is_named_and_held(state):
    bench = following(Servo(FAULTS["ramping"]), wave(60, 0.4))
    bench.go(1.0)
    told(bench, state)
    bench.go(1.5)
    bench.break_encoder()
    bench.go(FOR)
    texts = [event.text for event in bench.said("implausible")]
    assert len(texts) == 1
    assert texts[0].startswith("a reads ")
    assert texts[0].endswith("to which it was led already: is its encoder off?")


def test_e_stops_pressed_again_and_again_do_not_lead_a_robot_on():
    bench = following(Servo(FAULTS["small offset"]), wave(60, 0.0))
    bench.go(1.0)
    bench.break_encoder()
    bench.go(0.5)
    for _ in range(10):
        bench.shared.set_estop(EStop.LATCHED)
        bench.go(1.5)
        bench.shared.set_estop(EStop.CLEAR)
        bench.go(0.3)
    assert np.ptp(bench.moves) <= 0.25 + 0.06


def moved_by_hand(bench, way, speed=1.0):
    """A hand moves joint a by `way` at `speed`, and lets it stay there."""
    step = np.array([np.sign(way) * speed * PERIOD, 0.0])
    for _ in range(round(abs(way) / speed / PERIOD)):
        bench.moved_by_hand = bench.measured = bench.measured + step
        bench.run()
    bench.run(75)


@pytest.mark.some(4)
@pytest.mark.parametrize("state", ["estop", "hold"])
@pytest.mark.parametrize("speed", [0.5, 1.0, 3.0])
@pytest.mark.parametrize("way", [0.7, -0.7])
def test_an_arm_that_a_hand_moves_is_still_followed_no_faster_than_it_moves(state, speed, way):
    bench = following(Bench(), wave(60, 0.0))
    told(bench, state)
    bench.run(60)
    moved_by_hand(bench, way, speed)
    assert abs(bench.measured[0]) == pytest.approx(0.7, abs=0.04)
    assert abs(bench.sent[-1, 0] - bench.measured[0]) <= 0.2
    assert np.abs(np.diff(bench.sent[:, 0])).max() <= 3.0 * PERIOD * 1.05
    bench.run(60)  # it agrees: what comes next is a hand again
    bench.moved_by_hand = bench.measured = bench.sent[-1].copy()
    bench.run(60)
    before = bench.sent[-1, 0]
    moved_by_hand(bench, -way, speed)
    assert abs(bench.sent[-1, 0] - before) >= 0.5


SLIPS = {  # how far the encoder is off, so long after it began
    "at 0.05 rad/s": lambda since: 0.05 * since,
    "at 0.3 rad/s": lambda since: 0.3 * since,
    "at 1 rad/s": lambda since: 1.0 * since,
    "to 0.55 rad": lambda since: min(1.0 * since, 0.55),
    "to 0.9 rad": lambda since: min(1.0 * since, 0.9),
    "to -0.7 rad": lambda since: max(-0.4 * since, -0.7),
    "in steps": lambda since: 0.15 * (since // 0.5),
    "faster and faster": lambda since: 0.05 * since**2,
}
MOST_LED = 0.34  # [rad]


@pytest.mark.some(6)
@pytest.mark.parametrize("lag", [0, 5, 8])
@pytest.mark.parametrize("state", ["estop", "hold"])
@pytest.mark.parametrize("slip", SLIPS)
def test_a_held_arm_whose_encoder_slips_is_led_by_no_more_than_is_needed_to_see_it(slip, state, lag):
    bench = following(Servo(lambda true, since: true + SLIPS[slip](since), lag), wave(60, 0.0))
    bench.go(1.0)
    told(bench, state)
    bench.go(1.0)
    bench.break_encoder()
    bench.go(14.0)
    assert np.ptp(bench.moves[30:]) <= MOST_LED
    assert bench.shared.joint_problem or bench.said("implausible")


def smoothly(share):
    """A way as hands make it: that of least jerk (Flash and Hogan 1985)."""
    return share**3 * (10.0 - 15.0 * share + 6.0 * share**2)


@pytest.mark.some(4)
@pytest.mark.parametrize("state", ["estop", "hold"])
@pytest.mark.parametrize("seconds", [0.7, 1.5, 3.0, 6.0])
@pytest.mark.parametrize("way", [0.8, -1.6])
def test_an_arm_that_a_hand_moves_as_hands_do_is_followed(way, seconds, state):
    bench = following(Bench(), wave(60, 0.0))
    told(bench, state)
    bench.run(60)
    start, count = bench.measured.copy(), round(seconds / PERIOD)
    for tick in range(1, count + 1):
        at = start + np.array([way * smoothly(tick / count), 0.0])
        bench.moved_by_hand = bench.measured = at
        bench.run()
    bench.run(120)
    assert abs(bench.sent[-1, 0] - bench.measured[0]) <= bench.safety.following_error
    assert not bench.said("implausible")


def test_a_joint_is_followed_again_after_it_agreed_for_a_second_or_a_set_up():
    for again in ("agrees", "set up"):
        bench = following(Bench(), wave(60, 0.0))
        told(bench, "hold")
        bench.run(60)
        bench.moved_by_hand = bench.measured = np.array([0.9, 0.0])  # leaps
        bench.run(30)
        assert bench.sent[-1, 0] == pytest.approx(0.0)
        if again == "set up":
            bench.say("meet")
            bench.run(60)
            assert bench.sent[-1, 0] == pytest.approx(0.9)
            continue
        bench.moved_by_hand = bench.measured = np.full(2, 0.02)  # exactly 0 would be a dead encoder
        bench.run(45)
        moved_by_hand(bench, 0.7)
        assert bench.sent[-1, 0] > 0.5


def leapt(way):
    """A joint that is held at 0 and is read `way` from there from now on, through an encoder that is off."""
    bench = following(Servo(lambda true, since: true + way), wave(60, 0.0))
    bench.go(1.0)
    told(bench, "hold")
    bench.go(1.0)
    bench.break_encoder()
    bench.go(0.5)
    return bench


@pytest.mark.parametrize("way", [0.4, 0.9, -0.9])
def test_where_a_joint_leapt_is_in_the_status_until_a_set_up_meets_it(way):
    bench = leapt(way)
    assert bench.shared.joint_problem.startswith(f"a reads {way:.3f} rad and is held at 0.000")
    bench.fault = lambda true, since: way  # the encoder is right: the joint stands there
    bench.say("meet")
    for _ in range(60):
        bench.go(PERIOD)
        assert abs(bench.sent[-1, 0] - way) <= 0.1001 or bench.shared.joint_problem
    assert bench.sent[-1, 0] == pytest.approx(way, abs=1e-3)
    assert bench.shared.joint_problem == ""
    most = TWO_JOINTS.velocity[0] * bench.safety.motion_velocity_scale * PERIOD
    assert np.abs(np.diff(bench.sent[:, 0])).max() <= most * 1.01


@pytest.mark.parametrize("way", [0.4, 0.9])
def test_a_joint_that_goes_away_from_the_set_up_that_meets_it_is_led_no_further(way):
    bench = leapt(way)
    bench.say("meet")
    bench.go(FOR)
    assert "set up again" in bench.shared.joint_problem
    assert 0.0 < bench.true[0] <= 0.25, "far enough to see that its reading goes along"
    assert "is its encoder off?" in bench.said("implausible")[-1].text


@pytest.mark.parametrize("state", ["hold", "estop"])
@pytest.mark.parametrize("slip", [0.6, 0.8])
def test_an_encoder_that_slips_and_recovers_again_and_again_moves_the_robot_once(state, slip):
    """As a hand would move it, within three samples; between two slips both agree for longer than a second."""
    bench = Servo(
        lambda true, since: true + slip * float(np.clip(since % 3.0 / (3 * PERIOD), 0.0, since % 3.0 < 1.5))
    )
    bench.say("motion", goal=np.zeros(2))
    bench.go(0.5)
    told(bench, state)
    bench.go(0.5)
    bench.break_encoder()
    bench.go(18.0)
    assert np.abs(bench.moves).max() <= slip + 0.1


@pytest.mark.parametrize("end", ["e-stop", "hold", "silence"])
def test_a_stop_ends_at_once_what_a_set_up_leads_to_where_a_joint_is_read(end):
    bench = leapt(0.9)
    bench.say("meet")
    bench.go(0.3)
    if end == "silence":
        bench.alive = False
        bench.clock.advance(2.0)  # nobody has given a sign of life since
        bench.run(1)
    else:
        told(bench, "estop" if end == "e-stop" else end)
    begins = bench.true[0]
    assert 0.05 < begins < 0.6
    bench.go(2.0)
    assert abs(bench.true[0] - begins) <= 0.1
    assert bench.shared.joint_problem


@pytest.mark.some(4)
@pytest.mark.parametrize("lag", [0, 5, 8])
@pytest.mark.parametrize("over", [0.03, 0.5, 3.0])
@pytest.mark.parametrize("slip", [0.15, 0.3, -0.45])
def test_an_e_stop_goes_to_a_reading_that_slipped_at_rest_in_parts(slip, over, lag):
    """Whether a person holds the arm there, or its encoder has slipped, is seen on the way."""
    bench = following(Servo(lambda true, since: true + slip * min(since / over, 1.0), lag), wave(60, 0.0))
    bench.go(1.5)
    told(bench, "hold")
    bench.go(1.5)
    bench.break_encoder()
    bench.go(over + 2.0)
    begins, sent = bench.true[0], len(bench.sent)
    told(bench, "estop")
    bench.go(6.0)
    assert np.ptp([begins, *bench.moves[-180:]]) <= MOST_LED
    most = TWO_JOINTS.velocity[0] * bench.safety.motion_velocity_scale * PERIOD
    assert np.abs(np.diff(bench.sent[sent - 1 :, 0])).max() <= most * 1.01


@pytest.mark.parametrize("way", [0.15, -0.3, 0.45])
def test_an_e_stop_lets_go_of_a_person_who_pushes_an_arm_away(way):
    bench = following(Bench(), wave(60, 0.0))
    told(bench, "hold")
    bench.run(60)
    moved_by_hand(bench, way, 0.5)
    told(bench, "estop")
    bench.run(60)
    assert abs(bench.sent[-1, 0] - bench.measured[0]) <= 0.1
    assert not bench.said("implausible")


@pytest.mark.parametrize("reach", [0.1, 0.25, 0.4, 0.8])
def test_a_hand_that_goes_to_and_fro_is_not_taken_for_an_encoder(reach):
    bench = following(Bench(), wave(60, 0.0))
    told(bench, "estop")
    bench.run(60)
    start, turn, way = bench.measured[0], 1.0, 0.0
    for _ in range(240):
        way += turn * 0.5 * PERIOD
        turn = -turn if abs(way) >= reach else turn
        bench.moved_by_hand = bench.measured = np.array([start + way, 0.0])
        bench.run()
    bench.run(90)
    assert not bench.said("implausible")
    assert abs(bench.sent[-1, 0] - bench.measured[0]) <= 0.1


@pytest.mark.some(3)
@pytest.mark.parametrize("end", ["hold", "estop", "nothing"])
@pytest.mark.parametrize("slip", [0.3, 0.6, 0.8])
def test_an_encoder_that_slips_in_a_run_that_stands_still_is_not_followed_at_once(slip, end):
    bench = following(Servo(lambda true, since: true + min(0.6 * since, slip)), wave(400, 0.0))
    bench.go(2.0)
    bench.break_encoder()
    bench.go(1.5)
    told(bench, end)
    bench.go(6.0)
    assert np.abs(bench.moves).max() <= MOST_LED
