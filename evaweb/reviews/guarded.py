"""What of reviews the database keeps as it is."""

from __future__ import annotations

from evaweb.append_only import Guard

GUARDS = (
    Guard(
        "reviews_review",
        ("uuid", "episode_id", "verdict", "note", "reviewer_id", "at"),
        "a verdict is never changed or removed: say another one",
    ),
)
