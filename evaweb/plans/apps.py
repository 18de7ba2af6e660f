"""Registers the app."""

from django.apps import AppConfig


class PlansConfig(AppConfig):
    """Evaluations that are planned, frozen and carried out blind."""

    name = "evaweb.plans"
    default_auto_field = "django.db.models.BigAutoField"

    def ready(self) -> None:
        from evaweb.append_only import protect

        # They declare what is hidden from whom, what is asked before a trial of a plan runs, and what ends a plan.
        from evaweb.plans import bench_checks as bench  # noqa: F401
        from evaweb.plans import blinding_rules as sight  # noqa: F401
        from evaweb.plans import (
            counting,  # noqa: F401
            services,  # noqa: F401
        )
        from evaweb.plans import setup_padding as pacing  # noqa: F401

        protect(self)
