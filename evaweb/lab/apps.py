"""Registers the app."""

from django.apps import AppConfig


class LabConfig(AppConfig):
    """Everything on one machine."""

    name = "evaweb.lab"
