"""Django configuration of the app."""

from django.apps import AppConfig


class ApiConfig(AppConfig):
    """REST interface under /api/v1."""

    name = "evaweb.api"
    default_auto_field = "django.db.models.BigAutoField"
    verbose_name = "Tokens of programs"

    def ready(self) -> None:
        """Connect the receiver of password changes, and set the title of django-axes on the admin pages.

        django-axes is the app that counts failed logins.
        """
        from django.apps import apps

        from evaweb.api import tokens  # noqa: F401  its receiver

        apps.get_app_config("axes").verbose_name = "Failed logins"
