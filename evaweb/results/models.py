"""Second ratings, preferences and automatic judgements of trials; none of them is a trial's own score."""

from __future__ import annotations

import uuid

from django.conf import settings
from django.core.exceptions import ValidationError
from django.core.validators import MaxValueValidator, MinValueValidator
from django.db import models
from django.db.models import F, Q
from django.utils import timezone

from evaweb.core.errors import EvaError
from evaweb.plans.models import Plan
from evaweb.records.append_only import AppendOnly
from evaweb.results.judges import KINDS
from evaweb.results.judges.base import PATIENCE_S, Setup
from evaweb.results.judges.loading import build_judge
from evaweb.trials.models import Trial


class Rating(models.Model):
    """Second rating of a trial, from its video by a person who did not run it; used only for the agreement of
    raters.
    """

    uuid = models.UUIDField(unique=True, default=uuid.uuid4, editable=False)
    trial = models.ForeignKey(Trial, on_delete=models.PROTECT, related_name="ratings")
    rater = models.ForeignKey(settings.AUTH_USER_MODEL, on_delete=models.PROTECT, related_name="+")
    success = models.BooleanField()
    score = models.FloatField(help_text="Share of the points of all milestones, 0 to 1.")
    milestones = models.JSONField(default=list, help_text="[text, reached] of each, in their order.")
    failure = models.CharField(max_length=60, blank=True)
    failure_phase = models.CharField(max_length=60, blank=True)
    note = models.TextField(blank=True)
    blind = models.BooleanField(help_text="Whether the rater could not know which checkpoint it was.")
    at = models.DateTimeField(default=timezone.now)

    append_only = AppendOnly("a second rating is never changed or removed")

    class Meta:
        ordering = ("trial", "pk")
        constraints = [models.UniqueConstraint(fields=("trial", "rater"), name="rating_once")]

    def __str__(self) -> str:
        return f"{self.rater} of trial {self.trial_id}: {'success' if self.success else 'failure'}"


class Preference(models.Model):
    """Preference between two trials that were run consecutively from the same initial condition."""

    class Outcome(models.TextChoices):
        FIRST = "first", "the first was better"
        SECOND = "second", "the second was better"
        TIE = "tie", "neither"

    uuid = models.UUIDField(unique=True, default=uuid.uuid4, editable=False)
    plan = models.ForeignKey(
        Plan,
        null=True,
        on_delete=models.PROTECT,
        related_name="preferences",
        help_text="None: restored from the disk, and the plan is lost.",
    )
    first = models.ForeignKey(Trial, on_delete=models.PROTECT, related_name="+")
    second = models.ForeignKey(Trial, on_delete=models.PROTECT, related_name="+")
    rater = models.ForeignKey(settings.AUTH_USER_MODEL, on_delete=models.PROTECT, related_name="+")
    outcome = models.CharField(max_length=6, choices=Outcome)
    why = models.TextField(help_text="In a sentence.")
    blind = models.BooleanField(help_text="Whether the rater could not know which checkpoints they were.")
    at = models.DateTimeField(default=timezone.now)

    append_only = AppendOnly("a preference is never changed or removed")

    class Meta:
        ordering = ("plan", "pk")
        constraints = [
            models.UniqueConstraint(fields=("first", "second", "rater"), name="preference_once"),
            models.CheckConstraint(condition=~Q(first=F("second")), name="preference_of_two"),
        ]

    def __str__(self) -> str:
        return f"{self.rater}, {self.first_id} and {self.second_id}: {self.get_outcome_display()}"


def kinds() -> list[tuple[str, str]]:
    """Return the kinds of judges that can be set up."""
    return [(kind, kind) for kind in KINDS]


class AutomaticJudge(models.Model):
    """Judge set up by an administrator; a judge with a server is used only at the address that was allowed."""

    name = models.SlugField(max_length=60, unique=True)
    kind = models.CharField(max_length=20, choices=kinds)
    address = models.CharField(
        max_length=300,
        blank=True,
        help_text="Of a chat server, without /chat/completions, e.g. https://judge.example.org/v1. It is sent "
        "pictures, instructions and milestones once it is allowed, in the list of judges.",
    )
    model = models.CharField(max_length=120, blank=True, help_text="As the server calls it.")
    key_variable = models.CharField(
        max_length=80,
        blank=True,
        help_text="The environment variable of the worker that has the key, EVA_JUDGE_...; the key itself is never "
        "stored here.",
    )
    plain = models.BooleanField(
        "http to another machine",
        default=False,
        help_text="Everybody on the way can see the pictures and the key.",
    )
    patience_s = models.FloatField(
        "patience [s]",
        default=PATIENCE_S,
        validators=[MinValueValidator(1), MaxValueValidator(600)],
        help_text="For the answer about one trial; one without it by then has no verdict.",
    )
    allowed_address = models.CharField(max_length=300, blank=True, editable=False)
    allowed_by = models.ForeignKey(
        settings.AUTH_USER_MODEL, null=True, editable=False, on_delete=models.PROTECT, related_name="+"
    )
    allowed_at = models.DateTimeField(null=True, editable=False)

    class Meta:
        ordering = ("name",)
        verbose_name = "judge"

    def __str__(self) -> str:
        return self.name

    @property
    def setup(self) -> Setup:
        """Set-up from which the judge is built by the module for its kind."""
        return Setup(self.address, self.model, self.key_variable, self.plain, self.patience_s)

    def clean(self) -> None:
        """Check that the module of this kind of judge can build a judge from this set-up.

        Raises:
            ValidationError: If the module cannot.
        """
        try:
            build_judge(self.name, self.kind, self.setup)
        except EvaError as fault:
            raise ValidationError(str(fault)) from None


class Judgement(models.Model):
    """Judgement of a trial by an automatic judge; used only for its agreement with people, neither a score nor a
    rating.

    `judge` and `version` are texts, because the row outlives the judge's set-up.
    """

    uuid = models.UUIDField(unique=True, default=uuid.uuid4, editable=False)
    trial = models.ForeignKey(Trial, on_delete=models.PROTECT, related_name="judgements")
    judge = models.CharField(max_length=60)
    version = models.CharField(max_length=200)
    model = models.CharField(max_length=200, blank=True, help_text="What the server said has answered.")
    milestones = models.JSONField(
        default=list,
        help_text="[text, reached, probability that it was] of each, in their order; null, null for no verdict.",
    )
    reason = models.TextField(blank=True, help_text="Why there is no verdict at all.")
    prompt = models.CharField(
        max_length=64, blank=True, help_text="SHA-256 of the words that it was asked with."
    )
    pictures = models.JSONField(
        default=list, help_text="[camera, time in s, SHA-256] of each that it was shown."
    )
    at = models.DateTimeField(default=timezone.now)

    append_only = AppendOnly("the verdict of a judge is never changed or removed")

    class Meta:
        ordering = ("trial", "pk")
        constraints = [models.UniqueConstraint(fields=("trial", "judge", "version"), name="judgement_once")]

    def __str__(self) -> str:
        return f"{self.judge} ({self.version}) of trial {self.trial_id}: {self.reason or 'judged'}"


class ImportedCrate(models.Model):
    """Results of another lab, read-only: a crate in DATA/crates, by its digest, and what pages show of it.

    None of it enters any statistic of this lab. The row of a removed crate stays without content, as the record of who
    imported and who removed it.
    """

    sha256 = models.CharField("SHA-256", max_length=64)
    size = models.PositiveBigIntegerField(help_text="Of the zip [bytes].")
    content = models.JSONField(help_text="What pages show of it; see evaweb.results.crates.foreign.")
    imported_by = models.ForeignKey(settings.AUTH_USER_MODEL, on_delete=models.PROTECT, related_name="+")
    imported_at = models.DateTimeField(default=timezone.now)
    removed_by = models.ForeignKey(
        settings.AUTH_USER_MODEL, null=True, on_delete=models.PROTECT, related_name="+"
    )
    removed_at = models.DateTimeField(null=True)

    append_only = AppendOnly(
        "the record of an imported crate is never changed or removed",
        columns=("sha256", "size", "imported_by", "imported_at"),
    )

    class Meta:
        ordering = ("-imported_at", "-pk")
        constraints = [
            models.UniqueConstraint(fields=("sha256",), condition=Q(removed_at=None), name="crate_once")
        ]

    def __str__(self) -> str:
        return f"crate {self.sha256[:12]}"
