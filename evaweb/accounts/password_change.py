"""Page on which users change their own password; wrong old passwords count and lock as on the login page."""

from __future__ import annotations

from typing import Any

from axes.utils import reset
from django.contrib.auth import authenticate
from django.contrib.auth.forms import PasswordChangeForm
from django.contrib.auth.views import PasswordChangeView
from django.core.exceptions import ValidationError

from evaweb.accounts.client_addresses import lockable_of


class OwnPasswordForm(PasswordChangeForm):
    """Form for a new password, whose check of the old password counts as a login attempt."""

    request: Any = None

    def clean_old_password(self) -> str:
        """Return the old password. Raises: ValidationError if it is wrong."""
        password: str = self.cleaned_data["old_password"]
        name = self.user.get_username()
        if authenticate(self.request, username=name, password=password) != self.user:
            raise ValidationError(self.error_messages["password_incorrect"], code="password_incorrect")
        reset(
            username=name, ip=lockable_of(self.request)
        )  # a correct password clears earlier failures, as a login does
        return password


class OwnPasswordView(PasswordChangeView):
    """Page for a new password, with the lab's template and form."""

    form_class = OwnPasswordForm
    template_name = "registration/password.html"
    success_url = "/"
    extra_context = {"title": "Your password"}  # noqa: RUF012  Django's

    def get_form(self, form_class: Any = None) -> Any:
        form = super().get_form(form_class)
        form.request = self.request
        return form
