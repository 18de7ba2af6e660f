"""Django configuration of the app."""

from django.apps import AppConfig


class SetupConfig(AppConfig):
    """Setting up a lab."""

    name = "evaweb.setup"
