"""Jobs: the row is the truth, the broker only a doorbell."""

from __future__ import annotations

from django.db import models
from django.db.models.functions import Now


class JobStatus(models.TextChoices):
    """Where a job stands."""

    QUEUED = "queued", "waiting"
    RUNNING = "running", "running"
    DONE = "done", "done"
    FAILED = "failed", "failed"


class Job(models.Model):
    """One piece of work; claimed by a conditional update, swept when its worker goes silent.

    `key` names what it is about, e.g. "publish:<uuid>": at most one job of a key waits at a time. All its times are
    the database's: machines whose clocks differ work on the same rows.
    """

    kind = models.CharField(max_length=32)
    key = models.CharField(max_length=160)
    args = models.JSONField(default=dict, blank=True)
    queue = models.CharField(max_length=63, default="lab", help_text="The worker that owns the disk.")
    status = models.CharField(max_length=12, choices=JobStatus, default=JobStatus.QUEUED)
    attempts = models.PositiveSmallIntegerField(default=0, help_text="Those that ended in an error.")
    deaths = models.PositiveSmallIntegerField(
        default=0, help_text="Workers that ended or went silent over it."
    )
    owner = models.UUIDField(null=True, blank=True, help_text="The worker's process that does it.")
    created_at = models.DateTimeField(db_default=Now())
    not_before = models.DateTimeField(null=True, blank=True, help_text="Tried again from then on.")
    claimed_at = models.DateTimeField(null=True, blank=True)
    seen_at = models.DateTimeField(null=True, blank=True, help_text="The worker's last sign of life.")
    finished_at = models.DateTimeField(null=True, blank=True)
    progress = models.CharField(max_length=160, blank=True)
    result = models.JSONField(default=dict, blank=True)
    error = models.TextField(blank=True)

    class Meta:
        ordering = ("-created_at",)
        indexes = [
            models.Index(fields=("status", "queue", "created_at")),
            models.Index(fields=("-finished_at",)),
        ]
        constraints = [
            models.UniqueConstraint(
                fields=("key",), condition=models.Q(status="queued"), name="job_one_waiting_per_key"
            )
        ]

    def __str__(self) -> str:
        return f"{self.kind} {self.key}: {self.status}"
