"""Django configuration of the app."""

from django.apps import AppConfig


class LabConfig(AppConfig):
    """Complete lab on one machine."""

    name = "evaweb.lab"
