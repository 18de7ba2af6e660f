"""Roles of users as three groups, each with all rights of the previous one."""

from __future__ import annotations

import logging
from enum import StrEnum
from typing import Any

from django.db import transaction

from evaweb.core.errors import NotAllowed
from runtime.core.sentences import Pattern

log = logging.getLogger(__name__)
_NEEDS_ROLE = Pattern(
    "web.roles.needs_role",
    "{user} is {role}; this needs {needed}: ask an administrator",
)


class Role(StrEnum):
    """Role of a user, by their groups; a user without any of them is a viewer."""

    VIEWER = "viewer"
    OPERATOR = "operator"
    ADMIN = "admin"

    def includes(self, other: Role) -> bool:
        """Return True if this role has all rights of `other`."""
        return _RANK[self] >= _RANK[other]

    @property
    def with_article(self) -> str:
        """Name with its article, for messages."""
        return f"a {self}" if self is Role.VIEWER else f"an {self}"


_RANK = {Role.VIEWER: 0, Role.OPERATOR: 1, Role.ADMIN: 2}


def role_of(user: Any) -> Role:
    """Return the highest role of a user; a superuser is an admin."""
    if user.is_superuser:
        return Role.ADMIN
    names = set(user.groups.values_list("name", flat=True))
    return max((role for role in Role if role.value in names), key=_RANK.__getitem__, default=Role.VIEWER)


def require_role(user: Any, role: Role) -> Role:
    """Return the role of the user. Raises: NotAllowed unless it is at least `role`."""
    has = role_of(user)
    if not has.includes(role):
        raise NotAllowed(
            _NEEDS_ROLE(user=user.get_username(), role=has.with_article, needed=role.with_article)
        )
    return has


@transaction.atomic
def set_role(*, user: Any, role: Role) -> None:
    """Set the only role of a user; this also ends superuser rights and other groups."""
    user.is_superuser = False
    user.is_staff = role is Role.ADMIN  # third-party pages check this flag; ours check the role
    user.save(update_fields=["is_superuser", "is_staff"])
    groups = user.groups.model.objects  # models cannot be imported before the apps are ready
    user.groups.set([groups.get_or_create(name=role.value)[0]])  # recreates a group that was deleted


def get_or_create_person(name: str) -> Any:
    """Return the account of that name; if there is none, create it deactivated and without a password."""
    from django.contrib.auth import get_user_model  # models cannot be imported before the apps are ready

    person, created = get_user_model().objects.get_or_create(
        username=name or "unknown", defaults={"is_active": False}
    )
    if created:
        person.set_unusable_password()
        person.save()
        log.warning("user %s was not in the database: made, deactivated", person.get_username())
    return person
