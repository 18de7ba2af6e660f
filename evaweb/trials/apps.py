"""Registers the app."""

from django.apps import AppConfig


class TrialsConfig(AppConfig):
    """Scenes, milestones, checkpoints, trials and their scores."""

    name = "evaweb.trials"
    default_auto_field = "django.db.models.BigAutoField"
