"""The verbs of the older channel, each with what it comes to in commands of ours."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from runtime.clients.channel.verb_commands import Deed, Scene, Step

STOPS = ("stop", "halt", "rollout_stop")  # verbs that overtake whatever waits
_STOPPING_INTENTS = ("accept", "cancel")  # of operator_action
_MODES = {"real": "continuous", "sim": "sim", "step": "preview", "preview": "preview", "manual": "manual"}
_TABS = "there are no tabs here: nothing is done"


@dataclass(frozen=True, slots=True)
class Verb:
    """One verb: `does` makes its deed, `ours` is what it comes to, for people."""

    does: Callable[[Scene], Deed]
    ours: str


def stops(verb: str, argument: str | None) -> bool:
    """True if a verb ends a motion, whatever else waits."""
    intent = (argument or "").partition(":")[0]
    return verb in STOPS or (verb == "operator_action" and intent in _STOPPING_INTENTS)


def deed(scene: Scene) -> Deed:
    """Commands of ours for a known verb; raises NotOurs with the reason and what to give instead."""
    return VERBS[scene.message.name].does(scene)


def _plain(kind: str) -> Callable[[Scene], Deed]:
    """A verb that is a command of ours without arguments."""

    def does(scene: Scene) -> Deed:
        scene.nothing()
        return Deed(((kind, {}),))

    return does


def _stopping(kind: str) -> Callable[[Scene], Deed]:
    """A stop is not refused for a word too many."""
    return lambda scene: Deed(((kind, {}),))


def _never(why: str) -> Verb:
    def does(scene: Scene) -> Deed:
        scene.refuse(why)

    return Verb(does, f"refused: {why}")


# --- set-up and runs -----------------------------------------------------------------------------------------


def _setup(scene: Scene) -> Deed:
    scene.nothing()
    return Deed((("setup", scene.selection.setup),))


def _connected(scene: Scene) -> Deed:
    scene.nothing()
    if not scene.state_is["connected"]:
        scene.refuse(f"the station connects by itself, and is not connected: {scene.status['reason']}")
    return Deed(note="the station connects by itself, and is connected")


def _set_up(scene: Scene) -> Deed:
    scene.nothing()
    if not scene.state_is["set_up"]:
        scene.refuse(f"the station is {scene.state}, and this is a part of web:setup: give that, and wait")
    return Deed(note="the set-up has done it")


def _run(scene: Scene) -> Deed:
    scene.nothing()
    return Deed((("run", scene.selection.run),))


def _go_on(scene: Scene) -> Deed:
    return _plain("resume")(scene) if scene.state_is["held"] else _run(scene)


def _saved(scene: Scene) -> Deed:
    scene.nothing()
    if scene.state_is["run_open"]:
        scene.refuse("a run is open, and is recorded as it goes on: web:rollout_stop closes it")
    episode = scene.status["episode"]
    if not episode.get("path"):
        scene.refuse("nothing was recorded since the station started")
    return Deed(told={"episode": episode}, note="it was saved as it went on, when it was stopped")


def _reset(scene: Scene) -> Deed:
    """After a trial; a run that was halted is over then, one that goes on is not ended by it."""
    end: tuple[Step, ...] = (("stop", {}),) if scene.state_is["held"] else ()
    return Deed((*end, ("home", {})))


def _bare_reset(scene: Scene) -> Deed:
    scene.nothing()
    return _reset(scene)


def _tab(scene: Scene) -> Deed:
    armed = scene.message.fields.get("armed", False)
    if not isinstance(armed, bool):
        scene.refuse(f"armed = {armed!r:.80}: must be true or false")
    tab = scene.text()
    return Deed(told={"tab": tab, "armed": armed and tab == "collect"}, note=_TABS)


# --- what is selected ----------------------------------------------------------------------------------------


def _task(scene: Scene) -> Deed:
    task = scene.text("task")
    note = "in force now, and for the set-ups of this script"
    return Deed((("tune", {"task": task}),), chosen={"task": task}, note=note)


def _collect_task(scene: Scene) -> Deed:
    task = scene.text("task")
    return Deed(chosen={"collect_task": task}, told={"selected_collect_task": task})


def _mode(scene: Scene) -> Deed:
    mode = _MODES[scene.word(*_MODES)]
    return Deed(chosen={"mode": mode}, note=f"the next run's mode is {mode}")


def _strategy(scene: Scene) -> Deed:
    strategy = {"kind": scene.word(*scene.status["facts"]["strategies"])}
    return Deed((("tune", {"strategy": strategy}),), chosen={"strategy": strategy})


def _parameters(scene: Scene) -> Deed:
    parameters = scene.table()
    return Deed((("tune", {"strategy": parameters}),), chosen={"strategy": parameters})


# --- what a person does --------------------------------------------------------------------------------------


def _target(scene: Scene) -> Deed:
    said = [scene.number(part) for part in scene.text().split(",")]
    target = scene.joints(said)
    return Deed(chosen={"target": target}, note="web:manual_send goes there")


def _send(scene: Scene) -> Deed:
    scene.nothing()
    if scene.selection.target is None:
        scene.refuse("this script has given no target: web:manual_qpos first")
    return Deed((("move", {"joints": scene.selection.target}),))


def _home(scene: Scene) -> Deed:
    scene.nothing()
    home = list(scene.status["facts"]["home"])
    return Deed(chosen={"target": home}, note="nothing has moved: web:manual_send goes home")


def _init_move(scene: Scene) -> Deed:
    said = scene.table()
    if set(said) != {"qpos"}:
        scene.refuse(f'its argument is {{"qpos": [..]}}; given the keys {sorted(said)!r:.80}')
    return Deed((("move", {"joints": scene.joints(said["qpos"])}),))


def _init_gripper(scene: Scene) -> Deed:
    action, _, side = scene.text().partition(":")
    if action not in ("open", "close"):
        scene.refuse(f"{action!r:.80} is none of open, close")
    return Deed((("gripper", {"action": action, "arm": scene.arm(side)}),))


def _gripper(scene: Scene) -> Deed:
    side, *rest = scene.text().split(":")
    arm = scene.arm(side)
    if len(rest) == 1 and rest[0] not in ("open", "close"):
        return _gripper_at(scene, arm, scene.number(rest[0]))
    if len(rest) != 2 or rest[0] not in ("open", "close") or rest[1] not in ("0", "1"):
        scene.refuse("allowed: SIDE:open:1, SIDE:close:1, SIDE:open:0, SIDE:close:0, SIDE:NUMBER")
    return Deed((("gripper", {"action": rest[0] if rest[1] == "1" else "unlock", "arm": arm}),))


def _gripper_at(scene: Scene, arm: str, value: float) -> Deed:
    """To a number of its own unit, with the other joints where they are commanded."""
    facts, joints = scene.status["facts"], scene.commanded()
    dims = dict(zip(scene.status["grippers"], facts["gripper_dims"], strict=True))
    joints[dims[arm]] = value
    return Deed((("move", {"joints": joints}),))


def _action(scene: Scene) -> Deed:
    intent, _, _ = scene.text().partition(":")
    if intent not in _INTENTS:
        scene.refuse(f"{intent!r:.80} is none of {', '.join(_INTENTS)}")
    return _INTENTS[intent](scene)


def _toggle(scene: Scene) -> Deed:
    if scene.state_is["going"]:
        return Deed((("stop", {}),))
    if not scene.state_is["ready"]:
        scene.refuse(f"the station is {scene.state}: say web:run, web:stop or web:setup, whichever is meant")
    return Deed((("run", scene.selection.run),))


def _grip(action: str, side: str) -> Callable[[Scene], Deed]:
    return lambda scene: Deed((("gripper", {"action": action, "arm": scene.arm(side)}),))


def _untaken(scene: Scene) -> Deed:
    scene.refuse("nobody takes over from a policy here: web:halt, or a run in the mode manual")


_INTENTS: dict[str, Callable[[Scene], Deed]] = {
    "rollout_toggle": _toggle,
    "rollout_reset": _reset,
    "start": lambda scene: Deed((("run", scene.selection.run),)),
    "accept": _stopping("stop"),
    "cancel": _stopping("stop"),
    "intervention_toggle": _untaken,
    "intervention_accept": _untaken,
    **{
        f"gripper_{side}_{action}": _grip(action, side)
        for side in ("left", "right")
        for action in ("open", "close")
    },
}


def _intervention(scene: Scene) -> Deed:
    return Deed(note="it is never enabled") if scene.word("0", "1") == "0" else _untaken(scene)


# --- recording -----------------------------------------------------------------------------------------------


def _demonstrates(scene: Scene) -> bool:
    """True if the operator is to drive the robot, or does."""
    collect = scene.status.get("collect")
    return collect is not None and collect["set_up"]


def _collect(scene: Scene) -> Deed:
    scene.nothing()
    task = scene.selection.collect_task
    if _demonstrates(scene):
        return Deed((("run", {"mode": "collect"} | ({} if task is None else {"task": task})),))
    before = () if task is None else (("tune", {"task": task}),)
    return Deed((*before, ("record_start", {})))


def _collect_stop(scene: Scene) -> Deed:
    scene.nothing()
    return Deed((("stop" if _demonstrates(scene) else "record_stop", {}),))


def _collect_cancel(scene: Scene) -> Deed:
    scene.nothing()
    if not _demonstrates(scene) or scene.status["collect"]["episode"] is None:
        scene.refuse(_KEPT)
    return Deed((("discard", {}),))


_CHECKPOINT = (
    "a checkpoint has no slot here: "
    '{"command": "setup", "arguments": {"policy": {..}, "checkpoint": {"id": .., "name": ..}}}'
)
_REPLAY = (
    'a recording is played as a policy: {"command": "setup", "arguments": '
    '{"policy": {"kind": "replay", "path": ..}}}, then run'
)
_LEARNING = "there is no reinforcement learning here: setup and run, with the checkpoint as the policy"
_EXACTLY = "its argument is not known here: web:manual_qpos, then web:manual_send, or the command move"
_KEPT = "nothing that was recorded is thrown away: web:collect_stop, then judge the episode in the console"
_STAYS = 'the station stays connected to its robot; {"command": "give_up"} ends the lease of this script'

VERBS: dict[str, Verb] = {
    "bootstrap": Verb(
        _connected, "nothing: the station connects by itself; refused while it is disconnected"
    ),
    "connect": Verb(_connected, "nothing: the station connects by itself; refused while it is disconnected"),
    "disconnect": _never(_STAYS),
    "setup": Verb(_setup, "`setup` with the task and the strategy that were selected"),
    "warmup": Verb(_set_up, "nothing: a part of `setup`; refused before it"),
    "init_done": Verb(_set_up, "nothing: `setup` ends by itself; refused before it"),
    "select_task": Verb(_task, "`tune` with the task, which this script's set-ups then have too"),
    "switch_task": Verb(_task, "the same"),
    "select_mode": Verb(_mode, "the mode of the next run: real is `continuous`, step is `preview`"),
    "select_strategy": Verb(_strategy, "`tune` with the kind, which this script's set-ups then have too"),
    "update_infer_params": Verb(_parameters, "`tune` with the parameters, by our names of them"),
    "start": Verb(_run, "`run` in the mode that was selected"),
    "run": Verb(_go_on, "`run` in the mode that was selected; while holding `resume`"),
    "stop": Verb(_stopping("stop"), "`stop`"),
    "halt": Verb(_stopping("halt"), "`halt`"),
    "estop": Verb(_stopping("estop"), "`estop`; new here"),
    "rollout_stop": Verb(_stopping("stop"), "`stop`"),
    "rollout_save": Verb(_saved, "nothing: a run is recorded as it goes on; refused while one is open"),
    "reset": Verb(_bare_reset, "`home`; while holding `stop` first, which ends the run; refused in a run"),
    "console_reset": Verb(_bare_reset, "the same; what was selected stays"),
    "step_infer": Verb(_plain("step"), "`step`"),
    "step_commit": Verb(_plain("commit"), "`commit`"),
    "step_cancel": Verb(_plain("cancel"), "`cancel`"),
    "init_move": Verb(_init_move, "`move` to the joints; in a run in the mode manual"),
    "init_gripper": Verb(_init_gripper, "`gripper` of the side"),
    "manual_qpos": Verb(_target, "a target for web:manual_send"),
    "manual_send": Verb(_send, "`move` to that target; in a run in the mode manual"),
    "manual_home": Verb(_home, "the home pose as the target for web:manual_send; moves nothing"),
    "manual_dispatch": _never(_EXACTLY),
    "gripper": Verb(
        _gripper, "`gripper`: 1 opens or closes, 0 is `unlock`; a number is a `move` of it alone"
    ),
    "operator_action": Verb(_action, "start `run`; accept, cancel `stop`; rollout_toggle either; grippers"),
    "collect_start": Verb(
        _collect,
        "`run` with that task where the station is set up to collect, and armed; else `record_start`, after `tune`",
    ),
    "collect_stop": Verb(_collect_stop, "`stop` of a demonstration, else `record_stop`"),
    "collect_cancel": Verb(_collect_cancel, "`discard` of a demonstration that is open; else refused"),
    "select_collect_task": Verb(_collect_task, "the task of the next web:collect_start"),
    "tab_switch": Verb(_tab, f"nothing: {_TABS}"),
    "switch_ckpt": _never(_CHECKPOINT),
    "select_episode": _never(_REPLAY),
    "load_replay_dataset": _never(_REPLAY),
    "clear_replay": _never(_REPLAY),
    "set_replay_fps": _never(_REPLAY),
    "replay_seek": _never(_REPLAY),
    "rollout_intervention_enabled": Verb(_intervention, "nothing for 0; 1 is refused: nobody takes over"),
    "rollout_intervention_abandon": Verb(_untaken, "refused: nobody takes over from a policy"),
    "rl_select_task": _never(_LEARNING),
    "rl_select_policy": _never(_LEARNING),
    "rl_select_critic": _never(_LEARNING),
    "rl_setup": _never(_LEARNING),
}
