"""Django admin site for users with the admin role, who have all permissions there."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import Any

from django.contrib.admin import AdminSite
from django.contrib.auth.backends import BaseBackend
from django.contrib.auth.forms import AuthenticationForm
from django.http import HttpRequest, HttpResponseRedirect
from django.shortcuts import redirect

from evaweb.accounts.roles import Role, role_of
from evaweb.blinding.visibility import visibility_for_user
from evaweb.core.errors import NotAllowed

# Prefixes of pages that reveal the checkpoint of a trial, a recording, a command or a job.
_REVEALING_PAGES = (
    "trials_trial_",
    "trials_score_",
    "stations_command_",
    "episodes_episode_",
    "jobs_job_",
    "autocomplete",
)


class LabAdminSite(AdminSite):
    """Admin site that is opened by the user's role instead of `is_staff`."""

    site_header = site_title = "EVA administration"
    index_title = "The lab"
    login_form = AuthenticationForm  # the role decides, not is_staff

    def has_permission(self, request: HttpRequest) -> bool:
        """Return True if this user is an admin."""
        return bool(request.user.is_active and is_admin(request.user))

    def password_change(self, request: HttpRequest, extra_context: Any = None) -> HttpResponseRedirect:
        """Redirect to the lab's own page, which counts wrong guesses of the old password."""
        return redirect("password")

    def admin_view(self, view: Callable[..., Any], cacheable: bool = False) -> Callable[..., Any]:
        """Wrap a view to refuse pages that would reveal data hidden from this administrator."""
        inner = super().admin_view(view, cacheable)

        @wraps(inner)
        def seen(request: HttpRequest, *given: Any, **named: Any) -> Any:
            match = request.resolver_match
            name = str(match.url_name or "") if match else ""
            if name.startswith(_REVEALING_PAGES) and self.has_permission(request):
                hidden = visibility_for_user(request.user)
                if not hidden.hides_nothing:
                    raise NotAllowed(f"this page tells which checkpoint a trial is of, and {hidden.plans}")
            return inner(request, *given, **named)

        return seen


class LabelledRows:
    """Mixin of a ModelAdmin with an editable list: each field gets a label for screen readers.

    Without this mixin the fields have no labels, because Django does not connect them with the column heads.
    """

    def get_changelist_form(self, request: HttpRequest, **named: Any) -> Any:
        """Return the form with an aria-label per field, which names field and row."""
        form = super().get_changelist_form(request, **named)  # type: ignore[misc]
        editable = getattr(self, "list_editable", ())

        class Labelled(form):  # type: ignore[misc, valid-type]
            def __init__(self, *given: Any, **more: Any) -> None:
                super().__init__(*given, **more)
                for name in set(editable) & set(self.fields):
                    field = self.fields[name]
                    field.widget.attrs["aria-label"] = f"{field.label or name} of {self.instance}"

        return Labelled


class RoleBackend(BaseBackend):
    """Authentication backend that grants admins every permission; logins are handled by other backends."""

    def has_perm(self, user_obj: Any, perm: str, obj: Any = None) -> bool:
        """Return True if this user is an admin."""
        return bool(user_obj.is_active and is_admin(user_obj))

    def has_module_perms(self, user_obj: Any, app_label: str) -> bool:
        """Return True if this user is an admin."""
        return self.has_perm(user_obj, app_label)


def is_admin(user: Any) -> bool:
    """Return True if the role is admin; looked up once per `user` object, that is per request."""
    if not hasattr(user, "_eva_is_admin"):
        user._eva_is_admin = role_of(user) is Role.ADMIN
    return bool(user._eva_is_admin)
