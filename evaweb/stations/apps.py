"""Registers the app."""

from django.apps import AppConfig


class StationsConfig(AppConfig):
    """Robots on the bench: where they are, who may command them, what was commanded."""

    name = "evaweb.stations"
    default_auto_field = "django.db.models.BigAutoField"
