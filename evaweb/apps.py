"""Registers the admin pages."""

from __future__ import annotations

from django.contrib.admin.apps import AdminConfig


class LabAdminConfig(AdminConfig):
    """Django's admin, with our site as the default one."""

    default_site = "evaweb.administration.LabAdminSite"

    def ready(self) -> None:
        """Listen to logins, and look at the data folder."""
        super().ready()
        from evaweb import audit, private  # noqa: F401  receivers and checks
