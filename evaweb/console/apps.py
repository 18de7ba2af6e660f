"""Registers the app."""

from django.apps import AppConfig


class ConsoleConfig(AppConfig):
    """The live page: what it shows and what it asks."""

    name = "evaweb.console"
    default_auto_field = "django.db.models.BigAutoField"

    def ready(self) -> None:
        """Register the checks."""
        from evaweb.console import checks  # noqa: F401
