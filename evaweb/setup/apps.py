"""Registers the app."""

from django.apps import AppConfig


class SetupConfig(AppConfig):
    """Setting up a lab by sight."""

    name = "evaweb.setup"
