"""Django configuration of the app."""

from django.apps import AppConfig


class ConsoleConfig(AppConfig):
    """Configuration of the app for the live page of a station and its live socket."""

    name = "evaweb.console"
    default_auto_field = "django.db.models.BigAutoField"

    def ready(self) -> None:
        """Register the system checks."""
        from evaweb.console import checks  # noqa: F401
