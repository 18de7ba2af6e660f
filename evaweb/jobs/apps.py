"""Registers the app."""

from django.apps import AppConfig
from django.utils.module_loading import autodiscover_modules


class JobsConfig(AppConfig):
    """Work for the worker: rows that are claimed, done and swept."""

    name = "evaweb.jobs"
    default_auto_field = "django.db.models.BigAutoField"

    def ready(self) -> None:
        autodiscover_modules("job_kinds")  # of every app: its kinds of jobs, declared where they are at home
