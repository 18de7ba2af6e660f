"""Jobs: the rows are authoritative, the broker is only a doorbell."""

from __future__ import annotations

from django.conf import settings
from django.db import models
from django.db.models.functions import Now


class JobStatus(models.TextChoices):
    """Status of a job."""

    QUEUED = "queued", "waiting"
    RUNNING = "running", "running"
    DONE = "done", "done"
    FAILED = "failed", "failed"


class Job(models.Model):
    """One job; claimed by a conditional update, reclaimed when its worker goes silent.

    `key` names its subject, e.g. "publish:<uuid>": at most one job per key is queued at a time. All times are the
    database's, so that machines with different clocks can work on the same rows.
    """

    kind = models.CharField(max_length=32)
    key = models.CharField(max_length=160)
    args = models.JSONField(default=dict, blank=True)
    queue = models.CharField(max_length=63, default="cpu", help_text="What a worker needs for it.")
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
    cancelled_by = models.ForeignKey(
        settings.AUTH_USER_MODEL,
        null=True,
        blank=True,
        on_delete=models.PROTECT,
        related_name="+",
        help_text="Has asked for its end; one that runs ends at its next step, as failed.",
    )

    class Meta:
        ordering = ("-created_at",)
        indexes = [
            models.Index(fields=("status", "queue", "created_at")),
            models.Index(fields=("-finished_at",)),
            models.Index(fields=("key", "id")),  # finds out whether a failed job was requested again
        ]
        constraints = [
            models.UniqueConstraint(
                fields=("key",), condition=models.Q(status="queued"), name="job_one_waiting_per_key"
            )
        ]

    def __str__(self) -> str:
        return f"{self.kind} {self.key}: {self.status}"


class WorkerProcess(models.Model):
    """Running worker: the queues it serves, and whether its data folder is the lab's. Times are the database's."""

    id = models.UUIDField(primary_key=True, help_text="The owner that its jobs name.")
    host = models.CharField(max_length=255)
    queues = models.JSONField(default=list)
    folder = models.BooleanField(help_text="Its data folder is the lab's.")
    seen_at = models.DateTimeField(db_default=Now(), help_text="Its last sign of life.")

    def __str__(self) -> str:
        return f"worker {self.id} of {self.host}"


class LabFolder(models.Model):
    """Record of which data folder is the lab's: its `lab_id`, computer and path.

    The table has only one row. It is written by the processes that serve the web.
    """

    lab_id = models.CharField(max_length=32)
    host = models.CharField(max_length=255)
    path = models.CharField(max_length=4096)

    class Meta:
        constraints = [models.CheckConstraint(condition=models.Q(id=1), name="one_lab_folder")]

    def __str__(self) -> str:
        return f"{self.path} of {self.host} ({self.lab_id})"


class Hold(models.Model):
    """Name, for example of a dataset, that a running job holds, so that no other job works on it meanwhile.

    It is void once the job has ended or has another owner.
    """

    what = models.CharField(max_length=1024, unique=True)
    job = models.ForeignKey(Job, on_delete=models.CASCADE, related_name="holds")
    owner = models.UUIDField()

    def __str__(self) -> str:
        return f"{self.what}: {self.job_id}"
