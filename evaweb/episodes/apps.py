"""Django app configuration."""

from django.apps import AppConfig


class EpisodesConfig(AppConfig):
    """Configuration of the app for recorded episodes: index, replay, datasets, reconcile."""

    name = "evaweb.episodes"
    default_auto_field = "django.db.models.BigAutoField"
