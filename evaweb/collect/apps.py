"""Django app configuration."""

from django.apps import AppConfig


class CollectConfig(AppConfig):
    """Configuration of the app for collection sessions and their demonstrations."""

    name = "evaweb.collect"
    default_auto_field = "django.db.models.BigAutoField"

    def ready(self) -> None:
        from evaweb.collect import restoring  # noqa: F401  it declares itself to those that reconcile
        from evaweb.records.append_only import protect

        protect(self)
