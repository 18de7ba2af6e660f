"""Registers the app."""

from django.apps import AppConfig


class DatasetsConfig(AppConfig):
    """Datasets of the data folder, ours and those of others; it keeps nothing in the database."""

    name = "evaweb.datasets"
    default_auto_field = "django.db.models.BigAutoField"
