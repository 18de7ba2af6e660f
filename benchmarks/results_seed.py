"""Database of a lab with many evaluations, as after years of use, for measurements of pages."""

from __future__ import annotations

import random
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from typing import Any

_SCENES, _POSITIONS, _STATIONS, _OPERATORS = 4, 5, 5, 20
_MILESTONES = ("grasped", "lifted", "placed")
_FAILURES = ("dropped", "missed the grasp", "collided", "stood still", "wrong object")
_BEGIN = datetime(2024, 1, 1, tzinfo=UTC)
_BATCH = 5000
_COPIED = (
    "trials.Evaluation",
    "plans.Plan",
    "plans.Plan_checkpoints",
    "plans.Plan_positions",
    "plans.PlanEvent",
    "plans.Slot",
    "episodes.Episode",
    "trials.Trial",
    "trials.Score",
    "trials.MilestoneOutcome",
    "plans.Handout",
)


@dataclass(frozen=True, slots=True)
class Seeded:
    """Created data: plans with visible results, a viewer who may see them, operators and stations."""

    plans: Sequence[Any]
    viewer: Any
    operators: Sequence[Any]
    stations: Sequence[Any]
    trials: int


def seed(plans: int, trials: int) -> Seeded:
    """Create `plans` evaluations with about `trials` trials in all.

    The last twentieth of the plans is still running.
    """
    from django.contrib.auth.models import Group, User

    from evaweb.stations.models import Station
    from evaweb.trials.models import Checkpoint, Milestone, Position, Scene

    chance = random.Random(8)
    operators = [User.objects.create_user(f"operator-{i:02}") for i in range(_OPERATORS)]
    group = Group.objects.get_or_create(name="operator")[0]
    group.user_set.add(*operators)
    viewer = User.objects.get_or_create(username="viewer")[0]
    stations = [Station.objects.create(name=f"bench-{i}", robot="agilex_piper") for i in range(_STATIONS)]
    scenes = [
        Scene.objects.create(name=f"scene-{i}", title=f"Scene {i}", instruction="put the block on the plate")
        for i in range(_SCENES)
    ]
    for scene in scenes:
        Position.objects.bulk_create(Position(scene=scene, number=n) for n in range(1, _POSITIONS + 1))
        Milestone.objects.bulk_create(
            Milestone(scene=scene, order=n, text=text, required=n == len(_MILESTONES))
            for n, text in enumerate(_MILESTONES, start=1)
        )
    checkpoints = [Checkpoint.objects.create(name=f"policy-{i:02}") for i in range(12)]
    late = round(plans * 0.95)  # plans from here on are still running
    share = trials // plans
    created = [
        _plan(i, share, chance, operators, stations, scenes, checkpoints, i >= late) for i in range(plans)
    ]
    return Seeded(created, viewer, operators, stations, trials)


def multiplied(seeded: Seeded, times: int) -> Seeded:
    """Copy each evaluation with all its rows until there are `times` as many, with the copies before the originals.

    PostgreSQL only. The server copies rows without checks, so its user must be a superuser.
    """
    from django.apps import apps
    from django.db import connection, transaction

    from evaweb.plans.models import Plan

    models = [apps.get_model(name) for name in _COPIED]
    with transaction.atomic(), connection.cursor() as cursor:
        cursor.execute("SET LOCAL session_replication_role = replica")  # without triggers and foreign keys
        steps = {model: _newest(cursor, model) for model in models}
        for model in models:
            table, fields = model._meta.db_table, model._meta.concrete_fields
            columns = ", ".join(f'"{field.column}"' for field in fields)
            copied = ", ".join(_copied(field, steps) for field in fields)
            cursor.execute(
                f'INSERT INTO "{table}" ({columns}) SELECT {copied} FROM "{table}", generate_series(1, %s) AS copy',
                [times - 1],
            )
            if steps[model]:
                column = model._meta.pk.column
                cursor.execute("SELECT pg_get_serial_sequence(%s, %s)", [table, column])
                cursor.execute(
                    f'SELECT setval(%s, (SELECT max("{column}") FROM "{table}"))', cursor.fetchone()
                )
    plans = list(Plan.objects.order_by("pk"))
    return Seeded(plans, seeded.viewer, seeded.operators, seeded.stations, seeded.trials * times)


def _newest(cursor: Any, model: Any) -> int:
    """Return the highest primary key of a model; 0 if its keys are not integers."""
    from django.db.models import AutoField

    if not isinstance(model._meta.pk, AutoField):
        return 0
    cursor.execute(f'SELECT max("{model._meta.pk.column}") FROM "{model._meta.db_table}"')
    return int(cursor.fetchone()[0])


def _copied(field: Any, steps: Mapping[Any, int]) -> str:
    """Return the SQL expression for the value of a column in a copied row."""
    column = f'"{field.column}"'
    of = field.related_model if field.is_relation else field.model if field.primary_key else None
    if steps.get(of):
        return f"{column} + copy * {steps[of]}"
    if of in steps or (field.unique and field.get_internal_type() == "UUIDField"):
        return f"md5({column}::text || copy)::uuid"
    if field.name == "name":
        return f"{column} || '-' || copy"
    if field.get_internal_type() == "DateTimeField":
        return f"{column} - copy * interval '1 year'"
    return column


def _plan(
    i: int,
    trials: int,
    chance: random.Random,
    operators: Sequence[Any],
    stations: Sequence[Any],
    scenes: Sequence[Any],
    checkpoints: Sequence[Any],
    running: bool,
) -> Any:
    from evaweb.plans.models import Plan, PlanState
    from evaweb.plans.services import freeze_plan
    from evaweb.trials.models import Position

    chosen = chance.sample(list(checkpoints), chance.choice((2, 2, 3, 4)))
    places = chance.sample(list(scenes), 2)
    plan = Plan.objects.create(
        name=f"evaluation-{i:03}",
        title=f"Evaluation {i}",
        question="Is the newer one better?",
        owner=operators[i % len(operators)],
        repetitions=max(1, trials // (len(chosen) * 2 * _POSITIONS)),
        blind=False,
        first=chosen[0],
        second=chosen[1],
    )
    plan.checkpoints.set(chosen)
    plan.positions.set(Position.objects.filter(scene__in=places))
    freeze_plan(user=plan.owner, plan=plan)
    _trials(plan, chance, operators, stations, _BEGIN + timedelta(days=3 * i), 0.7 if running else 1.0)
    if not running:
        row, at = Plan.objects.filter(pk=plan.pk), _BEGIN + timedelta(days=3 * i + 2)
        row.update(state=PlanState.CLOSED, closed_at=at)
        row.update(state=PlanState.REVEALED, revealed_at=at)
        plan.refresh_from_db()
    return plan


def _trials(
    plan: Any,
    chance: random.Random,
    operators: Sequence[Any],
    stations: Sequence[Any],
    begin: datetime,
    share: float,
) -> None:
    """Create the trials for the first `share` of a plan's slots: allocated, run, scored and counted."""
    slots = list(plan.slots.order_by("index"))
    slots = slots[: int(len(slots) * share)]
    trials = _run(plan, slots, chance, operators, stations, begin)
    skill = {pk: chance.uniform(0.3, 0.9) for pk in plan.checkpoints.values_list("pk", flat=True)}
    _scored(trials, skill, chance)
    _handed(plan, slots, trials)
    _counted(plan)


def _run(
    plan: Any,
    slots: Sequence[Any],
    chance: random.Random,
    operators: Sequence[Any],
    stations: Sequence[Any],
    begin: datetime,
) -> list[Any]:
    """Return a trial with a recording for each slot; each block has one station and one operator."""
    block_of = {slot.block: (chance.choice(stations), chance.choice(operators)) for slot in slots}
    trials = []
    for number, slot in enumerate(slots):
        station, operator = block_of[slot.block]
        episode = closed_episode(
            station, begin + timedelta(seconds=100 * number), round(chance.uniform(6, 60), 3)
        )
        trials.append(_trial(plan, slot, episode, operator))
    _written([trial.episode for trial in trials])
    return _written(trials)


def closed_episode(station: Any, started: datetime, seconds: float) -> Any:
    """Return a closed recording with 30 rows per second that is not saved yet."""
    from evaweb.episodes.models import Episode

    return Episode(
        station=station,
        status="finished",
        mode="continuous",
        started_at=started,
        duration_s=seconds,
        cameras=["cam_high"],
        frames=int(seconds * 30),
        checkpoint="",
        configuration_hash="0" * 64,
    )


def _trial(plan: Any, slot: Any, episode: Any, operator: Any) -> Any:
    from evaweb.trials.models import Trial, TrialStatus

    return Trial(
        evaluation=plan.evaluation,
        evaluation_version=plan.version,
        checkpoint_id=slot.checkpoint_id,
        scene_id=slot.scene_id,
        position_id=slot.position_id,
        number=slot.repetition,
        station=episode.station,
        operator=operator,
        status=TrialStatus.ENDED,
        instruction="put the block on the plate",
        episode=episode,
        started_at=episode.started_at,
        ended_at=episode.started_at + timedelta(seconds=episode.duration_s),
        duration_s=episode.duration_s,
    )


def _scored(trials: Sequence[Any], skill: Mapping[int, float], chance: random.Random) -> None:
    """Create a score for each trial; `skill` is the success rate by checkpoint. Milestones are reached in order."""
    from evaweb.trials.models import Milestone, MilestoneOutcome, Score

    stones: dict[int, list[Any]] = {}
    for stone in Milestone.objects.order_by("order"):
        stones.setdefault(stone.scene_id, []).append(stone)
    scores, reached = [], []
    for trial in trials:
        success = chance.random() < skill[trial.checkpoint_id]
        reached.append(len(_MILESTONES) if success else chance.randrange(len(_MILESTONES)))
        scores.append(
            Score(
                trial=trial,
                rater=trial.operator,
                success=success,
                score=reached[-1] / len(_MILESTONES),
                failure="" if success else chance.choice(_FAILURES),
                scored_at=trial.ended_at,
            )
        )
    _written(scores)
    _written(
        [
            MilestoneOutcome(
                score=score,
                milestone=stone,
                order=stone.order,
                text=stone.text,
                points=1,
                required=stone.required,
                reached=n < far,
            )
            for score, far in zip(scores, reached, strict=True)
            for n, stone in enumerate(stones[score.trial.scene_id])
        ]
    )


def _handed(plan: Any, slots: Sequence[Any], trials: Sequence[Any]) -> None:
    """Create the plan's hand-outs, one for each slot of the schedule with its trial, in the order of the schedule."""
    from evaweb.plans.commitment import draw_codes
    from evaweb.plans.models import Handout

    codes = draw_codes(bytes(plan.key), len(slots))
    _written(
        [
            Handout(plan=plan, number=n, slot=slot, trial=trial, code=code)
            for n, (slot, trial, code) in enumerate(zip(slots, trials, codes, strict=True), start=1)
        ]
    )


def _written(rows: Sequence[Any]) -> list[Any]:
    """Insert rows of one model; on PostgreSQL by COPY, with primary keys reserved first."""
    from django.db import connection
    from django.db.models import AutoField
    from django.db.models.expressions import DatabaseDefault

    if not rows:
        return []
    options = type(rows[0])._meta
    if connection.vendor != "postgresql":
        return list(type(rows[0])._default_manager.bulk_create(rows, batch_size=_BATCH))
    table = connection.ops.quote_name(options.db_table)
    with connection.cursor() as cursor:
        if isinstance(options.pk, AutoField):
            cursor.execute(
                "SELECT nextval(pg_get_serial_sequence(%s, %s)) FROM generate_series(1, %s)",
                [options.db_table, options.pk.column, len(rows)],
            )
            for row, (number,) in zip(rows, cursor.fetchall(), strict=True):
                row.pk = number
        fields = [
            field
            for field in options.concrete_fields
            if not isinstance(getattr(rows[0], field.attname), DatabaseDefault)
        ]
        columns = ", ".join(connection.ops.quote_name(field.column) for field in fields)
        with cursor.copy(f"COPY {table} ({columns}) FROM STDIN") as copy:
            for row in rows:
                copy.write_row(
                    [field.get_db_prep_save(field.pre_save(row, True), connection) for field in fields]
                )
    for row in rows:
        row._state.adding = False
    return list(rows)


def _counted(plan: Any) -> None:
    """Mark each trial of the plan as scored, with the trial's only score as its verdict.

    This is done in one SQL statement, because it is faster.
    """
    from django.db import connection

    with connection.cursor() as cursor:
        cursor.execute(
            "UPDATE trials_trial SET status = 'scored', changed_at = ended_at, "
            "verdict_id = (SELECT s.id FROM trials_score s WHERE s.trial_id = trials_trial.id) "
            "WHERE evaluation_id = %s",
            [plan.evaluation_id],
        )
