"""Episodes: rows about the folders in DATA/episodes, which are authoritative."""

from __future__ import annotations

import uuid

from django.conf import settings
from django.core.validators import RegexValidator
from django.db import models
from django.utils import timezone

from evaweb.stations.models import Station

LONGEST_TAG = 60  # longest tag [characters]


class EpisodeStatus(models.TextChoices):
    """Status of a recording; the last three are the possible values of its outcome."""

    RECORDING = "recording", "recording"
    FINISHED = "finished", "finished"
    INTERRUPTED = "interrupted", "interrupted"
    FAILED = "failed", "failed"
    MISSING = "missing", "not on this disk"


class EpisodeMode(models.TextChoices):
    """Way in which the robot was moved while an episode was recorded.

    A run has one of the modes "continuous", "step", "preview", "sim" and "manual". The mode "observe" belongs to a
    recording without a run, and "collect" to a demonstration.
    """

    CONTINUOUS = "continuous", "continuous"
    STEP = "step", "step by step"
    PREVIEW = "preview", "preview"
    SIM = "sim", "simulated robot"
    MANUAL = "manual", "by hand"
    OBSERVE = "observe", "observed"
    COLLECT = "collect", "collected"


class Episode(models.Model):
    """A recorded run or demonstration."""

    uuid = models.UUIDField(primary_key=True, default=uuid.uuid4)
    station = models.ForeignKey(Station, on_delete=models.PROTECT, related_name="episodes")
    status = models.CharField(max_length=12, choices=EpisodeStatus, default=EpisodeStatus.RECORDING)
    reason = models.TextField(blank=True, help_text="Why it ended.")
    kind = models.CharField(max_length=16, default="rollout")
    mode = models.CharField(max_length=16, choices=EpisodeMode, blank=True)
    strategy = models.CharField(max_length=32, blank=True, help_text="With which it began.")
    task = models.TextField(blank=True)
    robot = models.CharField(max_length=63, blank=True)
    checkpoint = models.CharField(max_length=120, blank=True)
    operator = models.CharField(max_length=150, blank=True)
    cameras = models.JSONField(default=list, blank=True)
    fps = models.FloatField(null=True, blank=True)
    frames = models.PositiveIntegerField(default=0)
    duration_s = models.FloatField(null=True, blank=True, help_text="Without the time it was held.")
    started_at = models.DateTimeField(null=True, blank=True)
    configuration_hash = models.CharField(max_length=64, blank=True)
    control = models.JSONField(default=dict, blank=True, help_text="The control loop's figures at the end.")
    policy = models.JSONField(default=dict, blank=True, help_text="Latencies and delays of the policy.")
    smoothness = models.FloatField(
        null=True, blank=True, help_text="SPARC of the measured speed of its end effectors; none: not known."
    )
    smoothness_commanded = models.FloatField(null=True, blank=True, help_text="The same of what was sent.")
    smoothness_detail = models.JSONField(
        null=True, blank=True, help_text="Arm by arm, or why there is none; null: nobody was asked yet."
    )
    previewed_at = models.DateTimeField(null=True, blank=True, help_text="Since when videos can be played.")
    dataset = models.CharField(max_length=240, blank=True, help_text="Relative to the data folder.")
    dataset_index = models.PositiveIntegerField(null=True, blank=True)
    published_at = models.DateTimeField(null=True, blank=True)
    damage = models.JSONField(
        default=list,
        blank=True,
        help_text="Files that are not what was recorded; it is not published.",
    )
    seal = models.CharField(
        max_length=64,
        blank=True,
        help_text="Of its outcome, when that was first read; it is never another one.",
    )
    verified_at = models.DateTimeField(
        null=True, blank=True, help_text="When all of its files were last compared with their digests."
    )
    away_since = models.DateTimeField(
        null=True,
        blank=True,
        help_text="Since when it is closed on its station's computer and not here yet; none: it is not on its way.",
    )
    archived_at = models.DateTimeField(
        null=True, blank=True, help_text="Since when its camera files are in the store; none: they are not."
    )
    created_at = models.DateTimeField(auto_now_add=True)

    class Meta:
        ordering = ("-started_at", "-created_at")
        indexes = [
            models.Index(fields=("verified_at",), name="episode_verified"),
            # Statistics pages count the measured episodes.
            models.Index(
                fields=("smoothness",),
                condition=models.Q(smoothness__isnull=False),
                name="episode_measured",
            ),
        ]

    def __str__(self) -> str:
        return f"{self.uuid} ({self.get_status_display()})"


class Tag(models.Model):
    """Free tag of an episode for filtering lists, in lower case so that spellings coincide."""

    uuid = models.UUIDField(primary_key=True, default=uuid.uuid4, editable=False)
    episode = models.ForeignKey(Episode, on_delete=models.PROTECT, related_name="tags")
    words = models.CharField(max_length=LONGEST_TAG, db_index=True)
    by = models.ForeignKey(settings.AUTH_USER_MODEL, on_delete=models.PROTECT, related_name="tags")
    at = models.DateTimeField(default=timezone.now)

    class Meta:
        ordering = ("words",)
        constraints = [models.UniqueConstraint(fields=("episode", "words"), name="tag_once_per_episode")]

    def __str__(self) -> str:
        return self.words


class Subset(models.Model):
    """Episodes that a query found at one moment, under a name; neither changes afterwards."""

    name = models.CharField(
        max_length=100,
        unique=True,
        validators=[
            RegexValidator(
                r"\A[A-Za-z0-9][A-Za-z0-9_.-]{0,99}\Z",
                "%(value)s was given; allowed: letters, digits, '.', '_' and '-', the first a letter or digit",
            )
        ],
        help_text="Also that of its dataset.",
    )
    description = models.TextField(blank=True, help_text="What it is for.")
    query = models.JSONField(default=dict, blank=True, help_text="Filters of the list of episodes.")
    episodes = models.ManyToManyField(Episode, related_name="subsets")
    digest = models.CharField(max_length=64, help_text="SHA-256 of the sorted UUIDs of its episodes.")
    created_by = models.ForeignKey(settings.AUTH_USER_MODEL, on_delete=models.PROTECT, related_name="subsets")
    created_at = models.DateTimeField(default=timezone.now)
    dataset = models.CharField(max_length=240, blank=True, help_text="Relative to the data folder.")
    published_at = models.DateTimeField(null=True, blank=True)

    class Meta:
        ordering = ("-created_at",)

    def __str__(self) -> str:
        return self.name
