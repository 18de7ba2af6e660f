"""Django app configuration."""

from django.apps import AppConfig


class StationsConfig(AppConfig):
    """Configuration of the app for stations: robots with their computers, leases and commands."""

    name = "evaweb.stations"
    default_auto_field = "django.db.models.BigAutoField"
