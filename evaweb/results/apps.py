"""Django configuration of the app."""

from django.apps import AppConfig


class ResultsConfig(AppConfig):
    """Configuration of the app for results of trials, second ratings, and preferences between two trials."""

    name = "evaweb.results"
    default_auto_field = "django.db.models.BigAutoField"

    def ready(self) -> None:
        from evaweb.records.append_only import protect
        from evaweb.results.ratings import rating_queue, restoring  # noqa: F401  it declares what is asked before a failure is corrected  # noqa: F401  it declares itself to those that reconcile
        from evaweb.results.reports import sealing  # noqa: F401  it declares what a reveal keeps

        protect(self)
