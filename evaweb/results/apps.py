"""Registers the app."""

from django.apps import AppConfig


class ResultsConfig(AppConfig):
    """What trials of plans say, what second raters say of them, and which of two people prefer."""

    name = "evaweb.results"
    default_auto_field = "django.db.models.BigAutoField"

    def ready(self) -> None:
        from evaweb.append_only import protect
        from evaweb.results.ratings import restoring  # noqa: F401  it declares itself to those that reconcile

        protect(self)
