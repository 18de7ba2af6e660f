"""Scenes with positions and milestones, checkpoints, evaluations, trials and their scores."""

from __future__ import annotations

import uuid

from django.conf import settings
from django.core.exceptions import ValidationError
from django.core.validators import MaxValueValidator, MinValueValidator, RegexValidator
from django.db import models
from django.db.models.functions import Lower
from django.utils import timezone

from evaweb.core.printed_names import check_name
from evaweb.episodes.models import Episode, Subset
from evaweb.records.append_only import AppendOnly
from evaweb.stations.models import Station
from evaweb.trials.failure_text import failure_text
from evaweb.trials.tables import (
    check_bench,
    check_bench_name,
    check_policy,
    check_strategy,
    check_tags,
    check_term,
    layout_problems,
)
from runtime.benches.schema import DEFAULT_BENCH, BenchSchema, UnusableBench, load_schema


class Scene(models.Model):
    """A task on a bench: the policy's instruction, the layout, and the criterion of success."""

    name = models.SlugField(max_length=60, unique=True, help_text="Short name for addresses and exports.")
    title = models.CharField(max_length=120, validators=[check_name])
    instruction = models.TextField(help_text="The words the policy is given.")
    criterion = models.TextField(
        blank=True, help_text="When is it a success? Written down before the first trial."
    )
    layout = models.TextField(blank=True, help_text="How to lay out the bench before each trial.")
    bench = models.CharField(
        "simulated bench",
        max_length=200,
        default=DEFAULT_BENCH,
        validators=[check_bench_name],
        help_text="Whose objects positions lay out: a bench that comes with the program, or its folder's path.",
    )
    time_limit_s = models.FloatField(
        "time limit [s]",
        null=True,
        blank=True,
        validators=[MinValueValidator(1), MaxValueValidator(3600)],
        help_text="A run ends by itself after this many seconds.",
    )
    ordered = models.BooleanField(
        "milestones in order", default=False, help_text="One counts only after all those before it."
    )
    failure_required = models.BooleanField(
        "failures explained",
        default=False,
        help_text="A failed trial is not scored without the phase in which it failed, and the cause.",
    )
    active = models.BooleanField(default=True, help_text="Off: not offered to operators.")
    created_at = models.DateTimeField(auto_now_add=True)

    class Meta:
        ordering = ("title",)

    def __str__(self) -> str:
        return self.title

    @property
    def schema(self) -> BenchSchema:
        """Schema of the simulated bench. Raises: UnusableBench if its folder is absent or invalid."""
        return load_schema(self.bench)

    @property
    def bench_digest(self) -> str:
        """Digest of the simulated bench's schema; "" if its folder is absent or invalid."""
        try:
            return self.schema.digest
        except UnusableBench:
            return ""


class Position(models.Model):
    """Initial condition of a scene, by number."""

    scene = models.ForeignKey(Scene, on_delete=models.CASCADE, related_name="positions")
    number = models.PositiveSmallIntegerField()
    label = models.CharField(max_length=120, blank=True, validators=[check_name])
    description = models.TextField(blank=True, help_text="Where things stand, in words.")
    bench = models.JSONField(
        null=True,
        blank=True,
        validators=[check_bench],
        help_text='For simulated benches: {"block": [x, y, yaw in degrees], "plate": [x, y]} in metres.',
    )

    class Meta:
        ordering = ("scene", "number")
        constraints = [models.UniqueConstraint(fields=("scene", "number"), name="position_number_once")]

    def __str__(self) -> str:
        return f"{self.number}" + (f" · {self.label}" if self.label else "")

    def clean(self) -> None:
        """Require that the layout consists of objects and factors of the scene's bench."""
        if not isinstance(self.bench, dict):
            return  # none, or refused by the field's own validator
        try:
            problems = layout_problems(self.bench, self.scene.schema)
        except UnusableBench as error:
            problems = [str(error)]
        if problems:
            raise ValidationError({"bench": problems})


class Milestone(models.Model):
    """Step towards success; a trial's score is the fraction of points of the reached milestones."""

    scene = models.ForeignKey(Scene, on_delete=models.CASCADE, related_name="milestones")
    order = models.PositiveSmallIntegerField()
    text = models.CharField(max_length=200, validators=[check_name])
    points = models.PositiveSmallIntegerField(
        default=1, validators=[MinValueValidator(1), MaxValueValidator(100)]
    )
    required = models.BooleanField(default=False, help_text="Without it the trial is no success.")
    time_limit_s = models.FloatField(
        "time limit [s]",
        null=True,
        blank=True,
        validators=[MinValueValidator(0.1), MaxValueValidator(3600)],
        help_text="Reached later than this after the start of the run it does not count.",
    )
    truth = models.CharField(
        max_length=40,
        blank=True,
        help_text="For simulated benches: the name of what the bench itself reports.",
    )

    class Meta:
        ordering = ("scene", "order")
        constraints = [models.UniqueConstraint(fields=("scene", "order"), name="milestone_order_once")]

    def __str__(self) -> str:
        return self.text


FAILURE_KEYS = "abcdefghijmnoqtvwyz"
"""Letters that select a failure together with Shift; none is a command key of the Eval page, with or without Shift.

After scoring the form no longer handles its keys: a surplus key press must be harmless.
"""


class FailureTerm(models.Model):
    """Term of the lab's taxonomy of failures: a phase of the task, or a cause.

    Scores store the words instead of a reference: changes of a term do not affect them.
    """

    class Level(models.TextChoices):
        PHASE = "phase", "phase"
        CAUSE = "cause", "cause"

    level = models.CharField(max_length=5, choices=Level)
    words = models.CharField(
        max_length=60, validators=[check_name, check_term], help_text="As scores have it."
    )
    key = models.CharField(
        max_length=1,
        blank=True,
        validators=[
            RegexValidator(
                rf"\A[{FAILURE_KEYS}]\Z",
                f"%(value)s was given; allowed: one of {' '.join(FAILURE_KEYS)}, or none",
            )
        ],
        help_text="Chooses it at scoring, pressed with Shift: one of "
        f"{' '.join(FAILURE_KEYS)} that no other has.",
    )
    order = models.PositiveSmallIntegerField(default=0, help_text="Among those of its level.")
    active = models.BooleanField(default=True, help_text="Off: retired, not offered; scores keep it.")

    class Meta:
        ordering = ("-level", "order", "pk")  # phases before causes
        verbose_name = "failure phase or cause"
        verbose_name_plural = "failure phases and causes"
        constraints = [
            models.UniqueConstraint(
                Lower("words"),
                "level",
                name="failure_term_once",
                violation_error_message="There is one of these words already; one that is retired can be "
                "switched on.",
            ),
            models.UniqueConstraint(
                fields=("key",),
                condition=~models.Q(key=""),
                name="failure_key_once",
                violation_error_message="Another phase or cause has this key; a retired one keeps its own "
                "until it is emptied.",
            ),
        ]

    def __str__(self) -> str:
        return self.words


class Checkpoint(models.Model):
    """A trained policy: its weights, its parent in training, and its connection."""

    name = models.CharField(max_length=120, unique=True, validators=[check_name])
    description = models.TextField(blank=True, help_text="Trained on what, for how long, by whom.")
    digest = models.CharField(
        "digest of the weights",
        max_length=128,
        blank=True,
        validators=[
            RegexValidator(
                r"\A[A-Za-z0-9][A-Za-z0-9:._@+/=-]{6,127}\Z",
                "%(value)s was given; allowed: 7 to 128 letters, digits and :._@+/=-, such as sha256:9f86d0…",
            )
        ],
        help_text="Tells these weights from all others: sha256:…, a commit, a revision of a hub. Frozen with a plan.",
    )
    parent = models.ForeignKey(
        "self",
        null=True,
        blank=True,
        on_delete=models.PROTECT,
        related_name="children",
        verbose_name="trained on from",
        help_text="The checkpoint that training went on from.",
    )
    recipe = models.CharField(
        max_length=120,
        blank=True,
        validators=[check_name],
        help_text="What it is a training run of: the same data and settings, another seed. Frozen with a plan, whose "
        "results sum up the runs of a recipe.",
    )
    training_set = models.ForeignKey(
        Subset,
        null=True,
        blank=True,
        on_delete=models.PROTECT,
        related_name="checkpoints",
        verbose_name="training set",
        help_text="The subset of this lab's episodes that it was trained on.",
    )
    training_run = (
        models.URLField(  # NULL in place of "": SQLite adds such a column without rebuilding the table
            max_length=500,
            null=True,
            blank=True,
            help_text="Address of the page where its training is recorded, with https:// or http://.",
        )
    )
    tags = models.JSONField(default=list, blank=True, validators=[check_tags], help_text="To find it by.")
    policy = models.JSONField(
        default=dict,
        blank=True,
        validators=[check_policy],
        help_text='Keys of the deployment\'s [policy] table, e.g. {"url": "ws://127.0.0.1:8000"}.',
    )
    strategy = models.JSONField(
        null=True,
        blank=True,
        validators=[check_strategy],
        help_text="Keys of the [strategy] table that its trials run with; empty: as plan or station have it. The same "
        "weights served in several ways are a checkpoint each, with the same digest.",
    )
    anchor = models.BooleanField(
        default=False,
        help_text="Tried beside others in plan after plan, so that it shows when a bench or its scoring drifts: "
        "compared with none but where a plan names it. Frozen with a plan.",
    )
    active = models.BooleanField(default=True, help_text="Off: not offered to operators.")
    created_at = models.DateTimeField(auto_now_add=True)

    class Meta:
        ordering = ("name",)

    def __str__(self) -> str:
        return self.name

    @property
    def strategy_words(self) -> str:
        """The checkpoint's own strategy as text; "" if it has none."""
        return ", ".join(f"{key} {value}" for key, value in (self.strategy or {}).items())

    @property
    def lineage(self) -> list[Checkpoint]:
        """Ancestors in training, nearest first."""
        ancestors: list[Checkpoint] = []
        above = self.parent
        while above is not None and above not in ancestors:
            ancestors.append(above)
            above = above.parent
        return ancestors

    def clean(self) -> None:
        """Raise ValidationError if the parent was itself trained from this checkpoint."""
        if self.pk is not None and self in self.lineage:
            raise ValidationError(
                {"parent": f"{self.parent} was trained on from {self}; allowed: one that was not, or none"}
            )


class Evaluation(models.Model):
    """Set of trials.

    The set belongs to a plan or to the open bench of a station. The latter consists of the station's trials outside any
    plan.
    """

    class Kind(models.TextChoices):
        OPEN_BENCH = "open_bench", "open bench"
        PLAN = "plan", "plan"

    name = models.CharField(max_length=120)
    version = models.PositiveIntegerField(default=1)
    kind = models.CharField(max_length=12, choices=Kind, default=Kind.PLAN)
    station = models.ForeignKey(
        Station, null=True, blank=True, on_delete=models.PROTECT, related_name="evaluations"
    )
    description = models.TextField(blank=True)
    created_at = models.DateTimeField(auto_now_add=True)

    class Meta:
        ordering = ("name", "version")
        constraints = [
            models.UniqueConstraint(fields=("name", "version"), name="evaluation_version_once"),
            models.UniqueConstraint(
                fields=("station",), condition=models.Q(kind="open_bench"), name="evaluation_one_open_bench"
            ),
        ]

    def __str__(self) -> str:
        return f"{self.name} v{self.version}"


class TrialStatus(models.TextChoices):
    """Status of a trial; only evaweb.trials.services changes it."""

    PREPARED = "prepared", "prepared"
    RUNNING = "running", "running"
    PAUSED = "paused", "paused"
    ENDED = "ended", "to be scored"
    INTERRUPTED = "interrupted", "interrupted"
    SCORED = "scored", "scored"
    VOID_ASKED = "void_asked", "void asked for"
    VOIDED = "voided", "voided"
    ABANDONED = "abandoned", "never run"
    NOT_NEEDED = "not_needed", "not needed"

    @property
    def tone(self) -> str:
        """Colour name of the style sheets."""
        return _TONES[self]


_TONES = {
    TrialStatus.PREPARED: "active",
    TrialStatus.RUNNING: "ok",
    TrialStatus.PAUSED: "warn",
    TrialStatus.ENDED: "warn",
    TrialStatus.INTERRUPTED: "danger",
    TrialStatus.SCORED: "neutral",
    TrialStatus.VOID_ASKED: "warn",
    TrialStatus.VOIDED: "neutral",
    TrialStatus.ABANDONED: "neutral",
    TrialStatus.NOT_NEEDED: "neutral",
}


_JUDGED = "OLD.status IN ('scored', 'void_asked', 'voided')"


class Trial(models.Model):
    """One attempt of one checkpoint at one position of a scene; a repetition is a new attempt, never a new score."""

    uuid = models.UUIDField(unique=True, default=uuid.uuid4, editable=False)
    evaluation = models.ForeignKey(Evaluation, on_delete=models.PROTECT, related_name="trials")
    evaluation_version = models.PositiveIntegerField()
    checkpoint = models.ForeignKey(Checkpoint, on_delete=models.PROTECT, related_name="trials")
    scene = models.ForeignKey(Scene, on_delete=models.PROTECT, related_name="trials")
    position = models.ForeignKey(Position, on_delete=models.PROTECT, related_name="trials")
    number = models.PositiveIntegerField(help_text="Counts the trials of this checkpoint at this position.")
    attempt = models.PositiveSmallIntegerField(
        default=1, help_text="Above 1: the one before was interrupted or voided."
    )
    station = models.ForeignKey(Station, on_delete=models.PROTECT, related_name="trials")
    operator = models.ForeignKey(settings.AUTH_USER_MODEL, on_delete=models.PROTECT, related_name="trials")
    worker = models.CharField(  # NULL in place of "": SQLite would rebuild the table, to which guards of others refer
        max_length=60,
        null=True,
        blank=True,
        editable=False,
        help_text="Of a trial that a program carries out: which copy of the simulated station runs it.",
    )
    status = models.CharField(max_length=12, choices=TrialStatus, default=TrialStatus.PREPARED)
    reason = models.TextField(blank=True, help_text="Why it is where it is, in one sentence.")
    instruction = models.TextField(help_text="As the policy was given it.")
    time_limit_s = models.FloatField(null=True, blank=True)
    strategy = models.JSONField(
        null=True, blank=True, help_text="The [strategy] table of its plan; none: as the station has it."
    )
    seed = models.PositiveIntegerField(null=True, blank=True, help_text="Of a simulated bench.")
    episode = models.OneToOneField(
        Episode, null=True, blank=True, on_delete=models.PROTECT, related_name="trial"
    )
    verdict = models.ForeignKey(
        "Score",
        null=True,
        blank=True,
        on_delete=models.PROTECT,
        related_name="+",
        help_text="The newest of its scores: the one that counts.",
    )
    truth = models.JSONField(
        null=True, blank=True, help_text="How a simulated bench says it was left at the end of the run."
    )
    setup_took = models.JSONField(
        null=True,
        blank=True,
        editable=False,
        help_text="How long its policy took to connect and to warm up [s], by the names of the runtime.",
    )
    # Commands of this trial, and the station event from which on events concern it.
    setup = models.UUIDField(null=True, blank=True, editable=False, help_text="Of its newest set-up.")
    run = models.UUIDField(null=True, blank=True, editable=False, help_text="Of the command that ran it.")
    run_boot = models.CharField(max_length=64, blank=True, editable=False)
    run_event = models.PositiveBigIntegerField(
        null=True, blank=True, editable=False, help_text="The newest of the station's events that it knows."
    )
    run_since = models.FloatField(
        null=True, blank=True, editable=False, help_text="Since when it goes on, on the runtime's clock [s]."
    )
    prepared_at = models.DateTimeField(auto_now_add=True)
    started_at = models.DateTimeField(null=True, blank=True)
    ended_at = models.DateTimeField(null=True, blank=True)
    duration_s = models.FloatField(null=True, blank=True, help_text="Without the time it was paused.")
    ended_by = models.CharField(
        max_length=14,
        null=True,
        blank=True,
        help_text="estop, interruption or timeout, as its run ended; empty where it ended by itself.",
    )
    voided_at = models.DateTimeField(null=True, blank=True)
    voided_by = models.ForeignKey(
        settings.AUTH_USER_MODEL, null=True, blank=True, on_delete=models.PROTECT, related_name="+"
    )
    changed_at = models.DateTimeField(auto_now=True)

    append_only = AppendOnly(
        "checkpoint, position, operator and scores of a scored trial are never changed",
        (
            *(
                "uuid",
                "evaluation",
                "evaluation_version",
                "checkpoint",
                "scene",
                "position",
                "number",
                "attempt",
            ),
            *("station", "operator", "instruction", "strategy", "seed", "time_limit_s"),
            *("prepared_at", "started_at", "ended_at", "ended_by"),
        ),
        condition=_JUDGED,
        allowed_changes={
            "status": {"scored": ("void_asked", "voided"), "void_asked": ("voided", "scored"), "voided": ()}
        },
        never=(
            # Values still unknown at scoring time are set once.
            f"{_JUDGED} AND OLD.episode_id IS NOT NULL "
            "AND (NEW.episode_id IS NULL OR NEW.episode_id <> OLD.episode_id)",
            f"{_JUDGED} AND OLD.truth IS NOT NULL AND (NEW.truth IS NULL OR NEW.truth <> OLD.truth)",
            f"{_JUDGED} AND COALESCE(NEW.duration_s, -1) <> COALESCE(OLD.duration_s, -1) AND NOT EXISTS ("
            "SELECT 1 FROM episodes_episode WHERE uuid = NEW.episode_id AND duration_s = NEW.duration_s)",
            "OLD.status = 'voided' AND (NEW.reason <> OLD.reason OR "
            "COALESCE(NEW.voided_by_id, 0) <> COALESCE(OLD.voided_by_id, 0))",
            # The verdict is one of the trial's own scores, replaced only by a later one.
            "COALESCE(NEW.verdict_id, 0) <> COALESCE(OLD.verdict_id, 0) AND NOT EXISTS ("
            "SELECT 1 FROM trials_score WHERE id = NEW.verdict_id AND trial_id = NEW.id "
            "AND id > COALESCE(OLD.verdict_id, 0))",
        ),
    )

    class Meta:
        ordering = ("-prepared_at",)
        constraints = [
            models.UniqueConstraint(
                fields=(
                    "evaluation",
                    "evaluation_version",
                    "checkpoint",
                    "scene",
                    "position",
                    "number",
                    "attempt",
                ),
                name="trial_attempt_once",
            ),
            models.UniqueConstraint(
                fields=("station",),
                condition=models.Q(status__in=("prepared", "running", "paused"), worker=None),
                name="trial_one_open_per_station",
            ),
            models.UniqueConstraint(
                fields=("station", "worker"),
                condition=models.Q(status__in=("prepared", "running", "paused"), worker__isnull=False),
                name="trial_one_open_per_copy",
            ),
        ]
        indexes = [
            models.Index(fields=("status", "scene", "checkpoint")),
            models.Index(fields=("station", "status")),
            models.Index(fields=("station", "-changed_at")),
            models.Index(fields=("-changed_at", "-id"), name="trial_changed"),
            models.Index(fields=("station", "-prepared_at")),
            models.Index(fields=("-prepared_at", "-id"), name="trial_newest"),
        ]

    def __str__(self) -> str:
        return f"trial {self.pk}: {self.checkpoint} at {self.scene} {self.position.number}"


class VoidRequest(models.Model):
    """Request of an operator to void a scored trial of a blind plan; a second operator agrees to it or refuses it."""

    class Answer(models.TextChoices):
        AGREED = "agreed", "agreed to"
        REFUSED = "refused", "refused"
        LAPSED = "lapsed", "not answered in time"

    uuid = models.UUIDField(unique=True, default=uuid.uuid4, editable=False)
    trial = models.ForeignKey(Trial, on_delete=models.PROTECT, related_name="void_requests")
    reason = models.TextField(help_text="Why it should not count.")
    by = models.ForeignKey(settings.AUTH_USER_MODEL, on_delete=models.PROTECT, related_name="+")
    at = models.DateTimeField(default=timezone.now)
    answer = models.CharField(max_length=8, blank=True, choices=Answer)
    answer_reason = models.TextField(blank=True)
    answered_by = models.ForeignKey(
        settings.AUTH_USER_MODEL, null=True, blank=True, on_delete=models.PROTECT, related_name="+"
    )
    answered_at = models.DateTimeField(null=True, blank=True)

    append_only = AppendOnly(
        "an answered request is never changed or removed",
        except_columns=("answer", "answer_reason", "answered_by", "answered_at"),
        never=(
            "OLD.answer <> '' AND (NEW.answer <> OLD.answer OR NEW.answer_reason <> OLD.answer_reason OR "
            "COALESCE(NEW.answered_by_id, 0) <> COALESCE(OLD.answered_by_id, 0) OR "
            "NEW.answered_at <> OLD.answered_at)",
        ),
    )

    class Meta:
        ordering = ("id",)
        constraints = [
            models.UniqueConstraint(
                fields=("trial",), condition=models.Q(answer=""), name="void_asked_once_at_a_time"
            )
        ]

    def __str__(self) -> str:
        return f"void of trial {self.trial_id}: {self.get_answer_display() or 'not answered'}"


class Score(models.Model):
    """Score of a trial by one rater; a correction is another row, and the newest counts."""

    class Source(models.TextChoices):
        HUMAN = "human", "a person"
        TRUTH = "truth", "the simulated bench"

    uuid = models.UUIDField(unique=True, default=uuid.uuid4, editable=False)
    trial = models.ForeignKey(Trial, on_delete=models.PROTECT, related_name="scores")
    rater = models.ForeignKey(settings.AUTH_USER_MODEL, on_delete=models.PROTECT, related_name="scores")
    success = models.BooleanField()
    score = models.FloatField(
        help_text="Share of the points of all milestones, 0 to 1; without milestones 1 for a success, else 0."
    )
    note = models.TextField(blank=True)
    failure = models.CharField(max_length=60, blank=True, help_text="What went wrong, in a word or two.")
    failure_phase = models.CharField(max_length=60, blank=True, help_text="The phase in which it did.")
    reason = models.TextField(blank=True, help_text="Of a correction: why the one before does not stand.")
    source = models.CharField(max_length=16, choices=Source, default=Source.HUMAN)
    scored_at = models.DateTimeField(default=timezone.now)

    append_only = AppendOnly("a score is never changed or removed: a correction is another score")

    class Meta:
        ordering = ("trial", "id")

    def save(self, *args: object, **kwargs: object) -> None:
        """Insert the row. Raises: TypeError for an existing row, as a correction is another row."""
        if self.pk is not None:
            raise TypeError(f"score {self.pk} is never changed: a correction is another score")
        super().save(*args, **kwargs)

    def __str__(self) -> str:
        return f"{'success' if self.success else 'failure'}, {self.score:.0%}"

    @property
    def why(self) -> str:
        """Phase and cause of a failure, as far as specified."""
        return failure_text(self.failure_phase, self.failure)


class MilestoneOutcome(models.Model):
    """Outcome of one milestone: whether it was reached, with its text and points as they were at scoring time."""

    score = models.ForeignKey(Score, on_delete=models.CASCADE, related_name="outcomes")
    milestone = models.ForeignKey(Milestone, null=True, on_delete=models.SET_NULL, related_name="outcomes")
    order = models.PositiveSmallIntegerField()
    text = models.CharField(max_length=200)
    points = models.PositiveSmallIntegerField()
    required = models.BooleanField()
    reached = models.BooleanField()
    at_s = models.FloatField(null=True, blank=True, help_text="When, after the start of the run [s].")

    append_only = AppendOnly(
        "what was scored is never changed or removed: a correction is another score",
        except_columns=("milestone",),
        # Outcomes are added together with their score, before it counts or is corrected.
        forbidden_inserts="EXISTS (SELECT 1 FROM trials_trial WHERE verdict_id = NEW.score_id) OR EXISTS (SELECT 1 "
        "FROM trials_score own, trials_score later WHERE own.id = NEW.score_id AND later.trial_id = own.trial_id "
        "AND later.id > own.id)",
    )

    class Meta:
        ordering = ("score", "order")
        constraints = [models.UniqueConstraint(fields=("score", "order"), name="outcome_order_once")]

    def __str__(self) -> str:
        return f"{self.text}: {'reached' if self.reached else 'not reached'}"
