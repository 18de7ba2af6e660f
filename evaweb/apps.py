"""Registers the admin pages."""

from __future__ import annotations

from django.contrib.admin.apps import AdminConfig


class LabAdminConfig(AdminConfig):
    """Django's admin, with our site as the default one."""

    default_site = "evaweb.administration.LabAdminSite"
