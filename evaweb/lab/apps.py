"""Django configuration of the app."""

from django.apps import AppConfig


class LabConfig(AppConfig):
    """Configuration of the app for a complete lab on one machine."""

    name = "evaweb.lab"
