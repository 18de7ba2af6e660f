"""What of sessions the database keeps as it is."""

from __future__ import annotations

from evaweb.append_only import Guard

GUARDS = (
    Guard(
        "collect_collectsession",
        ("uuid", "station_id", "dataset", "task", "setup", "operator_id", "opened_at"),
        "a session keeps its task, dataset and set-up: open another one",
    ),
)
