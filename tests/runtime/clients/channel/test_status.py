import json

import pytest

from runtime.clients.channel.json_answers import dumps
from runtime.clients.channel.scripts import ScriptSelection
from runtime.clients.channel.status import status as older
from tests.runtime.terminal_station import status

# Every key that scripts of the older channel may look at.
KEYS = [
    "robot_type",
    "transport_type",
    "transport_connected",
    "image_min_hz",
    "policy_connected",
    "policy_error",
    "cli_mode",
    "session_status",
    "selected_task",
    "selected_collect_task",
    "selected_strategy",
    "is_setup_done",
    "step_index",
    "chunk_index",
    "last_infer_ms",
    "run_elapsed_ms",
    "follow_human_gripper",
    "gripper_locks",
    "manual_dispatch",
    "manual_publish_active",
    "manual_qpos",
    "pending_chunk",
    "current_episode",
    "last_error",
    "replay_dataset_dir",
    "replay_episode_id",
    "replay_n_episodes",
    "replay_loaded",
    "replay_task",
    "replay_frame_index",
    "replay_total_frames",
    "replay_action_key",
    "replay_action_mode",
    "replay_fps",
    "replay_exec_steps",
    "setup_stage",
    "collection_replay",
    "collection_teleop_armed",
    "collection_teleop_active",
    "rollout_intervention_active",
    "rollout_intervention_enabled",
    "rollout_intervention_active_frames",
    "rollout_intervention_segments",
    "hil_supported",
    "hil_active",
    "hil_error",
    "rollout",
    "collect",
    "web_phase",
    "init_ready",
    "init_loaded",
    "ckpt_slot",
    "ckpt_label",
    "clip_id",
    "cell",
    "rl",
]


def snapshot(state="ready", **changes):
    more = {"checkpoint": {}, "episode": {}, "last_run": {}, "estop": ""}
    return status(state, **(more | changes))


def told(state="ready", selection=None, newest="", **changes):
    return older(snapshot(state, **changes), selection or ScriptSelection(), newest)


def test_every_key_of_the_older_channel_is_there_and_is_json():
    content = told()
    assert set(KEYS) <= content.keys()
    assert set(json.loads(dumps(content))["collection_replay"]) == {
        "active",
        "playing",
        "episode_index",
        "frame_index",
        "total_frames",
    }


@pytest.mark.parametrize(
    ("state", "word", "set_up"),
    [
        ("idle", "idle", False),
        ("ready", "idle", True),
        ("running", "running", True),
        ("holding", "holding", True),
        ("setting_up", "setting_up", False),
        ("faulted", "faulted", False),
        ("disconnected", "disconnected", False),
    ],
)
def test_who_waits_for_idle_waits_until_nothing_goes_on(state, word, set_up):
    content = told(state)
    assert (content["session_status"], content["is_setup_done"], content["state"]) == (word, set_up, state)
    assert content["transport_connected"] == (state != "disconnected")


def test_what_was_selected_is_shown_before_it_is_used():
    selection = ScriptSelection(task="pour", mode="preview", collect_task="wipe", target=[1.0, 2.0, 3.0])
    content = told(selection=selection)
    assert (content["selected_task"], content["selected_collect_task"]) == ("pour", "wipe")
    assert (content["cli_mode"], content["manual_qpos"]) == ("step", [1.0, 2.0, 3.0])
    assert told()["selected_task"] == "fold"
    assert told()["cli_mode"] == "real"


def test_an_open_run_shows_its_own_mode_and_its_time_in_milliseconds():
    run = {"number": 3, "elapsed": 2.5}
    content = told("running", ScriptSelection(mode="sim"), run=run, mode="manual")
    assert (content["cli_mode"], content["run_elapsed_ms"]) == ("manual", 2500.0)
    assert content["manual_publish_active"] is True
    assert content["collect"] is None


def test_the_slowest_camera_the_locks_and_a_recording_without_a_run_are_shown():
    content = told(link={"rates": {"joints": 90.0, "a": 30.0, "b": 12.5}}, recording={"uuid": "u", "rows": 7})
    assert content["image_min_hz"] == 12.5
    assert content["gripper_locks"] == {"left": True, "right": False}
    assert content["collect"] == {"uuid": "u", "rows": 7}
    assert content["current_episode"] == "u"


def test_the_last_error_is_that_of_the_newest_command_else_why_the_robot_holds():
    assert told(newest="refused")["last_error"] == "refused"
    assert told("holding", reason="joints are 0.23 s old")["last_error"] == "joints are 0.23 s old"
    assert told("ready")["last_error"] is None


def test_a_policy_that_is_lost_is_an_error_of_the_policy():
    lost = snapshot()["policy"] | {"lost": True}
    content = told("holding", policy=lost, reason="no answer within 1 s")
    assert (content["policy_connected"], content["policy_error"]) == (False, "no answer within 1 s")
    assert told()["policy_connected"] is True
