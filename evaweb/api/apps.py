"""Registers the app."""

from django.apps import AppConfig


class ApiConfig(AppConfig):
    """REST under /api/v1, one file per resource."""

    name = "evaweb.api"
    default_auto_field = "django.db.models.BigAutoField"
    verbose_name = "Tokens of programs"

    def ready(self) -> None:
        """Listen to changes of passwords; the administration calls the library that counts logins what it is."""
        from django.apps import apps

        from evaweb.api import passwords  # noqa: F401  its receiver

        apps.get_app_config("axes").verbose_name = "Failed logins"
