"""Rows that restored trials refer to, such as their scene and checkpoint.

A row is found by its name. If there is none, a placeholder is created. Scenes and checkpoints that are created here are
deactivated and marked as placeholders.
"""

from __future__ import annotations

from evaweb.episodes.services import get_or_create_station
from evaweb.stations.models import Station
from evaweb.trials.models import Checkpoint, Evaluation, Position, Scene
from evaweb.trials.record import TrialRecord
from evaweb.trials.services import open_bench

PLACEHOLDER_NOTE = "Known from recordings alone: the database was lost."


def station(facts: TrialRecord) -> Station:
    """Return the trial's station, found by name; create it if it does not exist."""
    return get_or_create_station(
        name=facts.station, robot="", simulated=facts.simulated, source=f"trial {facts.uuid}"
    )


def evaluation(facts: TrialRecord, station: Station) -> Evaluation:
    """Return the evaluation of a recorded trial; create it if it does not exist.

    Trials outside of a plan belong to the station's open bench, which is one row with a version number. If the version
    number of this row is lower than that of the trial, it is raised to that of the trial.
    """
    if facts.evaluation_kind == Evaluation.Kind.PLAN:
        row, _ = Evaluation.objects.get_or_create(
            name=facts.evaluation, version=facts.version, defaults={"description": PLACEHOLDER_NOTE}
        )
        return row
    row = open_bench(station)
    if row.version < facts.version:
        row.version = facts.version
        row.save()
    return row


def checkpoint(facts: TrialRecord) -> Checkpoint:
    """Return the trial's checkpoint, found by name; a created one is inactive."""
    note = f"{PLACEHOLDER_NOTE} Say again how it is reached, then switch it on."
    row, _ = Checkpoint.objects.get_or_create(
        name=facts.checkpoint, defaults={"description": note, "active": False}
    )
    return row


def scene(facts: TrialRecord) -> Scene:
    """Return the trial's scene, found by name; a created one gets its milestones from the first restored score."""
    note = f"{PLACEHOLDER_NOTE} Write down again what counts as success, then switch it on."
    row, _ = Scene.objects.get_or_create(
        name=facts.scene,
        defaults={
            "title": facts.scene,
            "instruction": facts.instruction,
            "criterion": note,
            "time_limit_s": facts.time_limit_s,
            "active": False,
        },
    )
    return row


def position(scene: Scene, number: int) -> Position:
    """Return the scene's position of that number; create it if it does not exist."""
    note = f"{PLACEHOLDER_NOTE} Write down again where things stand."
    row, _ = Position.objects.get_or_create(scene=scene, number=number, defaults={"description": note})
    return row
