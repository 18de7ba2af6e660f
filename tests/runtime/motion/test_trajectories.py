import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from runtime.motion.trajectories import Brake, Trajectory

angles = st.lists(st.floats(-3, 3), min_size=4, max_size=4).map(np.array)


def samples(motion, count=2001):
    times = np.linspace(0, motion.duration, count)
    return times, np.array([motion.at(t) for t in times])


@given(angles, angles, st.floats(0.2, 5), st.floats(0.5, 20))
def test_a_trajectory_starts_and_ends_at_rest_within_its_limits(start, goal, speed, rate):
    velocity, acceleration = np.full(4, speed), np.full(4, rate)
    motion = Trajectory(start, goal, velocity, acceleration)
    assert np.allclose(motion.at(0.0), start)
    assert np.allclose(motion.at(motion.duration + 1), goal)
    if motion.duration == 0.0:
        return
    times, path = samples(motion)
    dt = times[1]
    speeds = np.diff(path, axis=0) / dt
    assert np.abs(speeds).max() <= speed * (1 + 1e-6)
    assert np.abs(np.diff(speeds, axis=0) / dt).max() <= rate * (1 + 1e-4) + 1e-6 / dt**2 * 1e-6
    low, high = np.minimum(start, goal), np.maximum(start, goal)
    assert (path >= low - 1e-9).all()
    assert (path <= high + 1e-9).all()


def test_joints_keep_step_so_the_path_is_a_straight_line():
    start, goal = np.zeros(2), np.array([1.0, 0.1])
    motion = Trajectory(start, goal, np.ones(2), np.ones(2))
    _, path = samples(motion, 50)
    assert np.allclose(path[:, 1], path[:, 0] / 10)


def test_going_nowhere_takes_no_time():
    motion = Trajectory(np.ones(3), np.ones(3), np.ones(3), np.ones(3))
    assert motion.duration == 0.0
    assert (motion.at(0.0) == 1).all()


@given(angles, angles, st.floats(1, 60))
def test_a_brake_never_reverses_and_comes_to_rest(q, velocity, deceleration):
    brake = Brake(q, velocity, np.full(4, deceleration), np.full(4, -99.0), np.full(4, 99.0))
    end = brake.at(brake.duration)
    assert np.allclose(brake.at(brake.duration + 5), end)
    assert np.allclose(end, q + np.sign(velocity) * velocity**2 / (2 * deceleration), atol=1e-9)
    _, path = samples(brake, 200)
    assert (np.diff(path, axis=0) * np.sign(velocity) >= -1e-9).all()


def test_a_brake_never_leaves_the_limits_and_a_joint_outside_them_may_stay():
    lower, upper = np.full(2, -1.0), np.full(2, 1.0)
    brake = Brake(np.array([0.99, 1.2]), np.array([2.0, 0.5]), np.full(2, 5.0), lower, upper)
    _, path = samples(brake, 100)
    assert path[:, 0].max() <= 1.0
    assert path[:, 1].max() <= 1.2
