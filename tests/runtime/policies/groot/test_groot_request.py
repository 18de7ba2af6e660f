from __future__ import annotations

import contextlib
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays_of

import robots
from runtime.core.errors import ConfigurationError, ContradictionError, PolicyError
from runtime.core.pose_format import PoseFormat
from runtime.core.types import Float32, Observation
from runtime.policies.groot.modality import ActionFormat, Modalities, Modality
from runtime.policies.groot.request import Gr00tRequest, RequestSettings

ROBOT = robots.load_robot("agilex_piper")
LEFT, RIGHT = list(range(7)), list(range(7, 14))
SETTINGS: dict[str, Any] = {
    "video": {"ego_view": "cam_high"},
    "state": {"left": LEFT, "right": RIGHT},
    "actions": {"left": LEFT, "right": RIGHT},
}


def wanted(**changes: Any) -> Modalities:
    made: dict[str, Any] = {
        "video": Modality(("ego_view",)),
        "state": Modality(("left", "right")),
        "action": Modality(("left", "right"), tuple(range(16))),
        "language": Modality(("task",)),
        "is_n15": False,
    }
    return Modalities(**{**made, **changes})


def request(agreed: Modalities | None = None, **settings: Any) -> Gr00tRequest:
    made = Gr00tRequest(RequestSettings(**{**SETTINGS, **settings}), ROBOT, 30.0)
    made.configure(agreed or wanted())
    return made


def observation(step: int = 0) -> Observation:
    pictures = {
        camera.key: np.full((4, 6, 3), 10 * step % 250 + index, np.uint8)
        for index, camera in enumerate(ROBOT.cameras)
    }
    return Observation(1, 0.0, {}, np.arange(14, dtype=np.float32) + step, pictures, step=step)


def shown(made: Gr00tRequest, step: int = 0) -> dict[str, Any]:
    return made.build(made.model_input(observation(step)), "pick")


def answer(height: int = 2) -> dict[str, Float32]:
    rows = np.arange(14 * height, dtype=np.float32).reshape(1, height, 14)
    return {"left": rows[..., LEFT], "right": rows[..., RIGHT]}


def test_nested_requests_have_batch_and_time() -> None:
    data = shown(request())
    assert list(data) == ["observation", "options"]
    assert list(data["observation"]) == ["video", "state", "language"]
    assert data["observation"]["video"]["ego_view"].shape == (1, 1, 4, 6, 3)
    assert data["observation"]["language"] == {"task": [["pick"]]}
    state = data["observation"]["state"]
    assert state["right"].shape == (1, 1, 7)
    assert state["right"].dtype == np.float32
    np.testing.assert_array_equal(state["right"][0, 0], np.arange(7, 14))


def test_the_sim_wrapper_and_n15_want_flat_keys() -> None:
    flat = shown(request(dialect="sim_wrapper"))["observation"]
    assert set(flat) == {"video.ego_view", "state.left", "state.right", "task"}
    assert flat["video.ego_view"].shape == (1, 1, 4, 6, 3)
    assert flat["task"] == ["pick"]
    early = shown(request(wanted(is_n15=True), dialect="n1.5"))
    assert set(early) == set(flat)
    assert early["video.ego_view"].shape == (1, 4, 6, 3)
    assert early["state.left"].shape == (1, 7)


def test_state_parts_take_their_places_in_the_order_declared() -> None:
    made = request(wanted(state=Modality(("odd",))), state={"odd": [13, 0, 2]})
    np.testing.assert_array_equal(shown(made)["observation"]["state"]["odd"], [[[13, 0, 2]]])


def test_pictures_keep_their_size_unless_another_is_declared() -> None:
    made = request(image_size=[8, 16], resize="stretch")
    assert shown(made)["observation"]["video"]["ego_view"].shape == (1, 1, 8, 16, 3)


def test_action_parts_go_to_their_places_in_the_robots_order() -> None:
    swapped = request(actions={"left": [*range(7, 14)], "right": [*reversed(range(7))]})
    rows = swapped.rows([answer(), {}])
    whole = np.arange(28, dtype=np.float32).reshape(2, 14)
    np.testing.assert_array_equal(rows[:, 7:], whole[:, :7])
    np.testing.assert_array_equal(rows[:, :7], whole[:, 13:6:-1])
    assert rows.dtype == np.float32


def test_grippers_are_counted_as_the_model_does() -> None:
    made = request(gripper="droid")
    grippers = list(ROBOT.gripper_dims)
    qpos = np.zeros(14, np.float32)
    qpos[grippers] = [group.gripper.open for group in ROBOT.groups if group.gripper is not None]
    state = made.model_input(replace(observation(), qpos=qpos)).state
    np.testing.assert_array_equal(state, np.zeros(14))
    rows = made.rows([{key: np.zeros_like(part) for key, part in answer().items()}, {}])
    np.testing.assert_array_equal(rows[0], qpos)


def test_flat_answers_and_single_numbers_without_axis_are_read() -> None:
    flat = {f"action.{key}": part[0] for key, part in answer().items()}
    made = request(wanted(is_n15=True), dialect="n1.5")
    np.testing.assert_array_equal(made.rows(flat), np.arange(28).reshape(2, 14))
    names = {"left": LEFT, "most": RIGHT[:-1], "last": RIGHT[-1:]}
    apart = request(wanted(is_n15=True, action=Modality()), dialect="n1.5", actions=names)
    whole = flat["action.right"]
    parts = {"left": flat["action.left"], "most": whole[:, :-1], "last": whole[:, -1]}
    np.testing.assert_array_equal(apart.rows(parts), np.arange(28).reshape(2, 14))


@pytest.mark.parametrize(
    ("reply", "says"),
    [
        (answer(), "expected a list of two"),
        ([answer()], "a list of 1"),
        (None, "NoneType"),
        ([{"left": answer()["left"]}, {}], "no action 'right'; it has left"),
        ([{**answer(), "right": answer(3)["right"]}, {}], "different numbers of rows: left 2, right 3"),
        ([{**answer(), "right": answer()["right"][..., :-1]}, {}], "rows of 6 numbers"),
        ([{**answer(), "right": answer()["right"] * np.nan}, {}], "nan"),
        ([{**answer(), "right": np.zeros((2, 2, 7))}, {}], "shape"),
        ([{**answer(), "right": {"as": 1}}, {}], "another dialect"),
        ([{**answer(), "right": [1.0]}, {}], "is a list"),
        ([{key: part[:, :0] for key, part in answer().items()}, {}], "empty"),
    ],
)
def test_an_answer_that_cannot_be_rows_is_named(reply: object, says: str) -> None:
    with pytest.raises(PolicyError, match=says):
        request().rows(reply)


NUMBERS = arrays_of.arrays(
    st.sampled_from(["<f4", "<f8", "|u1", "|b1", "<i8"]),
    arrays_of.array_shapes(min_dims=0, max_dims=3, min_side=0),
)
REPLIES = st.recursive(
    st.none() | st.integers() | st.text(max_size=3) | NUMBERS,
    lambda inner: (
        st.lists(inner, max_size=3)
        | st.dictionaries(st.sampled_from(["left", "right", "action.left", "other"]), inner)
    ),
    max_leaves=8,
)


@given(REPLIES)
def test_whatever_is_decoded_is_rows_or_an_error(reply: object) -> None:
    for dialect in ("nested", "n1.5"):
        with contextlib.suppress(PolicyError):
            assert request(wanted(is_n15=dialect == "n1.5"), dialect=dialect).rows(reply).shape[1] == 14


@pytest.mark.parametrize(
    ("settings", "says"),
    [
        ({"video": {"ego_view": "cam_low"}}, "cam_low"),
        ({"state": {"left": [14]}}, "leaves the state"),
        ({"actions": {"left": LEFT}}, "not \\[7, 8"),
        ({"actions": {"left": LEFT, "right": [*range(6, 14)]}}, "twice \\[6\\]"),
        ({"actions": {"left": LEFT, "right": [*range(7, 15)]}}, "beyond \\[14\\]"),
    ],
)
def test_maps_that_do_not_fit_the_robot_are_refused(settings: dict[str, Any], says: str) -> None:
    with pytest.raises(ConfigurationError, match=says):
        request(**settings)


@pytest.mark.parametrize(
    ("changes", "settings", "says"),
    [
        ({"is_n15": True}, {}, "of version N1.5"),
        ({}, {"dialect": "n1.5"}, "newer than N1.5"),
        ({"video": Modality(("front",))}, {}, "video keys front; policy.video has ego_view"),
        ({"state": Modality(("left",))}, {}, "state keys left"),
        ({"action": Modality(("left", "right", "base"))}, {}, "actions keys left, right, base"),
        ({"language": Modality(("a", "b"))}, {}, "set policy.language_key"),
        ({"language": Modality()}, {}, "set policy.language_key"),
        ({"language": Modality(("a",))}, {"language_key": "b"}, "policy.language_key = 'b'"),
        ({"video": Modality(("ego_view",), (-8, 0))}, {}, 'allowed: "repeat" or "nearest"'),
        ({"state": Modality(("left", "right"), (-1, 0))}, {}, "sees state at the steps -1, 0"),
    ],
)
def test_what_contradicts_the_server_names_both_sides(
    changes: dict[str, Any], settings: dict[str, Any], says: str
) -> None:
    with pytest.raises(ContradictionError, match=says):
        request(wanted(**changes), **settings)


EEF = {"action_space": "eef", "actions": {"eef": [*range(3), *range(3, 9)], "other": [*range(9, 20)]}}


@pytest.mark.parametrize(
    ("written", "settings", "says"),
    [
        (
            ActionFormat("RELATIVE", "XYZ_ROT6D"),
            {},
            "'left' as XYZ_ROT6D; policy.action_space = 'joint'.*'6d'",
        ),
        (ActionFormat("RELATIVE", "XYZ_ROTVEC"), {}, "allowed: .eef. and 'rotation_vector'"),
        (ActionFormat("DELTA", "DEFAULT"), {}, "answers with changes for the action 'left'"),
    ],
)
def test_rows_of_poses_or_changes_are_not_taken_for_joints_or_targets(
    written: ActionFormat, settings: dict[str, Any], says: str
) -> None:
    action = Modality(("left", "right"), (0,), {"left": written})
    with pytest.raises(ContradictionError, match=says):
        request(wanted(action=action), **settings)


def test_what_is_written_as_declared_is_no_contradiction() -> None:
    fine = {"left": ActionFormat("RELATIVE", "DEFAULT"), "right": ActionFormat("DELTA", "DEFAULT")}
    request(wanted(action=Modality(("left", "right"), (0,), fine)), action_mode="delta")
    poses = {"eef": ActionFormat("RELATIVE", "XYZ_ROT6D"), "other": ActionFormat("ABSOLUTE", "XYZ_ROT6D")}
    action = Modality(
        ("eef", "other", "joints"), (0,), {**poses, "joints": ActionFormat("DELTA", "XYZ_ROTVEC")}
    )
    pose = PoseFormat(orientation="6d")
    request(wanted(action=action), action_pose=pose, ignored_actions=["joints"], **EEF)
    with pytest.raises(ContradictionError, match="orientation = 'wxyz'"):
        request(
            wanted(action=action),
            ignored_actions=["joints"],
            **{**EEF, "actions": {"eef": [*range(8)], "other": [*range(8, 16)]}},
        )


@pytest.mark.parametrize("steps", [(0, 1), tuple(range(-100, 1))])
def test_a_model_that_wants_the_future_or_too_much_is_refused(steps: tuple[int, ...]) -> None:
    with pytest.raises(PolicyError, match="allowed: at most 64"):
        request(wanted(video=Modality(("ego_view",), steps)), history="repeat")


def test_action_keys_that_this_robot_has_no_use_for_are_declared() -> None:
    made = request(wanted(action=Modality(("left", "right", "base"))), ignored_actions=["base"])
    assert made.rows([{**answer(), "base": np.zeros((1, 2, 3))}, {}]).shape == (2, 14)


def test_the_horizon_is_what_the_server_says() -> None:
    assert request().horizon == 16
    assert request(wanted(action=Modality())).horizon is None


def newest(data: dict[str, Any]) -> list[int]:
    return [int(picture.flat[0]) for picture in data["observation"]["video"]["ego_view"][0]]


def test_history_repeats_the_newest_or_takes_what_was_shown_nearest() -> None:
    several = wanted(video=Modality(("ego_view",), (-8, -4, 0)))
    repeated = request(several, history="repeat")
    assert [newest(shown(repeated, step)) for step in (0, 4)] == [[0, 0, 0], [40, 40, 40]]
    nearest = request(several, history="nearest")
    assert newest(shown(nearest, 0)) == [0, 0, 0]
    assert newest(shown(nearest, 4)) == [0, 0, 40]
    assert newest(shown(nearest, 9)) == [0, 40, 90]
    assert newest(shown(nearest, 13)) == [40, 90, 130]
    nearest.reset()
    assert newest(shown(nearest, 17)) == [170, 170, 170]


def test_history_counts_in_the_steps_of_the_model() -> None:
    made = request(wanted(video=Modality(("ego_view",), (-2, 0))), history="nearest", action_rate=15.0)
    for step in (0, 2, 4):
        shown(made, step)
    assert newest(shown(made, 6)) == [20, 60]


def test_history_is_not_kept_longer_than_it_is_needed() -> None:
    made = request(wanted(video=Modality(("ego_view",), (-8, 0))), history="nearest")
    for step in range(100):
        shown(made, step)
    assert len(made._moments) <= 10


def test_control_that_begins_anew_does_not_show_the_future() -> None:
    made = request(wanted(video=Modality(("ego_view",), (-8, 0))), history="nearest")
    shown(made, 20)
    assert newest(shown(made, 3)) == [30, 30]


# Servers without modality configurations


def contract(**changes: Any) -> Modalities:
    flat = {"video": Modality(None), "language": Modality(None), "contract": {"unnorm_key": "bench"}}
    return wanted(**{**flat, **changes})


def test_what_a_server_does_not_say_is_as_the_deployment_has_it() -> None:
    made = shown(request(contract()))
    assert list(made["observation"]["video"]) == ["ego_view"]
    assert made["observation"]["language"] == {"annotation.human.task_description": [["pick"]]}
    named = shown(request(contract(), language_key="task"))
    assert named["observation"]["language"] == {"task": [["pick"]]}


@pytest.mark.parametrize(
    ("changes", "settings", "says"),
    [
        ({"state": Modality(("left",))}, {}, "policy.state has left, right"),
        (
            {"state": Modality(("left", "right"), widths={"left": 6})},
            {},
            r"6 numbers in 'left'; policy.state.left",
        ),
        ({"action": Modality(("left", "right"), widths={"right": 8})}, {}, "policy.actions.right has 7"),
        ({}, {"dialect": "sim_wrapper"}, 'allowed for such a server: "nested"'),
    ],
)
def test_what_it_does_say_is_held_against_the_deployment(
    changes: dict[str, Any], settings: dict[str, Any], says: str
) -> None:
    with pytest.raises(ContradictionError, match=says):
        request(contract(**changes), **settings)
