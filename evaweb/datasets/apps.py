"""Django app configuration."""

from django.apps import AppConfig


class DatasetsConfig(AppConfig):
    """Datasets in the data folder, own and foreign; without database tables."""

    name = "evaweb.datasets"
    default_auto_field = "django.db.models.BigAutoField"
