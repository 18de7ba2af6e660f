from __future__ import annotations

import numpy as np
import pytest

from runtime.simulation.bench.bench import BenchLayout
from runtime.simulation.scripts.pick_place import ScriptError, Skill
from tests.runtime.simulation.bench_trial import CAMERA, ROBOT, Trial

READY = ROBOT.poses["ready"]
GOOD = Skill(noise=0.001)
NOTHING = {"grasped": False, "lifted": False, "over_plate": False, "placed": False}


def moved(rows, q):
    return float(np.abs(rows - q).max())


def ticks(trial, count):
    """Obey one chunk's rows, one after the other, from the first on."""
    for row in trial.ask()[:count]:
        trial.plant.target = row
        trial.table.advance(trial.plant, 1 / 30)
        trial.clock.advance(1 / 30)


@pytest.mark.parametrize(
    "seed", [0, *(pytest.param(seed, marks=pytest.mark.exhaustive) for seed in (1, 2, 3))]
)
def test_a_good_policy_puts_the_block_on_the_plate_and_safety_has_nothing_to_change(seed):
    outcome = Trial(GOOD).lay(seed).run(20.0)
    assert outcome.success
    assert all(outcome.milestones.values())
    assert 9.0 < outcome.seconds < 18.0
    assert outcome.notes == ()


@pytest.mark.exhaustive
def test_it_succeeds_from_home_with_a_slow_inference():
    outcome = Trial(GOOD, delay=8, pose="home").lay(5).run(20.0)
    assert outcome.success
    assert outcome.notes == ()


def test_it_succeeds_when_each_chunk_is_nearly_used_up_before_the_next():
    assert Trial(GOOD, delay=20).lay(6).run(25.0).success


@pytest.mark.exhaustive
def test_the_same_seeds_give_the_same_commands():
    first, second, other = (Trial(Skill(0.01, 0.3, seed)).lay(4).run(6.0) for seed in (7, 7, 8))
    np.testing.assert_array_equal(first.sent, second.sent)
    assert not np.array_equal(first.sent, other.sent)


@pytest.mark.exhaustive
def test_one_connection_serves_trial_after_trial():
    trial = Trial(GOOD)
    assert [trial.lay(seed).run(20.0).success for seed in (8, 9)] == [True, True]


@pytest.mark.exhaustive
def test_afterwards_it_stands_still():
    trial = Trial(GOOD).lay(1)
    assert trial.run(17.0, to_the_end=True).success
    assert moved(trial.ask(), trial.plant.q) < 1e-3


def test_in_the_dark_it_does_not_move():
    trial = Trial(GOOD).lay(0)
    trial.dark = True
    outcome = trial.run(3.0)
    assert moved(outcome.sent, READY) < 1e-6
    assert outcome.milestones == NOTHING


@pytest.mark.exhaustive
def test_a_camera_that_goes_dark_on_the_way_stops_it():
    trial = Trial(GOOD).lay(0)
    trial.run(2.0)
    trial.dark = True
    assert moved(trial.ask(), trial.plant.q.astype(np.float32)) == 0.0
    trial.dark = False
    assert trial.run(18.0).success


def test_without_a_block_it_does_not_move(monkeypatch):
    from tests.runtime.simulation.drawn_bench import drawn

    trial = Trial(GOOD).lay(0)
    monkeypatch.setattr(trial, "picture", lambda: drawn(BenchLayout((), ((0.1, 0.3),))))
    assert moved(trial.ask(), trial.plant.q) < 1e-6


def test_a_block_that_lies_on_the_plate_is_left_there():
    trial = Trial(GOOD).lay(0)
    trial.put(*trial.table.state().discs[0], 0.012)
    assert moved(trial.ask(), trial.plant.q) < 1e-6


def test_a_request_without_its_picture_is_an_error():
    answer = Trial(GOOD).policy.begin()
    with pytest.raises(ScriptError, match="no picture 'cam_high'; it has cam_left_wrist"):
        answer(READY, {"cam_left_wrist": np.zeros((3, 8, 8), np.uint8)}, "")


def test_the_block_is_where_the_picture_shows_it_and_not_where_it_is(monkeypatch):
    trial = Trial(GOOD).lay(0)
    shown = trial.picture()
    trial.shove(0.0, 0.08)
    monkeypatch.setattr(trial, "picture", lambda: shown)
    outcome = trial.run(8.0)
    assert not outcome.milestones["grasped"]


@pytest.mark.exhaustive
def test_a_missed_grasp_is_noticed_and_tried_again():
    trial = Trial(GOOD).lay(0)
    trial.run(3.0)
    trial.shove(0.0, -0.06)  # under the hand, where the camera does not see it
    outcome = trial.run(40.0)
    assert outcome.success
    assert outcome.seconds > 15.0


@pytest.mark.exhaustive
def test_a_scene_that_changes_on_the_way_is_looked_at_again():
    trial = Trial(GOOD).lay(0)
    ticks(trial, 10)
    trial.shove(0.05, 0.0)
    assert trial.run(20.0).success


@pytest.mark.exhaustive
@pytest.mark.parametrize(
    "pause", [2.0, *(pytest.param(pause, marks=pytest.mark.exhaustive) for pause in (0.4, 60.0))]
)
def test_a_pause_on_the_way_is_no_harm(pause):
    trial = Trial(GOOD).lay(2)
    trial.run(8.0)
    q = trial.plant.q.copy()
    trial.clock.advance(pause)
    assert moved(trial.ask()[0], q) < 0.2
    assert trial.run(15.0).success


@pytest.mark.exhaustive
def test_a_robot_that_was_moved_by_another_hand_is_no_longer_on_the_route():
    trial = Trial(GOOD).lay(3)
    trial.run(5.0)
    trial.plant.q = READY.copy()
    assert moved(trial.ask()[0], READY) < 0.05
    assert trial.run(20.0).success


def test_another_instruction_begins_anew():
    trial = Trial(GOOD).lay(0)
    trial.run(2.0)
    q, pictures = trial.plant.q, {CAMERA: trial.picture()}
    on = trial.answer(q, pictures, "put the block on the plate")
    anew = trial.answer(q, pictures, "stack the blocks")
    assert moved(anew[0], q) < moved(on[0], q)


@pytest.mark.exhaustive
def test_what_it_let_go_of_stays_where_it_fell():
    trial = Trial(Skill(0.001, 1.0, first_that(lambda slip: slip.lets_go))).lay(0)
    outcome = trial.run(20.0, to_the_end=True)
    assert outcome.milestones == {"grasped": True, "lifted": True, "over_plate": False, "placed": False}
    assert moved(trial.ask(), trial.plant.q) < 1e-3
    assert moved(trial.lay(1).run(2.0).sent, READY) > 0.1  # another scene is another episode


@pytest.mark.exhaustive
def test_a_grasp_that_is_always_short_never_grasps():
    outcome = Trial(Skill(0.001, 1.0, first_that(lambda slip: slip.short > 0))).lay(0).run(20.0)
    assert outcome.milestones == NOTHING
    assert moved(outcome.sent, READY) > 0.1


def first_that(slips):
    """The first seed whose first episode slips in this way."""
    return next(
        seed for seed in range(50) if slips(Trial(Skill(0.0, 1.0, seed)).policy.next_episode_noise().slip)
    )


def test_slips_come_as_often_as_they_should():
    policy = Trial(Skill(0.0, 0.25, 3)).policy
    slips = [policy.next_episode_noise().slip for _ in range(400)]
    share = sum(slip.lets_go or slip.short > 0 for slip in slips) / len(slips)
    assert share == pytest.approx(0.25, abs=0.06)
    assert any(slip.lets_go for slip in slips)
    assert any(slip.short > 0 for slip in slips)


def test_noise_is_as_large_as_it_should_be_and_new_in_each_attempt():
    luck = Trial(Skill(noise=0.014)).policy.next_episode_noise()
    places = np.array([luck.perceive((0.1, 0.3, 0.2)) for _ in range(600)])
    np.testing.assert_allclose(places.mean(axis=0), (0.1, 0.3, 0.2), atol=0.05)
    np.testing.assert_allclose(places.std(axis=0), (0.014, 0.014, 0.35), rtol=0.12)


def test_it_says_what_it_is():
    metadata = Trial(Skill(0.014, 0.25, 2)).policy.metadata
    assert "scripted pick-and-place" in metadata["description"]
    assert (metadata["noise_mm"], metadata["failure_rate"], metadata["seed"]) == (14.0, 0.25, 2)
    assert metadata["action_horizon"] == 50
