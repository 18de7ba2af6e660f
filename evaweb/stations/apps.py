"""Registers the app."""

from django.apps import AppConfig


class StationsConfig(AppConfig):
    """Robots on the bench: their sites, leases and commands."""

    name = "evaweb.stations"
    default_auto_field = "django.db.models.BigAutoField"
