"""What of trials and scores the database keeps as it is."""

from __future__ import annotations

from evaweb.append_only import Guard

_SCORED = "OLD.status = 'scored'"

GUARDS = (
    Guard(
        "trials_score",
        (
            "uuid",
            "trial_id",
            "rater_id",
            "success",
            "score",
            "note",
            "failure",
            "reason",
            "source",
            "scored_at",
        ),
        "a score is never changed or removed: a correction is another score",
    ),
    Guard(
        "trials_milestoneoutcome",
        ("score_id", "order", "text", "points", "required", "reached", "at_s"),
        "what was scored is never changed or removed: a correction is another score",
    ),
    Guard(
        "trials_trial",
        (
            "uuid",
            "evaluation_id",
            "evaluation_version",
            "checkpoint_id",
            "scene_id",
            "position_id",
            "number",
            "attempt",
            "station_id",
            "operator_id",
            "instruction",
            "strategy",
            "seed",
        ),
        "of a scored trial it is never changed what was tried, where and by whom",
        only=_SCORED,
    ),
)
