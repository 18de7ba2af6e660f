"""Django configuration of the admin site."""

from __future__ import annotations

from django.contrib.admin.apps import AdminConfig


class LabAdminConfig(AdminConfig):
    """Django's admin app with the lab's site as the default."""

    default_site = "evaweb.accounts.admin_site.LabAdminSite"

    def ready(self) -> None:
        """Register the login receivers and the system checks of the data folder."""
        super().ready()
        from evaweb.core import file_checks  # noqa: F401  receivers and checks
