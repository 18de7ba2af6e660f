"""Registers the app."""

from django.apps import AppConfig


class PlansConfig(AppConfig):
    """Evaluations that are planned, frozen and carried out blind."""

    name = "evaweb.plans"
    default_auto_field = "django.db.models.BigAutoField"

    def ready(self) -> None:
        from evaweb.guards import keep

        # They declare what is hidden from whom, and what is asked before a trial of a plan runs.
        from evaweb.plans import bench, pacing, sight  # noqa: F401
        from evaweb.plans.guarded import GUARDS

        keep(self, GUARDS)
