"""Django app configuration."""

from django.apps import AppConfig


class DatasetsConfig(AppConfig):
    """Configuration of the app for datasets in the data folder, own and foreign; it has no database tables."""

    name = "evaweb.datasets"
    default_auto_field = "django.db.models.BigAutoField"
