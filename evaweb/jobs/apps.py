"""Registers the app."""

from django.apps import AppConfig


class JobsConfig(AppConfig):
    """Work for the worker: rows that are claimed, done and swept."""

    name = "evaweb.jobs"
    default_auto_field = "django.db.models.BigAutoField"
