"""What of second ratings and preferences the database keeps as it is."""

from __future__ import annotations

from evaweb.append_only import Guard

GUARDS = (
    Guard(
        "results_rating",
        ("uuid", "trial_id", "rater_id", "success", "score", "milestones", "failure", "note", "blind", "at"),
        "what a second rater said is never changed or removed",
    ),
    Guard(
        "results_preference",
        ("uuid", "plan_id", "first_id", "second_id", "rater_id", "outcome", "why", "blind", "at"),
        "what somebody preferred is never changed or removed",
    ),
)
