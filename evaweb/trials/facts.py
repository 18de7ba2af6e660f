"""What names a trial wherever it goes, into manifests and journals, and is enough to make it again."""

from __future__ import annotations

from typing import Any

from evaweb.trials.models import Trial


def trial_facts(trial: Trial) -> dict[str, Any]:
    """The key of a trial in plain JSON; the uuid tells it from those of other databases."""
    return {
        "id": trial.pk,
        "uuid": str(trial.uuid),
        "evaluation": trial.evaluation.name,
        "evaluation_kind": str(trial.evaluation.kind),
        "version": trial.evaluation_version,
        "checkpoint": trial.checkpoint.name,
        "scene": trial.scene.name,
        "position": trial.position.number,
        "number": trial.number,
        "attempt": trial.attempt,
        "seed": trial.seed,
        "strategy": trial.strategy,
        "instruction": trial.instruction,
        "time_limit_s": trial.time_limit_s,
        "station": trial.station.name,
        "simulated": trial.station.simulated,
        "operator": trial.operator.get_username(),
        "prepared_at": trial.prepared_at.isoformat(),
    }


def trial_course(trial: Trial) -> dict[str, Any]:
    """The same and how its run went, as far as is known: for those who judge it."""
    return {
        **trial_facts(trial),
        "started_at": trial.started_at.isoformat() if trial.started_at else None,
        "ended_at": trial.ended_at.isoformat() if trial.ended_at else None,
        "duration_s": trial.duration_s,
        "reason": trial.reason,
        "truth": trial.truth,
    }
