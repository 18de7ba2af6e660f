"""Registers the app."""

from django.apps import AppConfig


class PreflightsConfig(AppConfig):
    """Preflights of checkpoints, asked for and kept."""

    name = "evaweb.preflights"
    default_auto_field = "django.db.models.BigAutoField"
