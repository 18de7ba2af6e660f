"""Django configuration of the app."""

from django.apps import AppConfig


class SetupConfig(AppConfig):
    """Configuration of the app for setting up a lab."""

    name = "evaweb.setup"
