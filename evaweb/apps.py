"""Django configuration of the admin site."""

from __future__ import annotations

from django.contrib.admin.apps import AdminConfig


class LabAdminConfig(AdminConfig):
    """Django's admin app with the lab's site as the default."""

    default_site = "evaweb.administration.LabAdminSite"

    def ready(self) -> None:
        """Register the login receivers and the system checks of the data folder."""
        super().ready()
        from evaweb import audit, private  # noqa: F401  receivers and checks
