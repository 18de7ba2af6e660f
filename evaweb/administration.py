"""The admin pages: for users with the role of an admin, who may do everything there."""

from __future__ import annotations

from typing import Any

from django.contrib.admin import AdminSite
from django.contrib.auth.backends import BaseBackend
from django.contrib.auth.forms import AuthenticationForm
from django.http import HttpRequest

from evaweb.roles import Role, role_of


class LabAdminSite(AdminSite):
    """Django's admin site, opened by the role instead of a flag."""

    site_header = site_title = "EVA administration"
    index_title = "The lab"
    login_form = AuthenticationForm  # the role decides, not is_staff

    def has_permission(self, request: HttpRequest) -> bool:
        """Whether this user is an admin."""
        return bool(request.user.is_active and is_admin(request.user))


class RoleBackend(BaseBackend):
    """Gives admins every permission; logging in is another backend's business."""

    def has_perm(self, user_obj: Any, perm: str, obj: Any = None) -> bool:
        """Whether this user is an admin."""
        return bool(user_obj.is_active and is_admin(user_obj))

    def has_module_perms(self, user_obj: Any, app_label: str) -> bool:
        """The same for a whole app."""
        return self.has_perm(user_obj, app_label)


def is_admin(user: Any) -> bool:
    """Whether the role is that of an admin; looked up once per request, as `user` lives as long."""
    if not hasattr(user, "_eva_is_admin"):
        user._eva_is_admin = role_of(user) is Role.ADMIN
    return bool(user._eva_is_admin)
