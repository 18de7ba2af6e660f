"""What names a trial wherever it goes: into manifests, journals, exports."""

from __future__ import annotations

from typing import Any

from evaweb.trials.models import Trial


def trial_facts(trial: Trial) -> dict[str, Any]:
    """The key of a trial in plain JSON; the uuid tells it from those of other databases."""
    return {
        "id": trial.pk,
        "uuid": str(trial.uuid),
        "evaluation": trial.evaluation.name,
        "version": trial.evaluation_version,
        "checkpoint": trial.checkpoint.name,
        "scene": trial.scene.name,
        "position": trial.position.number,
        "number": trial.number,
        "attempt": trial.attempt,
        "seed": trial.seed,
        "instruction": trial.instruction,
        "station": trial.station.name,
    }
