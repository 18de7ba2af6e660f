"""Administration of accounts and tokens: a user has exactly one role, from creation on."""

from __future__ import annotations

import logging
from typing import Any

from axes.models import AccessAttempt
from django import forms
from django.conf import settings
from django.contrib import admin
from django.contrib.auth.admin import UserAdmin
from django.contrib.auth.forms import UserChangeForm, UserCreationForm
from django.contrib.auth.models import Group, User
from django.db.models import QuerySet
from django.http import HttpRequest
from django.utils import timezone

from evaweb.accounts.models import HubToken
from evaweb.accounts.roles import Role, role_of, set_role
from evaweb.api.models import Token

log = logging.getLogger(__name__)
_MEANINGS = (
    "A viewer sees everything and can press the e-stop. An operator also takes stations, runs and scores "
    "trials. An admin also writes scenes, checkpoints, stations and accounts."
)


def _role_field() -> forms.ChoiceField:
    choices = [(role.value, role.value) for role in Role]
    return forms.ChoiceField(
        choices=choices, widget=forms.RadioSelect, initial=Role.VIEWER, help_text=_MEANINGS
    )


class NewAccountForm(UserCreationForm):
    """Form of a new account: name, password, role."""

    role = _role_field()

    class Meta(UserCreationForm.Meta):
        model = User
        fields = ("username", "first_name", "last_name", "email")


class AccountForm(UserChangeForm):
    """Form of an existing account; administrators cannot remove their own rights by mistake."""

    role = _role_field()
    asking: User | None = None

    def __init__(self, *args: Any, **named: Any) -> None:
        super().__init__(*args, **named)
        self.fields["role"].initial = role_of(self.instance).value

    def clean(self) -> dict[str, Any]:
        """Check that administrators do not lock themselves out."""
        cleaned: dict[str, Any] = super().clean() or self.cleaned_data
        loses = cleaned.get("role") != Role.ADMIN or not cleaned.get("is_active")
        if self.asking is not None and self.asking.pk == self.instance.pk and loses:
            raise forms.ValidationError(
                "This is your own account: another administrator has to switch it off or take its role."
            )
        return cleaned


class RoleFilter(admin.SimpleListFilter):
    """Filter of accounts by role."""

    title, parameter_name = "role", "role"

    def lookups(self, request: HttpRequest, model_admin: Any) -> list[tuple[str, str]]:
        """Return the roles."""
        return [(role.value, role.value) for role in Role]

    def queryset(self, request: HttpRequest, queryset: QuerySet[User]) -> QuerySet[User]:
        """Return the users with this highest role."""
        if self.value() not in set(Role):
            return queryset
        users = queryset.prefetch_related("groups")
        return queryset.filter(pk__in=[user.pk for user in users if role_of(user) == self.value()])


class AccountAdmin(UserAdmin):
    """Administration of accounts and their roles."""

    form, add_form = AccountForm, NewAccountForm
    list_display = ("username", "full_name", "role", "is_active", "last_login")
    list_filter = ("is_active", RoleFilter)
    fieldsets = (
        (None, {"fields": ("username", "password")}),
        ("Person", {"fields": (("first_name", "last_name"), "email")}),
        ("Rights", {"fields": ("role", "is_active")}),
        ("Times", {"fields": ("last_login", "date_joined")}),
    )
    add_fieldsets = (
        (None, {"fields": ("username", "password1", "password2", "role")}),
        ("Person", {"fields": (("first_name", "last_name"), "email")}),
    )
    readonly_fields = ("last_login", "date_joined")
    filter_horizontal = ()

    def get_readonly_fields(self, request: HttpRequest, obj: User | None = None) -> tuple[str, ...]:
        """Make the name of an existing account read-only: records refer to people by name."""
        return (*self.readonly_fields, "username") if obj else self.readonly_fields

    def get_form(self, request: HttpRequest, obj: User | None = None, **named: Any) -> Any:
        """Return the form class with the attribute `asking`, the administrator who edits the account."""
        form = super().get_form(request, obj, **named)
        return type(form.__name__, (form,), {"asking": request.user})

    def save_model(self, request: HttpRequest, obj: User, form: Any, change: bool) -> None:
        """Save the account, then its role."""
        super().save_model(request, obj, form, change)
        if "role" in form.cleaned_data:
            set_role(user=obj, role=Role(form.cleaned_data["role"]))

    def has_delete_permission(self, request: HttpRequest, obj: User | None = None) -> bool:
        """Return False: accounts are deactivated, because records refer to them."""
        return False

    @admin.display(description="name")
    def full_name(self, user: User) -> str:
        """Return first and last name."""
        return user.get_full_name()

    @admin.display(description="role")
    def role(self, user: User) -> str:
        """Return the highest role."""
        return role_of(user).value


admin.site.unregister(User)
admin.site.unregister(Group)  # the three roles are fixed
admin.site.register(User, AccountAdmin)


@admin.register(Token)
class TokenAdmin(admin.ModelAdmin):
    """Administration of tokens: created by `manage.py api_token USER NAME`, revoked here by deletion."""

    list_display = ("name", "user", "created_at", "ends_at", "used_at")
    list_filter = ("user",)
    search_fields = ("name", "user__username")

    def has_add_permission(self, request: HttpRequest) -> bool:
        """Return False: a new token could not be displayed here."""
        return False

    def has_change_permission(self, request: HttpRequest, obj: Token | None = None) -> bool:
        """Return False: tokens are immutable."""
        return False

    def log_deletions(self, request: HttpRequest, queryset: QuerySet[Token]) -> Any:
        """Log deletions in the log of logins too."""
        for token in queryset:
            log.info(
                "token %a of %a is withdrawn by %a",
                token.name,
                token.user.get_username(),
                request.user.get_username(),
            )
        return super().log_deletions(request, queryset)


@admin.register(HubToken)
class HubTokenAdmin(admin.ModelAdmin):
    """Administration of people's Hugging Face tokens: entered by themselves, here only removed."""

    list_display = ("user", "ending", "entered_at")
    search_fields = ("user__username",)
    fields = ("user", "ending", "entered_at")

    def has_add_permission(self, request: HttpRequest) -> bool:
        """Return False: only people themselves enter their token."""
        return False

    def has_change_permission(self, request: HttpRequest, obj: HubToken | None = None) -> bool:
        """Return False: only people themselves replace their token."""
        return False

    def log_deletions(self, request: HttpRequest, queryset: QuerySet[HubToken]) -> Any:
        """Log deletions in the log of logins too."""
        for token in queryset:
            name, by = token.user.get_username(), request.user.get_username()
            log.info("the Hugging Face token of %a is removed by %a", name, by)
        return super().log_deletions(request, queryset)


@admin.register(AccessAttempt)
class AttemptAdmin(admin.ModelAdmin):
    """Administration of recent failed logins; deleting them unlocks the name at that address."""

    list_display = ("username", "ip_address", "failures_since_start", "attempt_time", "locks")
    search_fields = ("username", "ip_address")
    fields = ("username", "ip_address", "user_agent", "failures_since_start", "attempt_time")

    def has_add_permission(self, request: HttpRequest) -> bool:
        """Return False: attempts are only recorded."""
        return False

    def has_change_permission(self, request: HttpRequest, obj: AccessAttempt | None = None) -> bool:
        """Return False: attempts are only recorded."""
        return False

    @admin.display(boolean=True, description="locks the name there")
    def locks(self, attempt: AccessAttempt) -> bool:
        """Return True if this attempt alone reaches the limit of failures and is still recent."""
        counts = timezone.now() - attempt.attempt_time < settings.AXES_COOLOFF_TIME
        return counts and attempt.failures_since_start >= settings.AXES_FAILURE_LIMIT
