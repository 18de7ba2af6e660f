"""Preflights: checkpoint, station, user and report."""

from __future__ import annotations

import uuid
from typing import Any

from django.conf import settings
from django.db import models

from evaweb.stations.models import Station
from evaweb.trials.models import Checkpoint


class PreflightStatus(models.TextChoices):
    """Status of a preflight; only evaweb.preflights.services changes it."""

    RUNNING = "running", "under way"
    DONE = "done", "done"
    LOST = "lost", "without a report"


class Verdict(models.TextChoices):
    """Outcomes of a preflight's report, with labels; they have the same values as in the runtime."""

    OK = "ok", "usable"
    MISCONFIGURED = "misconfigured", "the configuration is wrong"
    PORT_CLOSED = "port_closed", "port closed"
    UNREACHABLE = "unreachable", "not reached"
    TUNNEL = "tunnel", "no tunnel"
    TLS = "tls", "no encrypted connection"
    WRONG_PROTOCOL = "wrong_protocol", "wrong protocol"
    TIMEOUT = "timeout", "no answer in time"
    REFUSED = "refused", "refused: key or token"
    SERVER_ERROR = "server_error", "the server fails"
    BAD_SHAPE = "bad_shape", "wrong shape"
    WRONG_ACTION_SPACE = "wrong_action_space", "wrong action space"
    NOT_FINITE = "not_finite", "numbers that are none"
    CONTRADICTION = "contradiction", "server and deployment differ"
    FAILED = "failed", "failed"


class Preflight(models.Model):
    """Preflight of a checkpoint; the newest is its current state."""

    class By(models.TextChoices):
        STATION = "station", "the station"
        WORKER = "worker", "the worker"

    uuid = models.UUIDField(primary_key=True, default=uuid.uuid4, editable=False)
    checkpoint = models.ForeignKey(Checkpoint, on_delete=models.CASCADE, related_name="preflights")
    station = models.ForeignKey(
        Station,
        on_delete=models.CASCADE,
        related_name="preflights",
        help_text="Whose deployment and robot it was.",
    )
    user = models.ForeignKey(
        settings.AUTH_USER_MODEL, null=True, on_delete=models.PROTECT, related_name="preflights"
    )
    by = models.CharField(max_length=8, choices=By, help_text="Whose process asked the server.")
    policy = models.JSONField(default=dict, help_text="The checkpoint's policy table as it was then.")
    status = models.CharField(max_length=8, choices=PreflightStatus, default=PreflightStatus.RUNNING)
    report = models.JSONField(null=True, help_text="As `python -m runtime.preflight --json` says it.")
    reason = models.TextField(blank=True, help_text="Why there is no report.")
    asked_at = models.DateTimeField(auto_now_add=True)
    over_by = models.DateTimeField(null=True, help_text="It is over then, whatever happens.")
    ended_at = models.DateTimeField(null=True)

    class Meta:
        ordering = ("-asked_at",)
        indexes = [
            models.Index(fields=("checkpoint", "-asked_at")),
            models.Index(fields=("status", "station")),
        ]

    @property
    def changes(self) -> dict[str, Any]:
        """Tables that override the station's deployment."""
        served = {"strategy": self.checkpoint.strategy} if self.checkpoint.strategy else {}
        return {"policy": self.policy, **served}

    def __str__(self) -> str:
        return f"preflight of {self.checkpoint} at {self.station.name}: {self.verdict or self.status}"

    @property
    def verdict(self) -> str:
        """Outcome of the report, "" without a report."""
        report: dict[str, Any] = self.report or {}
        return str(report.get("verdict", ""))

    @property
    def label(self) -> str:
        """Verdict of the preflight as text; as long as there is no verdict, the preflight's status."""
        if self.verdict in Verdict.values:
            return str(Verdict(self.verdict).label)
        return self.verdict or str(PreflightStatus(self.status).label)

    @property
    def tone(self) -> str:
        """Colour name of the style sheets."""
        if self.status == PreflightStatus.RUNNING:
            return "ok"
        return "active" if self.verdict == Verdict.OK else "warn" if not self.verdict else "danger"
