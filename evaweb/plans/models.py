"""Plans, their slots, handouts, unblindings and camera checks."""

from __future__ import annotations

from collections.abc import Mapping
from datetime import datetime
from typing import Any
from urllib.parse import quote

from django.conf import settings
from django.core.exceptions import ValidationError
from django.core.validators import MaxValueValidator, MinValueValidator
from django.db import models
from django.db.models import Q

from evaweb.core.printed_names import check_name
from evaweb.records.append_only import AppendOnly
from evaweb.stations.models import Station
from evaweb.trials.models import Checkpoint, Evaluation, Position, Scene, Trial
from evaweb.trials.tables import check_policy, check_strategy


class PlanState(models.TextChoices):
    """State of a plan; only evaweb.plans.services changes it."""

    DRAFT = "draft", "draft"
    FROZEN = "frozen", "running"
    CLOSED = "closed", "closed"
    REVEALED = "revealed", "revealed"


class StoppingRule(models.TextChoices):
    """Design of a plan's comparison: times of its looks, and stopping rule; see evaweb.statistics.designs."""

    NONE = "none", "fixed: all trials are made, one test at the end"
    EVIDENCE = "evidence", "anytime: an e-process, looked at after every pair"
    LATE = "late", "group sequential late: nearly the power of fixed, ends early where much differs"
    EARLY = "early", "group sequential early: fewer trials, a little less power"


class PrimaryOutcome(models.TextChoices):
    """Outcome of a trial that a plan compares between checkpoints."""

    SUCCESS = "success", "success"
    SCORE = "score", "score (partial credit)"


class Allocation(models.TextChoices):
    """Order of the checkpoints within a block; see evaweb.plans.schedule."""

    PAIRED = "paired", "paired: each checkpoint once in every block"
    RANDOM = "random", "random: two trials in every block, of whichever of two checkpoints is drawn"


class Comparing(models.TextChoices):
    """Comparisons that answer a plan's question; they share alpha."""

    PAIR = "pair", "first and second"
    CONTROL = "control", "each checkpoint with the first"
    ALL = "all", "all checkpoints with each other"


class CountsAs(models.TextChoices):
    """Choice of how a run that ended prematurely counts."""

    JUDGED = "judged", "judged: the operator scores it, or has it repeated"
    FAILURE = "failure", "a failure of its checkpoint"
    REPEATED = "repeated", "repeated: it does not count"


class TimeCountsAs(models.TextChoices):
    """Choice of how a run that ended at its time limit counts; such a run is complete."""

    JUDGED = "judged", "judged: by what was reached"
    FAILURE = "failure", "a failure of its checkpoint"


class Plan(models.Model):
    """One version of an evaluation: editable as a draft, immutable once frozen.

    `document` and its `digest` are the frozen form. Schedule, codes and commitment are derived from `key`, which is
    secret until the reveal.
    """

    name = models.SlugField(max_length=60, help_text="Of all its versions; in addresses and exports.")
    version = models.PositiveIntegerField(default=1, editable=False)
    title = models.CharField(max_length=120, validators=[check_name])
    question = models.TextField(
        blank=True, help_text="What is to be found out, written down before the first trial."
    )
    owner = models.ForeignKey(settings.AUTH_USER_MODEL, on_delete=models.PROTECT, related_name="plans")
    state = models.CharField(max_length=8, choices=PlanState, default=PlanState.DRAFT, editable=False)

    positions = models.ManyToManyField(
        Position, blank=True, help_text="Initial conditions, of any number of scenes."
    )
    checkpoints = models.ManyToManyField(Checkpoint, blank=True)
    repetitions = models.PositiveIntegerField(
        default=1,
        validators=[MinValueValidator(1)],
        help_text="Trials of each checkpoint at each position.",
    )
    stations = models.ManyToManyField(
        Station, blank=True, help_text="Where it is carried out; none: anywhere."
    )
    strategy = models.JSONField(
        null=True,
        blank=True,
        validators=[check_strategy],
        help_text="Keys of the [strategy] table for all trials; empty: as each checkpoint or station has it.",
    )
    blind = models.BooleanField(default=True, help_text="Operators are not told which checkpoint runs.")
    allocation = models.CharField(
        "order",
        max_length=6,
        choices=Allocation,
        default=Allocation.PAIRED,
        help_text="Random: an operator who recognises a checkpoint cannot tell by it what comes next.",
    )
    stopping = models.CharField("design", max_length=8, choices=StoppingRule, default=StoppingRule.NONE)
    outcome = models.CharField(max_length=8, choices=PrimaryOutcome, default=PrimaryOutcome.SUCCESS)
    margin = models.FloatField(
        null=True,
        blank=True,
        validators=[MinValueValidator(0.001), MaxValueValidator(0.999)],
        help_text="Asks whether the first checkpoint's success rate is not lower than the second's by this much "
        "or more (0.1: ten points). Empty: whether the two differ.",
    )
    look_after = models.JSONField(
        default=list,
        blank=True,
        help_text="With a group sequential design: after which pairs it is looked at, such as [20, 40, 60]. "
        "Empty: after every pair.",
    )
    alpha = models.FloatField(default=0.05, validators=[MinValueValidator(0.0001), MaxValueValidator(0.5)])
    comparing = models.CharField(
        "comparisons",
        max_length=7,
        choices=Comparing,
        default=Comparing.PAIR,
        help_text="What the question is about. Several share alpha.",
    )
    drop_arms = models.BooleanField(
        "drop checkpoints",
        default=False,
        help_text="With several comparisons and a design that looks before the end: a checkpoint that one of them "
        "found worse, or of which nothing is left to be found out, is tried no more.",
    )
    first = models.ForeignKey(
        Checkpoint,
        null=True,
        blank=True,
        on_delete=models.PROTECT,
        related_name="+",
        help_text="Of the comparison that the question is about.",
    )
    second = models.ForeignKey(Checkpoint, null=True, blank=True, on_delete=models.PROTECT, related_name="+")
    second_rater_share = models.FloatField(
        default=0.0,
        validators=[MinValueValidator(0), MaxValueValidator(1)],
        help_text="Share of the trials that somebody else scores again from the video, not knowing the first score.",
    )
    match_gate = models.FloatField(
        "least match",
        null=True,
        blank=True,
        validators=[MinValueValidator(0), MaxValueValidator(1)],
        help_text="Of the bench with the position's reference picture, 0 to 1, before a trial runs: of its worst "
        "region where regions are drawn (0.75 is a good value), else of the whole picture. A lower one needs a reason. "
        "Empty: it is measured, and stops nothing.",
    )

    on_estop = models.CharField(
        "an e-stop counts as",
        max_length=8,
        choices=CountsAs,
        default=CountsAs.JUDGED,
        help_text="Of a run that the e-stop ended.",
    )
    on_interruption = models.CharField(
        "another interruption counts as",
        max_length=8,
        choices=CountsAs,
        default=CountsAs.JUDGED,
        help_text="Of a run that was broken off by anything else: a fault, a lost policy, a station that ended.",
    )
    on_timeout = models.CharField(
        "a time-out counts as",
        max_length=8,
        choices=TimeCountsAs,
        default=TimeCountsAs.JUDGED,
        help_text="Of a run that its time limit ended.",
    )

    evaluation = models.OneToOneField(
        Evaluation, null=True, blank=True, editable=False, on_delete=models.PROTECT, related_name="plan"
    )
    document = models.JSONField(null=True, blank=True, editable=False)
    digest = models.CharField(max_length=64, blank=True, editable=False)
    commitment = models.CharField(max_length=64, blank=True, editable=False)
    key = models.BinaryField(max_length=32, null=True, editable=False)
    amends = models.OneToOneField(
        "self", null=True, blank=True, editable=False, on_delete=models.PROTECT, related_name="amendment"
    )
    amended_because = models.TextField(blank=True, editable=False)
    created_at = models.DateTimeField(auto_now_add=True)
    frozen_at = models.DateTimeField(null=True, blank=True, editable=False)
    closed_at = models.DateTimeField(null=True, blank=True, editable=False)
    closed_because = models.TextField(blank=True, editable=False)
    at_reveal = models.JSONField(
        null=True,
        blank=True,
        editable=False,
        help_text="The comparisons as they stood at the reveal; see evaweb.plans.design.",
    )
    revealed_at = models.DateTimeField(null=True, blank=True, editable=False)
    revealed_by = models.ForeignKey(
        settings.AUTH_USER_MODEL,
        null=True,
        blank=True,
        editable=False,
        on_delete=models.PROTECT,
        related_name="+",
    )

    append_only = AppendOnly(
        "a frozen plan is never changed: amend it",
        (
            *(
                "name",
                "version",
                "title",
                "question",
                "repetitions",
                "strategy",
                "blind",
                "allocation",
                "stopping",
                "comparing",
                "drop_arms",
                "outcome",
                "margin",
                "look_after",
                "alpha",
                "first",
                "second",
            ),
            *("on_estop", "on_interruption", "on_timeout"),
            *("second_rater_share", "match_gate", "evaluation", "document", "digest", "commitment", "key"),
            "frozen_at",
        ),
        condition="OLD.state <> 'draft'",
        allowed_changes={"state": {"frozen": ("closed",), "closed": ("revealed",), "revealed": ()}},
        never=(
            "OLD.state = 'revealed' AND (NEW.owner_id <> OLD.owner_id OR NEW.closed_because <> OLD.closed_because "
            "OR NEW.closed_at <> OLD.closed_at OR NEW.revealed_at IS NULL OR NEW.revealed_at <> OLD.revealed_at "
            "OR COALESCE(NEW.revealed_by_id, 0) <> COALESCE(OLD.revealed_by_id, 0))",
            "OLD.at_reveal IS NOT NULL AND (NEW.at_reveal IS NULL OR OLD.at_reveal <> NEW.at_reveal)",
        ),
    )

    class Meta:
        ordering = ("name", "-version")
        constraints = [
            models.UniqueConstraint(fields=("name", "version"), name="plan_version_once"),
            models.CheckConstraint(
                condition=Q(state="draft", document=None)
                | (~Q(state="draft") & Q(document__isnull=False) & Q(evaluation__isnull=False)),
                name="plan_frozen_has_its_document",
            ),
        ]

    def __str__(self) -> str:
        return f"{self.title} v{self.version}"

    @property
    def stored_at(self) -> datetime | None:
        """Time at which the result was stored: at the reveal, or at the close of an open plan; None before."""
        return datetime.fromisoformat(self.at_reveal["at"]) if self.at_reveal else self.revealed_at

    @property
    def sealed(self) -> bool:
        """Whether the checkpoints of the plan's trials are still secret."""
        return self.blind and self.state in (PlanState.FROZEN, PlanState.CLOSED)


class Slot(models.Model):
    """Scheduled trial of a plan, in order of handout."""

    plan = models.ForeignKey(Plan, on_delete=models.PROTECT, related_name="slots")
    index = models.PositiveIntegerField()
    block = models.PositiveIntegerField(
        help_text="Slots of one initial condition, carried out one after the other."
    )
    checkpoint = models.ForeignKey(Checkpoint, on_delete=models.PROTECT, related_name="+")
    scene = models.ForeignKey(Scene, on_delete=models.PROTECT, related_name="+")
    position = models.ForeignKey(Position, on_delete=models.PROTECT, related_name="+")
    repetition = models.PositiveIntegerField()
    station = models.ForeignKey(
        Station,
        null=True,
        blank=True,
        on_delete=models.PROTECT,
        related_name="+",
        help_text="Which has taken its block.",
    )

    append_only = AppendOnly(
        "the schedule of a frozen plan is never changed: amend it", except_columns=("station",)
    )

    class Meta:
        ordering = ("plan", "index")
        constraints = [models.UniqueConstraint(fields=("plan", "index"), name="slot_index_once")]
        indexes = [models.Index(fields=("plan", "station", "index")), models.Index(fields=("plan", "block"))]

    def __str__(self) -> str:
        return f"{self.plan} #{self.index}"


class Handout(models.Model):
    """Trial as handed out: its slot and code. Each attempt has its own handout."""

    plan = models.ForeignKey(Plan, on_delete=models.PROTECT, related_name="handouts")
    number = models.PositiveIntegerField(help_text="In the order in which they were handed out, from 1.")
    slot = models.ForeignKey(Slot, on_delete=models.PROTECT, related_name="handouts")
    trial = models.OneToOneField(Trial, on_delete=models.PROTECT, related_name="handout")
    code = models.CharField(max_length=8, help_text="What the operator knows it by.")
    reason = models.TextField(blank=True, help_text="Of a repetition: what became of the attempt before.")
    handed_at = models.DateTimeField(auto_now_add=True)

    append_only = AppendOnly("what was handed out is never changed or removed")

    class Meta:
        ordering = ("plan", "number")
        constraints = [
            models.UniqueConstraint(fields=("plan", "number"), name="handout_number_once"),
            models.UniqueConstraint(fields=("plan", "code"), name="handout_code_once"),
        ]
        indexes = [models.Index(fields=("code",), name="handout_code")]

    def __str__(self) -> str:
        return f"{self.plan} {self.code}"


class Look(models.Model):
    """Unblinding of a plan by a user, who can run none of its trials from then on."""

    plan = models.ForeignKey(Plan, on_delete=models.PROTECT, related_name="looks")
    user = models.ForeignKey(settings.AUTH_USER_MODEL, on_delete=models.PROTECT, related_name="+")
    at = models.DateTimeField(auto_now_add=True)

    append_only = AppendOnly("who looked is never changed or removed")

    class Meta:
        ordering = ("plan", "at")
        constraints = [models.UniqueConstraint(fields=("plan", "user"), name="look_once")]

    def __str__(self) -> str:
        return f"{self.user} saw {self.plan}"


class PlanEvent(models.Model):
    """Record of an action on a plan with user and reason; append-only."""

    plan = models.ForeignKey(Plan, on_delete=models.PROTECT, related_name="events")
    at = models.DateTimeField(auto_now_add=True)
    by = models.ForeignKey(settings.AUTH_USER_MODEL, on_delete=models.PROTECT, related_name="+")
    what = models.CharField(max_length=12)
    text = models.TextField()

    append_only = AppendOnly("what was done with a plan is never changed or removed")

    class Meta:
        ordering = ("plan", "id")

    def __str__(self) -> str:
        return f"{self.plan}: {self.what}"


class Reference(models.Model):
    """Reference picture of a camera: it shows a position as laid out or, without a position, the camera's view.

    The newest reference per camera and position counts. `picture` names a file: see evaweb.plans.image_store. `regions`
    are rectangles around objects: see evaweb.plans.region_matching. Changed regions are stored as a new row with the
    same picture.
    """

    station = models.ForeignKey(Station, on_delete=models.PROTECT, related_name="references")
    camera = models.CharField(max_length=63)
    position = models.ForeignKey(
        Position, null=True, blank=True, on_delete=models.PROTECT, related_name="references"
    )
    picture = models.CharField(max_length=64)
    regions = models.JSONField(default=list, blank=True)
    by = models.ForeignKey(settings.AUTH_USER_MODEL, on_delete=models.PROTECT, related_name="+")
    at = models.DateTimeField(auto_now_add=True)

    append_only = AppendOnly("a reference is never changed: take another one")

    class Meta:
        ordering = ("-pk",)
        indexes = [models.Index(fields=("station", "position", "camera", "-id"))]

    def __str__(self) -> str:
        return f"{self.camera} of {self.station} at {self.position or 'any position'}"


class Achieved(models.Model):
    """Image of a camera before a trial's run, and its match to the reference at that time.

    `match` is evaweb.plans.image_store.image_match of the whole picture; `regions` is the result of
    evaweb.plans.region_matching.match_regions, which counts instead if the reference has regions. `override`: why a
    match below the plan's least one was accepted.
    """

    trial = models.ForeignKey(Trial, on_delete=models.PROTECT, related_name="achieved")
    camera = models.CharField(max_length=63)
    picture = models.CharField(max_length=64)
    reference = models.ForeignKey(
        Reference, null=True, blank=True, on_delete=models.PROTECT, related_name="+"
    )
    match = models.FloatField(null=True, blank=True)
    regions = models.JSONField(default=list, blank=True)
    override = models.TextField(blank=True)
    by = models.ForeignKey(settings.AUTH_USER_MODEL, on_delete=models.PROTECT, related_name="+")
    at = models.DateTimeField(auto_now_add=True)

    append_only = AppendOnly("what a trial began with is never changed or removed")

    class Meta:
        ordering = ("trial", "pk")

    def __str__(self) -> str:
        return f"{self.trial_id}: {self.camera}"


class CameraCheck(models.Model):
    """Confirmation by a user that each camera of a station shows the same as its reference.

    Valid for that user until the station restarts or half a day has passed. `seen`: camera -> {"picture",
    "reference", "match"}.
    """

    station = models.ForeignKey(Station, on_delete=models.PROTECT, related_name="camera_checks")
    boot = models.CharField(max_length=64, blank=True)
    seen = models.JSONField()
    by = models.ForeignKey(settings.AUTH_USER_MODEL, on_delete=models.PROTECT, related_name="+")
    at = models.DateTimeField(auto_now_add=True)

    append_only = AppendOnly("who confirmed the cameras is never changed or removed")

    class Meta:
        ordering = ("-pk",)
        indexes = [models.Index(fields=("station", "by", "-id"))]

    def __str__(self) -> str:
        return f"{self.station}, {self.by}, {self.at:%Y-%m-%d %H:%M}"


class PlanTemplate(models.Model):
    """Rule by which each newly registered checkpoint gets a plan like another one, in place of one of its checkpoints.

    Programs that register a checkpoint name the template, which says how its policy is reached.
    """

    name = models.SlugField(
        max_length=40, unique=True, help_text="In the address at which programs register."
    )
    title = models.CharField(
        max_length=100,
        blank=True,
        validators=[check_name],
        help_text="Of the plans, with a number after it; empty: as the plan below.",
    )
    plan = models.ForeignKey(
        Plan,
        on_delete=models.PROTECT,
        related_name="templates",
        help_text="Its positions, rules, other checkpoints and owner are those of the new plans.",
    )
    arm = models.ForeignKey(
        Checkpoint,
        on_delete=models.PROTECT,
        related_name="+",
        verbose_name="in place of",
        help_text="The plan's checkpoint in whose place the new one is tried.",
    )
    tag = models.CharField(
        max_length=40,
        blank=True,
        help_text="Every checkpoint that is registered with this tag gets a plan; empty: only those of programs.",
    )
    policy = models.JSONField(
        default=dict,
        blank=True,
        help_text="Keys of the [policy] table of checkpoints that programs register; {name} and {digest} in its texts "
        'are those of the checkpoint, e.g. {"url": "ws://gpu-1:8000/{name}"}.',
    )
    station = models.ForeignKey(
        Station,
        null=True,
        blank=True,
        on_delete=models.PROTECT,
        related_name="+",
        help_text="Simulated station at whose copies the trials are carried out at once; empty: they wait for people.",
    )
    copies = models.PositiveSmallIntegerField(
        default=1,
        validators=[MinValueValidator(1), MaxValueValidator(256)],  # as copies.MOST_COPIES
        help_text="How many trials at the same time.",
    )
    active = models.BooleanField(default=True, help_text="Off: new checkpoints get no plan.")

    class Meta:
        ordering = ("name",)

    def __str__(self) -> str:
        return self.name

    def policy_for(self, facts: Mapping[str, str]) -> dict[str, Any]:
        """Return the policy table of a checkpoint with these values of `name` and `digest`."""
        filled: dict[str, Any] = _fill(self.policy, facts)
        return filled

    def clean(self) -> None:
        """Raise ValidationError unless the plan has the arm, the station is simulated, and the policy is valid."""
        if self.plan_id and self.arm_id and not self.plan.checkpoints.filter(pk=self.arm_id).exists():
            names = ", ".join(self.plan.checkpoints.values_list("name", flat=True)) or "none"
            raise ValidationError({"arm": f"{self.arm} is no checkpoint of {self.plan}; allowed: {names}"})
        if self.station is not None and not self.station.simulated:
            raise ValidationError(
                {"station": f"{self.station} has a real robot; allowed: a simulated station"}
            )
        try:
            check_policy(self.policy_for({"name": "a", "digest": "b"}))
        except ValidationError as invalid:
            raise ValidationError({"policy": invalid.messages}) from None


def _fill(value: Any, facts: Mapping[str, str]) -> Any:
    if isinstance(value, Mapping):
        return {key: _fill(part, facts) for key, part in value.items()}
    if isinstance(value, list):
        return [_fill(part, facts) for part in value]
    if isinstance(value, str):
        for name, text in facts.items():
            value = value.replace(f"{{{name}}}", quote(text) if "://" in value else text)
    return value


class TemplateUse(models.Model):
    """Plan that was made by a template for a checkpoint."""

    template = models.ForeignKey(PlanTemplate, on_delete=models.CASCADE, related_name="uses")
    checkpoint = models.ForeignKey(Checkpoint, on_delete=models.PROTECT, related_name="+")
    plan = models.OneToOneField(Plan, on_delete=models.CASCADE, related_name="template_use")
    at = models.DateTimeField(auto_now_add=True)

    class Meta:
        ordering = ("-pk",)
        constraints = [
            models.UniqueConstraint(fields=("template", "checkpoint"), name="template_once_per_checkpoint")
        ]

    def __str__(self) -> str:
        return f"{self.checkpoint}: {self.plan}"
