"""Django app configuration."""

from django.apps import AppConfig


class ReviewsConfig(AppConfig):
    """Configuration of the app for quality reports, verdicts and annotations of episodes."""

    name = "evaweb.reviews"
    default_auto_field = "django.db.models.BigAutoField"

    def ready(self) -> None:
        from evaweb.records.append_only import protect
        from evaweb.reviews import dataset_sidecars as beside  # noqa: F401  they declare themselves to apps below
        from evaweb.reviews import restoring  # noqa: F401  they declare themselves to apps below

        protect(self)
