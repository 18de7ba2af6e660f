"""Reviews, segments and check results of episodes; the disk is authoritative for all."""

from __future__ import annotations

import uuid

from django.conf import settings
from django.core.validators import RegexValidator
from django.db import models
from django.db.models.functions import Lower
from django.utils import timezone

from evaweb.core.printed_names import check_name
from evaweb.episodes.models import Episode
from evaweb.records.append_only import AppendOnly


class Verdict(models.TextChoices):
    """Verdict of a review; a note leaves the episode's verdict unchanged."""

    PASS = "pass", "pass"
    FAIL = "fail", "fail"
    NOTE = "note", "note"


DECIDES = (Verdict.PASS, Verdict.FAIL)


class Review(models.Model):
    """Review of an episode by one person; the newest pass or fail counts, all are stored."""

    uuid = models.UUIDField(primary_key=True, default=uuid.uuid4, editable=False)
    episode = models.ForeignKey(Episode, on_delete=models.PROTECT, related_name="reviews")
    verdict = models.CharField(max_length=4, choices=Verdict)
    note = models.TextField(blank=True)
    frame = models.PositiveIntegerField(null=True, blank=True, help_text="The moment that it is about.")
    reviewer = models.ForeignKey(settings.AUTH_USER_MODEL, on_delete=models.PROTECT, related_name="reviews")
    at = models.DateTimeField(default=timezone.now)

    append_only = AppendOnly("a verdict is never changed or removed: say another one")

    class Meta:
        ordering = ("-at",)
        indexes = [models.Index(fields=("episode", "-at"))]

    def __str__(self) -> str:
        return f"{self.verdict} by {self.reviewer}"


class Segment(models.Model):
    """Annotated part of an episode: frames `first` to `last`, inclusive."""

    uuid = models.UUIDField(primary_key=True, default=uuid.uuid4, editable=False)
    episode = models.ForeignKey(Episode, on_delete=models.PROTECT, related_name="segments")
    first = models.PositiveIntegerField()
    last = models.PositiveIntegerField()
    label = models.CharField(max_length=120)
    milestone = models.CharField(max_length=200, blank=True, help_text="What is reached at its last frame.")
    annotator = models.ForeignKey(settings.AUTH_USER_MODEL, on_delete=models.PROTECT, related_name="segments")
    at = models.DateTimeField(default=timezone.now)

    class Meta:
        ordering = ("first", "last", "at")
        constraints = [
            models.CheckConstraint(
                condition=models.Q(last__gte=models.F("first")), name="segment_ends_after_it_begins"
            )
        ]

    def __str__(self) -> str:
        return f"{self.label}: {self.first} to {self.last}"


LABEL_KEYS = "1234567890abdhjkmqstwyz"
"""Keys that can mark a segment in Replay: those without another function there."""


class SegmentLabel(models.Model):
    """Label of the lab's vocabulary for segments, with its colour and key in Replay.

    Segments store the words instead of a reference: changes of a label do not affect them.
    """

    class Colour(models.TextChoices):
        BLUE = "blue", "blue"
        ORANGE = "orange", "orange"
        VIOLET = "violet", "violet"
        TEAL = "teal", "teal"
        GREEN = "green", "green"
        YELLOW = "yellow", "yellow"
        RED = "red", "red"
        GREY = "grey", "grey"

    words = models.CharField(max_length=120, validators=[check_name], help_text="As segments have it.")
    colour = models.CharField(max_length=8, choices=Colour, default=Colour.BLUE)
    key = models.CharField(
        max_length=1,
        blank=True,
        validators=[
            RegexValidator(
                rf"\A[{LABEL_KEYS}]\Z",
                f"%(value)s was given; allowed: one of {' '.join(LABEL_KEYS)}, or none",
            )
        ],
        help_text=f"Begins and ends such a part in Replay: one of {' '.join(LABEL_KEYS)} that no other has.",
    )
    order = models.PositiveSmallIntegerField(default=0)
    active = models.BooleanField(default=True, help_text="Off: retired, not offered; segments keep it.")

    class Meta:
        ordering = ("order", "pk")
        constraints = [
            models.UniqueConstraint(
                Lower("words"),
                name="segment_label_once",
                violation_error_message="There is one of these words already; one that is retired can be "
                "switched on.",
            ),
            models.UniqueConstraint(
                fields=("key",),
                condition=~models.Q(key=""),
                name="segment_label_key_once",
                violation_error_message="Another label has this key; a retired one keeps its own until it is "
                "emptied.",
            ),
        ]

    def __str__(self) -> str:
        return self.words


class Severity(models.TextChoices):
    """Highest severity among the findings of the checks."""

    NOTHING = "", "clean"
    INFO = "info", "clean, with remarks"
    WARNING = "warning", "warnings"
    ERROR = "error", "errors"


class Standing(models.Model):
    """Summary of an episode's reviews: checks requested and done, verdict that counts, publication of sidecars."""

    episode = models.OneToOneField(
        Episode, on_delete=models.CASCADE, primary_key=True, related_name="standing"
    )
    asked_at = models.DateTimeField(null=True, blank=True, help_text="When the checks were asked for.")
    checked_at = models.DateTimeField(null=True, blank=True)
    clean = models.BooleanField(null=True)
    worst = models.CharField(max_length=8, choices=Severity, blank=True)
    flags = models.PositiveIntegerField(default=0, help_text="Findings, remarks included.")
    review = models.ForeignKey(
        Review,
        null=True,
        blank=True,
        on_delete=models.PROTECT,
        related_name="+",
        help_text="The one that counts.",
    )
    changed_at = models.DateTimeField(null=True, blank=True, help_text="The newest review or annotation.")
    attached_at = models.DateTimeField(
        null=True, blank=True, help_text="When these were last put beside the published episode."
    )

    def __str__(self) -> str:
        return f"{self.episode_id}: {self.worst or 'clean'}"
