"""Sessions and their demonstrations; the disk is authoritative: sessions/<uuid>.jsonl, manifests, labels."""

from __future__ import annotations

import uuid

from django.conf import settings
from django.db import models
from django.utils import timezone

from evaweb.episodes.models import Episode
from evaweb.records.append_only import AppendOnly
from evaweb.stations.models import Station


class CollectSession(models.Model):
    """One task demonstrated at one station for one dataset, possibly over days, with a constant set-up."""

    uuid = models.UUIDField(primary_key=True, default=uuid.uuid4, editable=False)
    station = models.ForeignKey(Station, on_delete=models.PROTECT, related_name="collect_sessions")
    dataset = models.CharField(
        max_length=100, help_text="Name of the dataset that its episodes are meant for."
    )
    task = models.TextField()
    operator = models.ForeignKey(
        settings.AUTH_USER_MODEL, on_delete=models.PROTECT, related_name="collect_sessions"
    )
    target = models.PositiveIntegerField(null=True, blank=True, help_text="Episodes that are wanted.")
    setup = models.JSONField(help_text="Robot, groups, joints, cameras with sizes, rate, streams.")
    opened_at = models.DateTimeField(default=timezone.now)
    closed_at = models.DateTimeField(null=True, blank=True)

    append_only = AppendOnly(
        "a session keeps its task, dataset and set-up: open another one",
        except_columns=("target", "closed_at"),
    )

    class Meta:
        ordering = ("-opened_at",)
        indexes = [models.Index(fields=("dataset", "-opened_at"))]
        constraints = [
            models.UniqueConstraint(
                fields=("station",),
                condition=models.Q(closed_at=None),
                name="collect_session_one_open_per_station",
            )
        ]

    def __str__(self) -> str:
        return f"{self.task} ({self.dataset})"


class SessionEventKind(models.TextChoices):
    """Kinds of session events."""

    OPENED = "opened", "opened"
    CLOSED = "closed", "closed"
    RESUMED = "resumed", "resumed"
    TARGET = "target", "target changed"
    PUBLISHED = "published", "publication asked for"


class SessionEvent(models.Model):
    """Entry of a session's history."""

    session = models.ForeignKey(CollectSession, on_delete=models.CASCADE, related_name="events")
    kind = models.CharField(max_length=12, choices=SessionEventKind)
    text = models.TextField(blank=True)
    by = models.ForeignKey(settings.AUTH_USER_MODEL, on_delete=models.PROTECT, related_name="+")
    at = models.DateTimeField(default=timezone.now)

    append_only = AppendOnly("what happened to a session is never changed or removed")

    class Meta:
        ordering = ("at", "pk")

    def __str__(self) -> str:
        return f"{self.kind} by {self.by}"


class Result(models.TextChoices):
    """Result of a demonstration; empty before it is labelled."""

    NONE = "", "not labelled"
    SUCCESS = "success", "success"
    PARTIAL = "partial", "partial"
    FAIL = "fail", "fail"


class Demonstration(models.Model):
    """Episode of a session with its newest label, for which labels/<uuid>.jsonl is authoritative."""

    episode = models.OneToOneField(
        Episode, on_delete=models.CASCADE, primary_key=True, related_name="demonstration"
    )
    session = models.ForeignKey(CollectSession, on_delete=models.PROTECT, related_name="demonstrations")
    result = models.CharField(max_length=8, choices=Result, blank=True, default=Result.NONE)
    note = models.TextField(blank=True)
    discarded = models.BooleanField(default=False)
    labelled_by = models.CharField(max_length=150, blank=True)
    labelled_at = models.DateTimeField(null=True, blank=True)

    def __str__(self) -> str:
        return f"{self.episode_id}: {'discarded' if self.discarded else self.get_result_display()}"
