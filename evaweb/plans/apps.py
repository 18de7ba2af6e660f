"""Django app configuration."""

from django.apps import AppConfig


class PlansConfig(AppConfig):
    """Configuration of the app for evaluation plans."""

    name = "evaweb.plans"
    default_auto_field = "django.db.models.BigAutoField"

    def ready(self) -> None:
        # They register visibility rules, checks before a plan's trial runs, and the end of plans.
        from evaweb.plans import bench_checks as bench  # noqa: F401
        from evaweb.plans import blinding_rules as sight  # noqa: F401
        from evaweb.plans import (
            counting,  # noqa: F401
            plan_templates,  # noqa: F401
            services,  # noqa: F401
        )
        from evaweb.plans import setup_padding as pacing  # noqa: F401
        from evaweb.records.append_only import protect

        protect(self)
