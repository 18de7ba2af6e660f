"""Django app configuration."""

from django.apps import AppConfig


class PreflightsConfig(AppConfig):
    """Configuration of the app for preflights of checkpoints."""

    name = "evaweb.preflights"
    default_auto_field = "django.db.models.BigAutoField"
