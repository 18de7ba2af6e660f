"""Registers the app."""

from django.apps import AppConfig


class ApiConfig(AppConfig):
    """REST under /api/v1, one file per resource."""

    name = "evaweb.api"
    default_auto_field = "django.db.models.BigAutoField"

    def ready(self) -> None:
        """Listen to changes of passwords."""
        from evaweb.api import passwords  # noqa: F401  its receiver
