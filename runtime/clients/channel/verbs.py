"""Verbs of the older channel, each with the commands of EVA Web that it stands for."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from runtime.clients.channel.verb_commands import CommandSequence, Step, VerbContext

STOPS = ("stop", "halt", "rollout_stop")  # verbs that overtake waiting messages
_STOPPING_INTENTS = ("accept", "cancel")  # intents of operator_action that stop
_MODES = {"real": "continuous", "sim": "sim", "step": "preview", "preview": "preview", "manual": "manual"}
_TABS = "there are no tabs here: nothing is done"


@dataclass(frozen=True, slots=True)
class Verb:
    """Verb of the older channel: `build` returns its commands, `description` explains them to people."""

    build: Callable[[VerbContext], CommandSequence]
    description: str


def stops(verb: str, argument: str | None) -> bool:
    """Return True if a verb ends a motion, so that it overtakes waiting messages."""
    intent = (argument or "").partition(":")[0]
    return verb in STOPS or (verb == "operator_action" and intent in _STOPPING_INTENTS)


def commands_for_verb(scene: VerbContext) -> CommandSequence:
    """Return the commands for a known verb.

    Raises: UnsupportedVerb with the reason and an alternative.
    """
    return VERBS[scene.message.name].build(scene)


def _plain(kind: str) -> Callable[[VerbContext], CommandSequence]:
    """Return the builder of a verb that stands for one command without arguments."""

    def does(scene: VerbContext) -> CommandSequence:
        scene.no_argument()
        return CommandSequence(((kind, {}),))

    return does


def _stopping(kind: str) -> Callable[[VerbContext], CommandSequence]:
    """Return the builder of a stop, which ignores a superfluous argument instead of refusing."""
    return lambda scene: CommandSequence(((kind, {}),))


def _unsupported(reason: str) -> Verb:
    def does(scene: VerbContext) -> CommandSequence:
        scene.refuse(reason)

    return Verb(does, f"refused: {reason}")


# --- set-up and runs -----------------------------------------------------------------------------------------


def _setup(scene: VerbContext) -> CommandSequence:
    scene.no_argument()
    return CommandSequence((("setup", scene.selection.setup),))


def _connected(scene: VerbContext) -> CommandSequence:
    scene.no_argument()
    if not scene.state_is["connected"]:
        scene.refuse(f"the station connects by itself, and is not connected: {scene.status['reason']}")
    return CommandSequence(note="the station connects by itself, and is connected")


def _set_up(scene: VerbContext) -> CommandSequence:
    scene.no_argument()
    if not scene.state_is["set_up"]:
        scene.refuse(f"the station is {scene.state}, and this is a part of web:setup: give that, and wait")
    return CommandSequence(note="the set-up has done it")


def _run(scene: VerbContext) -> CommandSequence:
    scene.no_argument()
    return CommandSequence((("run", scene.selection.run),))


def _go_on(scene: VerbContext) -> CommandSequence:
    return _plain("resume")(scene) if scene.state_is["held"] else _run(scene)


def _saved(scene: VerbContext) -> CommandSequence:
    scene.no_argument()
    if scene.state_is["run_open"]:
        scene.refuse("a run is open, and is recorded as it goes on: web:rollout_stop closes it")
    episode = scene.status["episode"]
    if not episode.get("path"):
        scene.refuse("nothing was recorded since the station started")
    return CommandSequence(told={"episode": episode}, note="it was saved as it went on, when it was stopped")


def _reset(scene: VerbContext) -> CommandSequence:
    """Return the commands that end a halted run, if there is one, and move home; a run in progress is not ended."""
    end: tuple[Step, ...] = (("stop", {}),) if scene.state_is["held"] else ()
    return CommandSequence((*end, ("home", {})))


def _bare_reset(scene: VerbContext) -> CommandSequence:
    scene.no_argument()
    return _reset(scene)


def _tab(scene: VerbContext) -> CommandSequence:
    armed = scene.message.fields.get("armed", False)
    if not isinstance(armed, bool):
        scene.refuse(f"armed = {armed!r:.80}: must be true or false")
    tab = scene.text_argument()
    return CommandSequence(told={"tab": tab, "armed": armed and tab == "collect"}, note=_TABS)


# --- selections ---------------------------------------------------------------------------------------------


def _task(scene: VerbContext) -> CommandSequence:
    task = scene.text_argument("task")
    note = "in force now, and for the set-ups of this script"
    return CommandSequence((("tune", {"task": task}),), chosen={"task": task}, note=note)


def _collect_task(scene: VerbContext) -> CommandSequence:
    task = scene.text_argument("task")
    return CommandSequence(chosen={"collect_task": task}, told={"selected_collect_task": task})


def _mode(scene: VerbContext) -> CommandSequence:
    mode = _MODES[scene.choice_argument(*_MODES)]
    return CommandSequence(chosen={"mode": mode}, note=f"the next run's mode is {mode}")


def _strategy(scene: VerbContext) -> CommandSequence:
    strategy = {"kind": scene.choice_argument(*scene.status["facts"]["strategies"])}
    return CommandSequence((("tune", {"strategy": strategy}),), chosen={"strategy": strategy})


def _parameters(scene: VerbContext) -> CommandSequence:
    parameters = scene.table()
    return CommandSequence((("tune", {"strategy": parameters}),), chosen={"strategy": parameters})


# --- manual control -----------------------------------------------------------------------------------------


def _target(scene: VerbContext) -> CommandSequence:
    numbers = [scene.number(part) for part in scene.text_argument().split(",")]
    target = scene.joints(numbers)
    return CommandSequence(chosen={"target": target}, note="web:manual_send goes there")


def _send(scene: VerbContext) -> CommandSequence:
    scene.no_argument()
    if scene.selection.target is None:
        scene.refuse("this script has given no target: web:manual_qpos first")
    return CommandSequence((("move", {"joints": scene.selection.target}),))


def _home(scene: VerbContext) -> CommandSequence:
    scene.no_argument()
    home = list(scene.status["facts"]["home"])
    return CommandSequence(chosen={"target": home}, note="nothing has moved: web:manual_send goes home")


def _init_move(scene: VerbContext) -> CommandSequence:
    table = scene.table()
    if set(table) != {"qpos"}:
        scene.refuse(f'its argument is {{"qpos": [..]}}; given the keys {sorted(table)!r:.80}')
    return CommandSequence((("move", {"joints": scene.joints(table["qpos"])}),))


def _init_gripper(scene: VerbContext) -> CommandSequence:
    action, _, side = scene.text_argument().partition(":")
    if action not in ("open", "close"):
        scene.refuse(f"{action!r:.80} is none of open, close")
    return CommandSequence((("gripper", {"action": action, "arm": scene.arm(side)}),))


def _gripper(scene: VerbContext) -> CommandSequence:
    side, *parts = scene.text_argument().split(":")
    arm = scene.arm(side)
    if len(parts) == 1 and parts[0] not in ("open", "close"):
        return _gripper_at(scene, arm, scene.number(parts[0]))
    if len(parts) != 2 or parts[0] not in ("open", "close") or parts[1] not in ("0", "1"):
        scene.refuse("allowed: SIDE:open:1, SIDE:close:1, SIDE:open:0, SIDE:close:0, SIDE:NUMBER")
    return CommandSequence((("gripper", {"action": parts[0] if parts[1] == "1" else "unlock", "arm": arm}),))


def _gripper_at(scene: VerbContext, arm: str, value: float) -> CommandSequence:
    """Return the command that moves the arm's gripper to `value` in its own unit; other joints stay as commanded."""
    facts, joints = scene.status["facts"], scene.commanded()
    dims = dict(zip(scene.status["grippers"], facts["gripper_dims"], strict=True))
    joints[dims[arm]] = value
    return CommandSequence((("move", {"joints": joints}),))


def _action(scene: VerbContext) -> CommandSequence:
    intent, _, _ = scene.text_argument().partition(":")
    if intent not in _INTENTS:
        scene.refuse(f"{intent!r:.80} is none of {', '.join(_INTENTS)}")
    return _INTENTS[intent](scene)


def _toggle(scene: VerbContext) -> CommandSequence:
    if scene.state_is["going"]:
        return CommandSequence((("stop", {}),))
    if not scene.state_is["ready"]:
        scene.refuse(f"the station is {scene.state}: say web:run, web:stop or web:setup, whichever is meant")
    return CommandSequence((("run", scene.selection.run),))


def _grip(action: str, side: str) -> Callable[[VerbContext], CommandSequence]:
    return lambda scene: CommandSequence((("gripper", {"action": action, "arm": scene.arm(side)}),))


def _untaken(scene: VerbContext) -> CommandSequence:
    scene.refuse("takeover is not available here; allowed: web:halt, or a run in the mode manual")


_INTENTS: dict[str, Callable[[VerbContext], CommandSequence]] = {
    "rollout_toggle": _toggle,
    "rollout_reset": _reset,
    "start": lambda scene: CommandSequence((("run", scene.selection.run),)),
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


def _intervention(scene: VerbContext) -> CommandSequence:
    return (
        CommandSequence(note="it is never enabled")
        if scene.choice_argument("0", "1") == "0"
        else _untaken(scene)
    )


# --- recording -----------------------------------------------------------------------------------------------


def _demonstrates(scene: VerbContext) -> bool:
    """Return True if the station is set up for demonstrations by the operator."""
    collect = scene.status.get("collect")
    return collect is not None and collect["set_up"]


def _collect(scene: VerbContext) -> CommandSequence:
    scene.no_argument()
    task = scene.selection.collect_task
    if _demonstrates(scene):
        return CommandSequence((("run", {"mode": "collect"} | ({} if task is None else {"task": task})),))
    before = () if task is None else (("tune", {"task": task}),)
    return CommandSequence((*before, ("record_start", {})))


def _collect_stop(scene: VerbContext) -> CommandSequence:
    scene.no_argument()
    return CommandSequence((("stop" if _demonstrates(scene) else "record_stop", {}),))


def _collect_cancel(scene: VerbContext) -> CommandSequence:
    scene.no_argument()
    if not _demonstrates(scene) or scene.status["collect"]["episode"] is None:
        scene.refuse(_KEPT)
    return CommandSequence((("discard", {}),))


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
    "disconnect": _unsupported(_STAYS),
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
    "manual_dispatch": _unsupported(_EXACTLY),
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
    "switch_ckpt": _unsupported(_CHECKPOINT),
    "select_episode": _unsupported(_REPLAY),
    "load_replay_dataset": _unsupported(_REPLAY),
    "clear_replay": _unsupported(_REPLAY),
    "set_replay_fps": _unsupported(_REPLAY),
    "replay_seek": _unsupported(_REPLAY),
    "rollout_intervention_enabled": Verb(
        _intervention, "0 does nothing; 1 is refused: takeover is not available"
    ),
    "rollout_intervention_abandon": Verb(_untaken, "refused: takeover is not available"),
    "rl_select_task": _unsupported(_LEARNING),
    "rl_select_policy": _unsupported(_LEARNING),
    "rl_select_critic": _unsupported(_LEARNING),
    "rl_setup": _unsupported(_LEARNING),
}
