"""Reasons of a station as they are said to somebody from whom a checkpoint is hidden: what they need to act, no more.

A sentence is shown whose id is listed here, with all that it is made of: names and numbers of the robot, of cameras and
of people, and sentences that are shown themselves. What safety refused is said by the limit, without what the policy
wanted. Everything else is covered, also words of somebody else within a sentence: a fault may name a server.
"""

from __future__ import annotations

from runtime.core.sentences import Pattern, Sentence, fixed, plain

# What robot, cameras, leader and node say, in whatever words: no policy has a part in it.
_OF_THE_ROBOT = (
    *(
        "bench",
        "cameras",
        "drives",
        "grippers",
        "leader",
        "node",
        "observation",
        "reception",
        "recording",
        "ros",
    ),
    *("shared", "state", "timing"),
)
# Of these all but what follows, as far as their words are names, and not a fault that somebody else put in words.
_OF_THE_STATION = (
    "bus",
    "collect",
    "guard",
    "health",
    "lease",
    "manual",
    "motion",
    "runs",
    "session",
    "targets",
)
_NOT = frozenset(
    {
        *("bench.no_truth", "health.time_over"),
        *("session.policy_asked", "session.policy_wanted", "session.first_action_unknown"),
        *("session.approaching", "session.approaching_first"),
        *("session.chunk_executing", "session.chunk_shown", "session.no_chunk_shown"),
    }
)
_ALSO = frozenset(
    {
        *("setup.drives_disabled", "setup.drives_robot", "setup.no_drives", "setup.no_fault_named"),
        *("setup.no_observation", "setup.silent", "setup.zero_joints"),
        *(
            "operations.family_starting",
            "operations.trial_with_locked_gripper",
            "operations.trial_without_recording",
        ),
        *(
            "operations.trial_mode",
            "operations.trial_after_tuning",
            "operations.recording_open_of_other_manifest",
        ),
        *("control.back_elsewhere", "control.back_late", "control.contradiction", "control.disagree"),
        *("control.encoder_dead", "control.estop", "control.exchanged", "control.held_elsewhere"),
        *("control.joints_back", "control.joints_missing", "control.left_alone", "control.no_fresh_joints"),
        *(
            "control.not_believed",
            "control.not_seen_long_enough",
            "control.pressed_within_tick",
            "control.released",
        ),
        *("control.robot_unseen", "control.sibling_silent", "control.stepped", "control.stuck"),
        *("control.supervisor_gone", "control.too_fast", "control.unmoved", "control.zero_after"),
        *(
            "media.coordinator_silent",
            "media.pictures_stopped",
            "media.pictures_stopped_for",
            "media.still_writing",
        ),
        "media.supervisor_ended",
    }
)
_NAMES = frozenset(
    {
        *(
            "allowed",
            "arm",
            "arms",
            "before",
            "after",
            "camera",
            "cameras",
            "command",
            "episode",
            "given",
            "goal",
        ),
        *("holder", "joint", "joints", "kind", "mode", "name", "names", "place", "process", "robot", "state"),
        *("stream", "who", "word"),
    }
)
"""Arguments that are words of ours; any other one is somebody's, unless it is a sentence."""

_BY_A_PERSON = "health.pressed_by"  # who pressed an e-stop, and why in their words

# What safety said, by the limit that it is about: the numbers are the policy's.
_LIMITS = {
    "safety.jumps": fixed("blinding.jumps", "an action would have jumped farther than allowed (safety.jump)"),
    "safety.away_from_measured": fixed(
        "blinding.away_from_measured", "an action would have been too far from where the robot is measured"
    ),
    "safety.leaves_workspace": fixed("blinding.leaves_workspace", "an action would have left the workspace"),
    "safety.would_be_near": fixed(
        "blinding.would_be_near", "an action would have brought parts too near each other"
    ),
    "safety.would_collide": fixed("blinding.would_collide", "an action would have made parts collide"),
    "safety.outside": fixed("blinding.outside", "an action was outside the joints' limits"),
    "safety.joints_old": fixed("blinding.joints_old", "joints were too old (safety.joint_age_s)"),
    "safety.picture_old": fixed("blinding.picture_old", "a picture was too old (safety.picture_age_s)"),
    "control.too_far": fixed("blinding.too_far", "the first action is too far from where the robot stands"),
}
_REFUSED = Pattern("blinding.refused", "actions were refused, the last one: {why}")
_IN_A_ROW = ("control.refused_in_a_row", "control.refused_of_the_last")
_SAFE = fixed("blinding.by_safety", "safety held the robot")


def uncovered(text: str) -> str | None:
    """The reason as it may be said; None where all of it is covered."""
    if not isinstance(text, Sentence):
        return None
    if text.id in _LIMITS:
        return _LIMITS[text.id]
    if text.id in _IN_A_ROW:
        why = text.arguments.get("why")
        said = uncovered(why) if isinstance(why, str) else None
        return _SAFE if said is None else _REFUSED(why=said)
    kind = text.id.partition(".")[0]
    if kind in _OF_THE_ROBOT:
        return None if text.id in _NOT else _whole(text)
    if (
        text.id in _ALSO
        or text.id.startswith("sentences.")
        or (kind in _OF_THE_STATION and text.id not in _NOT)
    ):
        return _with_parts(text)
    return None


def _whole(text: Sentence) -> str | None:
    """It, unless a sentence within it is none that may be said."""
    parts = [of for of in text.arguments.values() if isinstance(of, Sentence)]
    return text if all(uncovered(of) == of for of in parts) else None


def _with_parts(text: Sentence) -> str | None:
    """It, with those within it as they may be said; None where one is covered, or is somebody else's words."""
    said, whole = plain(text), True
    for name, of in text.arguments.items():
        if isinstance(of, Sentence):
            shown = uncovered(of)
            if shown is None or plain(of) not in said:
                return None
            if shown != of:
                said, whole = said.replace(plain(of), plain(shown)), False
        elif isinstance(of, str) and of and name not in _NAMES and text.id != _BY_A_PERSON:
            return None
    return text if whole else said
