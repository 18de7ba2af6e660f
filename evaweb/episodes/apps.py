"""Django app configuration."""

from django.apps import AppConfig


class EpisodesConfig(AppConfig):
    """Recorded episodes: index, replay, datasets, reconcile."""

    name = "evaweb.episodes"
    default_auto_field = "django.db.models.BigAutoField"
