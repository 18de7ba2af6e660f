"""What second raters say of trials, and which of two trials people prefer; neither changes a trial's own score."""

from __future__ import annotations

import uuid

from django.conf import settings
from django.db import models
from django.db.models import F, Q
from django.utils import timezone

from evaweb.append_only import AppendOnly
from evaweb.plans.models import Plan
from evaweb.trials.models import Trial


class Rating(models.Model):
    """A trial scored again from its video by somebody who did not run it; for the agreement of raters, no more."""

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

    append_only = AppendOnly("what a second rater said is never changed or removed")

    class Meta:
        ordering = ("trial", "pk")
        constraints = [models.UniqueConstraint(fields=("trial", "rater"), name="rating_once")]

    def __str__(self) -> str:
        return f"{self.rater} of trial {self.trial_id}: {'success' if self.success else 'failure'}"


class Preference(models.Model):
    """Which of two trials that were run one after the other at the same initial condition was the better one."""

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

    append_only = AppendOnly("what somebody preferred is never changed or removed")

    class Meta:
        ordering = ("plan", "pk")
        constraints = [
            models.UniqueConstraint(fields=("first", "second", "rater"), name="preference_once"),
            models.CheckConstraint(condition=~Q(first=F("second")), name="preference_of_two"),
        ]

    def __str__(self) -> str:
        return f"{self.rater}, {self.first_id} and {self.second_id}: {self.get_outcome_display()}"
