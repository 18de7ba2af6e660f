"""Stations, their leases, and all commands."""

from __future__ import annotations

import uuid

from django.conf import settings
from django.core.validators import RegexValidator
from django.db import models
from django.utils import timezone

STATION_NAME = r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,62}$"


class Station(models.Model):
    """A robot with the runtime that moves it; its sockets are found by its name."""

    name = models.CharField(
        max_length=63,
        unique=True,
        validators=[
            RegexValidator(STATION_NAME, "letters, digits, '.', '_' and '-'; the first a letter or digit")
        ],
        help_text="As in the deployment file; also the station's folder in the data folder.",
    )
    title = models.CharField(max_length=120, blank=True, help_text="What people call it.")
    robot = models.CharField(max_length=63, help_text="Name of a folder in robots/.")
    deployment = models.TextField(
        blank=True, help_text="The deployment file that `lab` starts; empty: started elsewhere."
    )
    simulated = models.BooleanField(
        default=False, help_text="No robot: a bench that is reset by command and knows the truth."
    )
    active = models.BooleanField(default=True, help_text="Off: not offered to operators.")
    message = models.CharField(
        max_length=240, blank=True, help_text="Shown to everybody, e.g. why it is switched off."
    )
    collects = models.BooleanField(default=False, editable=False)  # as last reported by its runtime
    # Newest event in the database; numbers restart with each boot of the runtime.
    boot = models.CharField(max_length=64, blank=True, editable=False)
    last_event = models.PositiveBigIntegerField(default=0, editable=False)
    created_at = models.DateTimeField(auto_now_add=True)

    class Meta:
        ordering = ("name",)

    def __str__(self) -> str:
        return self.title or self.name


class StationKey(models.Model):
    """Public key that identifies a computer as this station; a withdrawn key stays as a record."""

    station = models.ForeignKey(Station, on_delete=models.PROTECT, related_name="keys")
    key = models.CharField(max_length=64, editable=False, help_text="Public, of CURVE, hexadecimal.")
    computer = models.CharField(max_length=120, blank=True, editable=False, help_text="As it names itself.")
    enrolled_at = models.DateTimeField(auto_now_add=True)
    enrolled_by = models.ForeignKey(
        settings.AUTH_USER_MODEL, null=True, on_delete=models.PROTECT, related_name="+", editable=False
    )
    withdrawn_at = models.DateTimeField(null=True, blank=True, editable=False)
    withdrawn = models.CharField(max_length=240, blank=True, editable=False, help_text="By whom and why.")

    class Meta:
        ordering = ("-enrolled_at",)
        constraints = [
            models.UniqueConstraint(
                fields=("station",), condition=models.Q(withdrawn_at=None), name="station_key_one_each"
            )
        ]

    def __str__(self) -> str:
        return f"{self.station.name}: {self.computer or 'a computer'}"


class EnrolmentCode(models.Model):
    """One-time code that enrols a computer as this station; only its digest is stored."""

    station = models.ForeignKey(Station, on_delete=models.CASCADE, related_name="codes")
    digest = models.CharField(max_length=64, unique=True)
    made_by = models.ForeignKey(settings.AUTH_USER_MODEL, on_delete=models.CASCADE, related_name="+")
    made_at = models.DateTimeField(auto_now_add=True)
    expires_at = models.DateTimeField()

    class Meta:
        ordering = ("-made_at",)

    def __str__(self) -> str:
        return f"a code for {self.station.name}"


class Lease(models.Model):
    """Right of one holder to command a station for a period; the runtime enforces the epoch."""

    station = models.ForeignKey(Station, on_delete=models.PROTECT, related_name="leases")
    user = models.ForeignKey(
        settings.AUTH_USER_MODEL, null=True, on_delete=models.PROTECT, related_name="leases"
    )
    holder = models.CharField(max_length=160, help_text="web:USER:PAGE, or the name of a terminal or script.")
    epoch = models.PositiveBigIntegerField()
    boot = models.CharField(max_length=64, blank=True)
    granted_at = models.DateTimeField(auto_now_add=True)
    ended_at = models.DateTimeField(null=True, blank=True)
    end_reason = models.CharField(max_length=240, blank=True)

    class Meta:
        ordering = ("-granted_at",)
        constraints = [
            models.UniqueConstraint(fields=("station", "epoch"), name="lease_epoch_once"),
            models.UniqueConstraint(
                fields=("station",), condition=models.Q(ended_at=None), name="lease_one_open_per_station"
            ),
        ]

    def __str__(self) -> str:
        return f"{self.station.name} {self.epoch}: {self.holder}"


class LeaseRequest(models.Model):
    """Request of a user that the holder hand the station over."""

    class Answer(models.TextChoices):
        OPEN = "open", "waiting"
        GRANTED = "granted", "handed over"
        DECLINED = "declined", "declined"
        WITHDRAWN = "withdrawn", "withdrawn"

    station = models.ForeignKey(Station, on_delete=models.CASCADE, related_name="lease_requests")
    user = models.ForeignKey(
        settings.AUTH_USER_MODEL, on_delete=models.CASCADE, related_name="lease_requests"
    )
    holder = models.CharField(max_length=160, help_text="The page that would get it.")
    asked_at = models.DateTimeField(auto_now_add=True)
    answer = models.CharField(max_length=12, choices=Answer, default=Answer.OPEN)
    answered_at = models.DateTimeField(null=True, blank=True)

    class Meta:
        ordering = ("asked_at",)
        constraints = [
            models.UniqueConstraint(
                fields=("station", "user"), condition=models.Q(answer="open"), name="lease_request_one_open"
            )
        ]

    def __str__(self) -> str:
        return f"{self.user} asks for {self.station.name}"


class CommandStatus(models.TextChoices):
    """Outcome of a command."""

    PRESSED = "pressed", "pressed"
    ACCEPTED = "accepted", "accepted"
    DONE = "done", "done"
    REFUSED = "refused", "refused"
    FAILED = "failed", "failed"
    UNKNOWN = "unknown", "outcome unknown"


CARRIED_OUT = (CommandStatus.ACCEPTED, CommandStatus.DONE)
NOT_CARRIED_OUT = (CommandStatus.REFUSED, CommandStatus.FAILED)


class Command(models.Model):
    """Command of a user or program; the runtime's own journal is authoritative."""

    uuid = models.UUIDField(primary_key=True, default=uuid.uuid4)
    station = models.ForeignKey(Station, on_delete=models.PROTECT, related_name="commands")
    user = models.ForeignKey(
        settings.AUTH_USER_MODEL, null=True, on_delete=models.PROTECT, related_name="commands"
    )
    kind = models.CharField(max_length=32)
    args = models.JSONField(default=dict, blank=True)
    holder = models.CharField(max_length=160, blank=True)
    epoch = models.PositiveBigIntegerField(default=0)
    boot = models.CharField(max_length=64, blank=True, help_text="Of the snapshot it was decided by.")
    sequence = models.PositiveBigIntegerField(default=0)
    status = models.CharField(max_length=12, choices=CommandStatus, default=CommandStatus.PRESSED)
    reason = models.TextField(blank=True)
    allowed = models.JSONField(default=list, blank=True, help_text="What would have been accepted then.")
    data = models.JSONField(default=dict, blank=True)
    unopened = models.TextField(
        blank=True,
        help_text="Of an accepted run: why its recording could not be opened, so that it never began.",
    )
    issued_at = models.DateTimeField(default=timezone.now, editable=False)
    answered_at = models.DateTimeField(null=True, blank=True)

    class Meta:
        ordering = ("-issued_at",)
        indexes = [models.Index(fields=("station", "-issued_at"))]

    def __str__(self) -> str:
        return f"{self.kind} at {self.station.name}: {self.status}"
