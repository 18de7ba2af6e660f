"""Status in the older channel's form, from a station's snapshot.

A key of the older channel without a counterpart is null, false or empty.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from runtime.clients.channel.scripts import ScriptSelection

_CLI_MODES = {"continuous": "real", "preview": "step"}
_REPLAY = (
    *("dataset_dir", "episode_id", "n_episodes", "task", "frame_index", "total_frames"),
    *("action_key", "action_mode", "fps", "exec_steps"),
)
_ABSENT: dict[str, Any] = {
    "image_min_hz": None,
    "follow_human_gripper": False,
    "manual_dispatch": None,
    "collection_replay": {
        "active": False,
        "playing": False,
        "episode_index": None,
        "frame_index": 0,
        "total_frames": 0,
    },
    "rollout_intervention_active": False,
    "rollout_intervention_enabled": False,
    "rollout_intervention_active_frames": 0,
    "rollout_intervention_segments": 0,
    "hil_supported": False,
    "hil_active": False,
    "hil_error": None,
    "ckpt_slot": None,
    "clip_id": None,
    "cell": None,
    "rl": {},
    "replay_loaded": False,
    **{f"replay_{name}": None for name in _REPLAY},
}


def status(snapshot: Mapping[str, Any], selection: ScriptSelection, newest: str) -> dict[str, Any]:
    """Return the station's status with every key of the older channel.

    It also has `state`, `reason`, `allowed`, `lease` and `estop` of EVA Web. `newest` is the reason of the newest
    command that was refused or failed.
    """
    return _ABSENT | _robot(snapshot) | _session(snapshot, selection, newest) | _run(snapshot, selection)


def _robot(snapshot: Mapping[str, Any]) -> dict[str, Any]:
    rates = snapshot["link"]["rates"]
    pictures = [rate for name, rate in rates.items() if name not in ("joints", "eef")]
    return {
        "robot_type": snapshot["robot"],
        "transport_type": snapshot["transport"],
        "transport_connected": snapshot["state_is"]["connected"],
        "image_min_hz": min(pictures, default=None),
        "gripper_locks": {arm: gripper["locked"] for arm, gripper in snapshot["grippers"].items()},
    }


def _session(snapshot: Mapping[str, Any], selection: ScriptSelection, newest: str) -> dict[str, Any]:
    state, state_is, policy = snapshot["state"], snapshot["state_is"], snapshot["policy"]
    started = state_is["set_up"]
    rests = state_is["idle"] or state_is["ready"]
    return {
        "policy_connected": started and not policy["lost"],
        "policy_error": snapshot["reason"] if policy["lost"] else None,
        # Scripts wait for "idle" to detect the end of any activity.
        "session_status": "idle" if rests else state,
        "selected_task": selection.task if selection.task is not None else snapshot["task"],
        "selected_collect_task": selection.collect_task,
        "selected_strategy": snapshot["strategy"],
        "is_setup_done": started,
        "init_loaded": started,
        "init_ready": started,
        "setup_stage": snapshot["stage"],
        "ckpt_label": snapshot["checkpoint"].get("name"),
        "last_error": newest or (snapshot["reason"] if state_is["held"] or state_is["latched"] else None),
        "state": state,
        "reason": snapshot["reason"],
        "allowed": snapshot["allowed"],
        "lease": snapshot["lease"],
        "estop": snapshot["estop"],
    }


def _run(snapshot: Mapping[str, Any], selection: ScriptSelection) -> dict[str, Any]:
    policy, run, control = snapshot["policy"], snapshot["run"], snapshot["control"]
    episode, recording = snapshot["episode"], snapshot["recording"]
    collect = snapshot.get("collect") or {"armed": False, "episode": None}
    alone = bool(recording["uuid"]) and (not run["number"] or collect["episode"] is not None)
    mode = snapshot["mode"] if run["number"] else selection.mode or snapshot["mode"]
    return {
        "cli_mode": _CLI_MODES.get(mode, mode),
        "web_phase": snapshot["phase"],
        "step_index": control["step"],
        "chunk_index": policy["answers"],
        "last_infer_ms": policy["latency_p50_ms"],
        "run_elapsed_ms": run["elapsed"] * 1000,
        "manual_publish_active": run["number"] > 0 and snapshot["mode"] == "manual",
        "manual_qpos": selection.target,
        "pending_chunk": snapshot["proposal"] or None,
        "current_episode": recording["uuid"] or episode.get("uuid"),
        "rollout": {**run, "last": snapshot["last_run"]},
        "collection_teleop_armed": collect["armed"],
        "collection_teleop_active": collect["episode"] is not None,
        "collect": {"uuid": recording["uuid"], "rows": recording["rows"]} if alone else None,
    }
