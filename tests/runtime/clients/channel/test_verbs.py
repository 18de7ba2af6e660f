import json

import pytest

from runtime.clients.channel.message import read
from runtime.clients.channel.scripts import ScriptSelection
from runtime.clients.channel.verb_commands import UnsupportedVerb, VerbContext
from runtime.clients.channel.verbs import VERBS, commands_for_verb, stops
from tests.runtime.terminal_station import status
from tests.sources import ROOT

# As the older channel's allow-list has them, with `setup` and `select_task`, which it documented and refused.
THEIRS = [
    *(
        "bootstrap",
        "warmup",
        "switch_task",
        "rl_select_task",
        "rl_select_policy",
        "rl_select_critic",
        "rl_setup",
    ),
    *("start", "stop", "run", "halt", "reset", "console_reset", "init_move", "init_gripper", "init_done"),
    *("switch_ckpt", "operator_action", "connect", "disconnect", "select_mode", "select_episode"),
    *("load_replay_dataset", "clear_replay", "set_replay_fps", "replay_seek", "select_strategy"),
    *("update_infer_params", "rollout_intervention_abandon", "rollout_intervention_enabled", "rollout_save"),
    *(
        "rollout_stop",
        "tab_switch",
        "step_infer",
        "step_commit",
        "step_cancel",
        "manual_qpos",
        "manual_dispatch",
    ),
    *("manual_send", "manual_home", "collect_start", "collect_stop", "collect_cancel", "select_collect_task"),
    *("gripper", "setup", "select_task"),
]
FACTS = {
    "joint_names": ["a", "grip_l", "b", "grip_r"],
    "arms": ["left_arm", "right_arm"],
    "gripper_dims": [1, 3],
    "home": [0.1, 0.2, 0.3, 0.4],
    "strategies": {"async": [], "sync": []},
}
GRIPPERS = {"left_arm": {"locked": False, "at": 0.0}, "right_arm": {"locked": False, "at": 0.0}}
COMMANDED = [1.0, 2.0, 3.0, 4.0]


def scene(verb, state="ready", selection=None, facts=FACTS, grippers=GRIPPERS, episode=None, **more):
    message = read([json.dumps({"cmd": f"web:{verb}"} | more).encode()])
    shown = status(state, facts=facts, grippers=grippers, episode=episode or {})
    return VerbContext(message, shown, selection or ScriptSelection(), lambda: list(COMMANDED))


def steps(verb, state="ready", selection=None, **more):
    return [
        (kind, dict(arguments))
        for kind, arguments in commands_for_verb(scene(verb, state, selection, **more)).steps
    ]


def refusal(verb, state="ready", **more):
    with pytest.raises(UnsupportedVerb) as raised:
        commands_for_verb(scene(verb, state, **more))
    return str(raised.value)


def test_every_verb_of_the_older_channel_is_known():
    assert set(THEIRS) | {"estop"} == set(VERBS)
    assert all(verb.description for verb in VERBS.values())


CHOSEN = {"task": "pour", "strategy": {"kind": "sync"}, "mode": "preview", "target": COMMANDED}


@pytest.mark.parametrize(
    ("verb", "state", "given"),
    [
        ("setup", "idle", [("setup", {"task": "pour", "strategy": {"kind": "sync"}})]),
        ("start", "ready", [("run", {"mode": "preview"})]),
        ("start", "holding", [("run", {"mode": "preview"})]),  # refused by the station, which says so
        ("run", "ready", [("run", {"mode": "preview"})]),
        ("run", "holding", [("resume", {})]),
        ("stop", "running", [("stop", {})]),
        ("halt:now:please", "running", [("halt", {})]),
        ("rollout_stop", "running", [("stop", {})]),
        ("reset", "ready", [("home", {})]),
        ("reset", "holding", [("stop", {}), ("home", {})]),
        ("console_reset", "ready", [("home", {})]),
        ("console_reset", "holding", [("stop", {}), ("home", {})]),
        ("console_reset", "running", [("home", {})]),  # refused by the station, which says so
        ("manual_home", "running", []),
        ("manual_send", "running", [("move", {"joints": COMMANDED})]),
        ('init_move:{"qpos": [0, 1, 2, 3.5]}', "running", [("move", {"joints": [0.0, 1.0, 2.0, 3.5]})]),
        ("init_gripper:close:right", "ready", [("gripper", {"action": "close", "arm": "right_arm"})]),
        ("gripper:l:open:1", "ready", [("gripper", {"action": "open", "arm": "left_arm"})]),
        ("gripper:r:close:0", "ready", [("gripper", {"action": "unlock", "arm": "right_arm"})]),
        ("gripper:r:0.5", "running", [("move", {"joints": [1.0, 2.0, 3.0, 0.5]})]),
        ("step_infer", "running", [("step", {})]),
        ("step_commit", "running", [("commit", {})]),
        ("step_cancel", "running", [("cancel", {})]),
        ("collect_start", "ready", [("record_start", {})]),
        ("collect_stop", "ready", [("record_stop", {})]),
        ("operator_action:rollout_toggle:node", "ready", [("run", {"mode": "preview"})]),
        ("operator_action:rollout_toggle:node", "running", [("stop", {})]),
        ("operator_action:rollout_reset", "ready", [("home", {})]),
        ("operator_action:rollout_reset", "holding", [("stop", {}), ("home", {})]),
        ("operator_action:start:node", "ready", [("run", {"mode": "preview"})]),
        ("operator_action:accept", "running", [("stop", {})]),
        ("operator_action:cancel", "running", [("stop", {})]),
        (
            "operator_action:gripper_left_open:x",
            "ready",
            [("gripper", {"action": "open", "arm": "left_arm"})],
        ),
        ("switch_task:pour", "ready", [("tune", {"task": "pour"})]),
        ("select_strategy:sync", "ready", [("tune", {"strategy": {"kind": "sync"}})]),
        ('update_infer_params:{"k_max": 5}', "ready", [("tune", {"strategy": {"k_max": 5}})]),
        ("select_mode:real", "ready", []),
        ("connect", "ready", []),
        ("bootstrap", "idle", []),
        ("warmup", "ready", []),
        ("init_done", "running", []),
        ("rollout_intervention_enabled:0", "ready", []),
        ("tab_switch:debug", "ready", []),
    ],
)
def test_a_verb_comes_to_these_commands_of_ours(verb, state, given):
    assert steps(verb, state, ScriptSelection(**CHOSEN)) == given


def test_what_was_selected_for_collecting_is_tuned_first():
    assert steps("collect_start", selection=ScriptSelection(collect_task="wipe")) == [
        ("tune", {"task": "wipe"}),
        ("record_start", {}),
    ]


@pytest.mark.parametrize(
    ("verb", "chosen"),
    [
        ("select_mode:real", {"mode": "continuous"}),
        ("select_mode:step", {"mode": "preview"}),
        ("select_task:pour the tea", {"task": "pour the tea"}),
        ("select_collect_task: wipe ", {"collect_task": "wipe"}),
        ("manual_qpos:0, 1,2,3", {"target": [0.0, 1.0, 2.0, 3.0]}),
        ("manual_home", {"target": FACTS["home"]}),
        ("console_reset", {}),
    ],
)
def test_what_is_selected_is_remembered(verb, chosen):
    assert dict(commands_for_verb(scene(verb)).chosen) == chosen


def test_a_task_in_the_message_goes_before_one_behind_the_colon():
    assert dict(commands_for_verb(scene("select_task:a", task="b")).chosen) == {"task": "b"}


def test_strategies_add_up():
    selection = ScriptSelection(task="pour")
    selection.choose(strategy={"kind": "sync"})
    selection.choose(strategy={"k_max": 4})
    assert selection == ScriptSelection(task="pour", strategy={"kind": "sync", "k_max": 4})


@pytest.mark.parametrize(
    ("verb", "armed", "told"),
    [
        ("tab_switch:collect", True, {"tab": "collect", "armed": True}),
        ("tab_switch:collect", False, {"tab": "collect", "armed": False}),
        ("tab_switch:debug", True, {"tab": "debug", "armed": False}),
    ],
)
def test_armed_counts_for_the_tab_collect_alone(verb, armed, told):
    assert commands_for_verb(scene(verb, armed=armed)).told == told


@pytest.mark.parametrize(
    ("verb", "state", "why"),
    [
        ("disconnect", "ready", '{"command": "give_up"} ends the lease'),
        ("switch_ckpt:2", "ready", '{"command": "setup"'),
        ("load_replay_dataset:{}", "ready", '"kind": "replay"'),
        ("replay_seek:4", "ready", '"kind": "replay"'),
        ("rl_setup", "ready", "no reinforcement learning here"),
        ("collect_cancel", "ready", "web:collect_stop"),
        ("manual_dispatch:real", "ready", "web:manual_qpos"),
        ("rollout_intervention_enabled:1", "ready", "takeover is not available"),
        ("rollout_intervention_abandon", "running", "takeover is not available"),
        ("operator_action:intervention_toggle:x", "running", "takeover is not available"),
        ("connect", "disconnected", "is not connected: set up"),
        ("warmup", "idle", "web:warmup: the station is idle, and this is a part of web:setup"),
        ("rollout_save", "running", "web:rollout_stop closes it"),
        ("rollout_save", "ready", "nothing was recorded"),
        ("manual_send", "running", "web:manual_qpos first"),
        ("operator_action:rollout_toggle", "holding", "the station is holding: say web:run"),
        ("console_reset:now", "ready", "web:console_reset: takes no argument; given 'now'"),
        ("start:now", "ready", "web:start: takes no argument; given 'now'"),
        ("select_task", "ready", "needs 'task' in the message, or an argument"),
        ("select_task:  ", "ready", "needs 'task' in the message, or an argument"),
        ("switch_task", "ready", "needs 'task' in the message"),
        ("select_mode:fast", "ready", "'fast' is none of real, sim, step, preview, manual"),
        ("select_strategy:magic", "ready", "'magic' is none of async, sync"),
        ("update_infer_params:[1]", "ready", "its argument is a JSON object; given [1]"),
        ("update_infer_params:{", "ready", "its argument is not JSON"),
        ("init_move:{}", "ready", 'its argument is {"qpos": [..]}; given the keys []'),
        (
            'init_move:{"qpos": [1, 2]}',
            "ready",
            "needs 4 finite numbers (a, grip_l, b, grip_r); given [1, 2]",
        ),
        ('init_move:{"qpos": [1, 2, true, 4]}', "ready", "needs 4 finite numbers"),
        ('init_move:{"qpos": [1, 2, 1e999, 4]}', "ready", "needs 4 finite numbers"),
        ('init_move:{"qpos": "1234"}', "ready", "needs 4 finite numbers"),
        ("manual_qpos:1,2,3", "running", "needs 4 finite numbers"),
        ("manual_qpos:1,2,3,nan", "running", "'nan' is no finite number"),
        ("manual_qpos:1,2,3,x", "running", "'x' is no finite number"),
        ("init_gripper:wave:left", "ready", "'wave' is none of open, close"),
        ("gripper:l", "ready", "allowed: SIDE:open:1"),
        ("gripper:l:open", "ready", "allowed: SIDE:open:1"),
        ("gripper:l:open:2", "ready", "allowed: SIDE:open:1"),
        ("gripper:l:inf", "running", "'inf' is no finite number"),
        ("gripper:x:open:1", "ready", "'x' is no gripper of this robot; allowed: left_arm, right_arm"),
        ("gripper::open:1", "ready", "'' is no gripper of this robot"),
        ("operator_action:dance:x", "ready", "'dance' is none of rollout_toggle"),
    ],
)
def test_what_means_nothing_here_is_refused_with_what_does(verb, state, why):
    if verb == "connect":
        with pytest.raises(UnsupportedVerb, match=why):
            commands_for_verb(scene(verb, state))
        return
    assert why in refusal(verb, state)


def test_armed_is_true_or_false():
    assert "armed = 1: must be true or false" in refusal("tab_switch:collect", armed=1)


def test_a_robot_of_one_arm_has_it_on_both_sides():
    facts = FACTS | {"arms": ["arm"], "gripper_dims": [1]}
    one = {"arm": {"locked": False, "at": 0.0}}
    for side in ("l", "right", "arm"):
        assert steps(f"gripper:{side}:open:1", facts=facts, grippers=one)[0][1]["arm"] == "arm"


def test_what_was_recorded_is_told_when_it_is_to_be_saved():
    made = commands_for_verb(scene("rollout_save", episode={"path": "/data/one", "uuid": "u"}))
    assert made.told == {"episode": {"path": "/data/one", "uuid": "u"}}


@pytest.mark.parametrize(
    ("verb", "argument", "told"),
    [
        ("stop", None, True),
        ("halt", "x", True),
        ("rollout_stop", None, True),
        ("operator_action", "cancel:node", True),
        ("operator_action", "accept", True),
        ("operator_action", "start:cancel", False),
        ("operator_action", None, False),
        ("step_cancel", None, False),
        ("run", None, False),
    ],
)
def test_stops_are_told_from_the_rest_before_anything_waits(verb, argument, told):
    assert stops(verb, argument) is told


def test_the_document_says_of_every_verb_what_it_comes_to():
    document = (ROOT / "docs/control-channel.md").read_text("utf-8").splitlines()
    rows = [f"| `web:{verb}` | {what.description} |" for verb, what in VERBS.items()]
    assert [line for line in document if line.startswith("| `web:")] == rows


def test_where_a_person_is_to_drive_collecting_is_a_run():
    def steps(verb, episode=None, **selected):
        made = scene(verb, "running" if episode else "ready", ScriptSelection(**selected))
        made.status["collect"] = {"set_up": True, "armed": True, "episode": episode}
        return [(kind, dict(arguments)) for kind, arguments in commands_for_verb(made).steps]

    assert steps("collect_start", collect_task="wipe") == [("run", {"mode": "collect", "task": "wipe"})]
    assert steps("collect_start") == [("run", {"mode": "collect"})]
    assert steps("collect_stop", "e") == [("stop", {})]
    assert steps("collect_cancel", "e") == [("discard", {})]
    with pytest.raises(UnsupportedVerb, match="web:collect_stop"):
        steps("collect_cancel")
