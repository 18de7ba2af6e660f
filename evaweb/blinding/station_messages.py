"""Redaction of a station's messages for users from whom a checkpoint is hidden: only what they need to act remains.

A message is shown if this module lists its id and each of its arguments may be shown: a name or number that belongs to
the robot, the cameras or people, or a nested message that may itself be shown. A refusal by safety is reduced to the
limit, without the policy's values. Every other message is hidden, and so is any message that contains foreign text,
because a fault may name a server.
"""

from __future__ import annotations

from runtime.core.sentences import Pattern, Sentence, fixed, plain

# Messages of robot, cameras, leader and node, shown with any text: none depends on the policy.
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
# Messages shown except those of _NOT, if their text arguments are names and not the text of a foreign error.
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
"""Arguments with names from this program; any other text is foreign, unless it is a Sentence."""

_BY_A_PERSON = "health.pressed_by"  # user who pressed the e-stop, and the typed reason

# Replacements for refusals by safety: they name the limit, because the numbers are the policy's.
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
    """Return the message as it may be shown; None if it must be hidden entirely."""
    if not isinstance(text, Sentence):
        return None
    if text.id in _LIMITS:
        return _LIMITS[text.id]
    if text.id in _IN_A_ROW:
        reason = text.arguments.get("why")
        plain_reason = uncovered(reason) if isinstance(reason, str) else None
        return _SAFE if plain_reason is None else _REFUSED(why=plain_reason)
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
    """Return the message, or None if a message within it may not be shown unchanged."""
    parts = [of for of in text.arguments.values() if isinstance(of, Sentence)]
    return text if all(uncovered(of) == of for of in parts) else None


def _with_parts(text: Sentence) -> str | None:
    """Return the message with the messages nested in it redacted.

    The result is None if a nested message must be hidden entirely, or if an argument of the message is a text of
    unknown origin.
    """
    message, whole = plain(text), True
    for name, of in text.arguments.items():
        if isinstance(of, Sentence):
            visible = uncovered(of)
            if visible is None or plain(of) not in message:
                return None
            if visible != of:
                message, whole = message.replace(plain(of), plain(visible)), False
        elif isinstance(of, str) and of and name not in _NAMES and text.id != _BY_A_PERSON:
            return None
    return text if whole else message
