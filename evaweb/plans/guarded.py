"""What of plans the database keeps as it is."""

from __future__ import annotations

from evaweb.append_only import Guard

GUARDS = (
    Guard(
        "plans_plan",
        (
            "name",
            "version",
            "title",
            "question",
            "repetitions",
            "blind",
            "stopping",
            "alpha",
            "second_rater_share",
            "match_gate",
            "first_id",
            "second_id",
            "evaluation_id",
            "document",
            "digest",
            "commitment",
            "key",
            "frozen_at",
        ),
        "a frozen plan is never changed: amend it",
        only="OLD.state <> 'draft'",
    ),
    Guard(
        "plans_handout",
        ("plan_id", "number", "slot_id", "trial_id", "code", "reason", "handed_at"),
        "what was handed out is never changed or removed",
    ),
    Guard(
        "plans_reference",
        ("station_id", "camera", "position_id", "picture", "by_id", "at"),
        "a reference is never changed: take another one",
    ),
    Guard(
        "plans_achieved",
        ("trial_id", "camera", "picture", "reference_id", "match", "override", "by_id", "at"),
        "what a trial began with is never changed or removed",
    ),
    Guard(
        "plans_cameracheck",
        ("station_id", "boot", "seen", "by_id", "at"),
        "who confirmed the cameras is never changed or removed",
    ),
    Guard("plans_look", ("plan_id", "user_id", "at"), "who looked is never changed or removed"),
    Guard(
        "plans_planevent",
        ("plan_id", "at", "by_id", "what", "text"),
        "what was done with a plan is never changed or removed",
    ),
)
