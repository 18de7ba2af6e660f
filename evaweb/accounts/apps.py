"""Django app configuration."""

from django.apps import AppConfig


class AccountsConfig(AppConfig):
    """Configuration of the app for what people state about themselves; accounts themselves are Django's."""

    name = "evaweb.accounts"
    default_auto_field = "django.db.models.BigAutoField"
