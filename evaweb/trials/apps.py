"""Django app configuration."""

from django.apps import AppConfig


class TrialsConfig(AppConfig):
    """Configuration of the app for scenes, milestones, checkpoints, trials and their scores."""

    name = "evaweb.trials"
    default_auto_field = "django.db.models.BigAutoField"

    def ready(self) -> None:
        from evaweb.records.append_only import protect
        from evaweb.trials import restoring  # noqa: F401  it declares itself to those that reconcile

        protect(self)
