from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import robots
from runtime.core.errors import ConfigurationError, ContradictionError, PolicyError
from runtime.core.types import Observation
from runtime.policies.async_inference.pickles import TimedAction
from runtime.policies.async_inference.request import AsyncRequest, RequestSettings

ROBOT = robots.load_robot("agilex_piper")
SETTINGS: dict[str, Any] = {"policy_type": "act", "checkpoint": "user/ckpt", "images": {"top": "cam_high"}}


def request(**settings: Any) -> AsyncRequest:
    return AsyncRequest(RequestSettings(**{**SETTINGS, **settings}), ROBOT, 30.0)


def actions(rows: Any, first: int = 5, rate: float = 30.0) -> list[TimedAction]:
    return [TimedAction(1e9 + i / rate, first + i, row) for i, row in enumerate(np.asarray(rows, np.float32))]


def sent(made: AsyncRequest) -> Any:
    wire = pytest.importorskip(
        "runtime.standins.lerobot_wire", reason="the extra lerobot-grpc is not installed"
    )
    pictures = {camera.key: np.full((4, 6, 3), 7, np.uint8) for camera in ROBOT.cameras}
    qpos = np.arange(14, dtype=np.float32) / 4
    return wire.unpickle(made.build(Observation(1, 0.0, {}, qpos, pictures, prompt="pick"), 5))


def told(made: AsyncRequest) -> Any:
    wire = pytest.importorskip(
        "runtime.standins.lerobot_wire", reason="the extra lerobot-grpc is not installed"
    )
    return wire.unpickle(made.setup_message())


def test_an_observation_has_motors_pictures_and_task_and_must_go() -> None:
    shown = sent(request())
    assert (shown.timestep, shown.must_go) == (5, True)
    assert shown.observation["left_arm.joint1.pos"] == 0.25
    assert type(shown.observation["left_arm.joint1.pos"]) is float
    assert shown.observation["top"].shape == (4, 6, 3)
    assert shown.observation["task"] == "pick"
    assert len(shown.observation) == 16


def test_the_server_is_told_what_to_load_and_what_it_will_see() -> None:
    config = told(request(image_size=[24, 32], rename={"a": "b"}, device="cpu", actions_per_chunk=20))
    assert (config.policy_type, config.pretrained_name_or_path, config.device) == ("act", "user/ckpt", "cpu")
    assert (config.actions_per_chunk, config.rename_map) == (20, {"a": "b"})
    assert config.lerobot_features["observation.images.top"] == {
        "dtype": "image",
        "shape": (24, 32, 3),
        "names": ["height", "width", "channels"],
    }
    state = config.lerobot_features["observation.state"]
    assert (state["dtype"], state["shape"], state["names"][0]) == ("float32", (14,), "left_arm.joint0.pos")


def test_the_state_takes_its_places_and_names() -> None:
    made = request(state=[13, 0], state_names=["x", "y"])
    assert [sent(made).observation[name] for name in ("x", "y")] == [3.25, 0.0]
    assert told(made).lerobot_features["observation.state"]["names"] == ["x", "y"]


def test_grippers_are_counted_as_the_model_does() -> None:
    made = request(gripper="droid")
    rows = made.rows(actions(np.ones((1, 14))), 5)
    closed = [group.gripper.close for group in ROBOT.groups if group.gripper is not None]
    np.testing.assert_allclose(rows[0, list(ROBOT.gripper_dims)], closed)
    shown = sent(made).observation  # the gripper of the second arm is far beyond open
    assert shown["right_arm.joint6.pos"] == 0.0


def test_rows_go_by_their_steps_to_their_places() -> None:
    rows = np.arange(28, dtype=np.float32).reshape(2, 14)
    assert (request().rows(actions(rows)[::-1], 5) == rows).all()
    turned = request(actions=[*range(7, 14), *range(7)])
    np.testing.assert_array_equal(turned.rows(actions(rows), 5), np.roll(rows, 7, axis=1))


@pytest.mark.parametrize(
    ("given", "says"),
    [
        ([], "no actions"),
        (actions(np.zeros((2, 14)), first=6), "steps 6, 7; expected 5"),
        (actions(np.zeros((9, 14)), first=4), "steps 4, 5, 6, 7, ... 12"),
        (actions(np.zeros((1, 14))) * 2, "steps 5, 5"),
        (actions(np.zeros((2, 13))), "rows of 13 numbers; this robot needs 14"),
        (actions(np.full((2, 14), np.nan)), "nan at row 0"),
        (
            [*actions(np.zeros((1, 14))), TimedAction(1e9 + 1 / 30, 6, np.zeros(3, np.float32))],
            r"shape \[3\]",
        ),
        (actions(np.zeros((2, 1, 14))), "expected \\[14\\] each"),
    ],
)
def test_actions_that_answer_something_else_are_named(given: Any, says: str) -> None:
    with pytest.raises(PolicyError, match=says):
        request().rows(given, 5)


def test_rows_of_another_rate_contradict_the_configuration() -> None:
    rows = actions(np.zeros((3, 14)), rate=15.0)
    with pytest.raises(ContradictionError, match=r"rows are at 15 Hz, policy.action_rate .* is 30 Hz"):
        request().rows(rows, 5)
    assert request(action_rate=15.0).rows(rows, 5).shape == (3, 14)
    with pytest.raises(ContradictionError, match="0 s apart"):
        request().rows([TimedAction(0.0, 5 + i, np.zeros(14, np.float32)) for i in range(2)], 5)


@pytest.mark.parametrize(
    ("settings", "says"),
    [
        ({"images": {"top": "cam_low"}}, "cam_low"),
        ({"state": [14]}, "policy.state = .* leaves the vector"),
        ({"actions": [0, 1]}, "each of 0 to 13 once"),
        ({"actions": [*range(13), 0]}, "each of 0 to 13 once"),
        ({"state_names": ["a"]}, "has 1 names, 1 different ones; the state has 14"),
        ({"state": [0, 1], "state_names": ["a", "a"]}, "2 names, 1 different ones"),
    ],
)
def test_maps_that_do_not_fit_the_robot_are_refused(settings: dict[str, Any], says: str) -> None:
    with pytest.raises(ConfigurationError, match=says):
        request(**settings)
