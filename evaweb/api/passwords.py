"""Revocation of a user's tokens when the password changes, as Django ends sessions."""

from __future__ import annotations

import logging
from collections.abc import Iterable
from typing import Any

from django.contrib.auth.models import User
from django.db.models.signals import pre_save
from django.dispatch import receiver

from evaweb.api.tokens import revoke_tokens

log = logging.getLogger(__name__)


@receiver(pre_save, sender=User)
def _ended(
    sender: Any, instance: User, raw: bool, update_fields: Iterable[str] | None = None, **named: Any
) -> None:
    """Delete the tokens of an account whose password changes, or that is deactivated."""
    fields = {"password", "is_active"} if update_fields is None else set(update_fields)
    if raw or instance.pk is None or not fields & {"password", "is_active"}:
        return
    before = User.objects.filter(pk=instance.pk).values("password", "is_active").first()
    if before is None:
        return
    name = instance.get_username()
    if instance.password != before["password"] and not _hashed_anew(instance, fields):
        log.info("the password of %a is changed", name)
        revoke_tokens(user=instance, why="the password is changed")
    if before["is_active"] and not instance.is_active:
        log.info("%a is switched off", name)
        revoke_tokens(user=instance, why="the account is switched off")


def _hashed_anew(user: User, fields: set[str]) -> bool:
    """Return True if Django only updates the hash of the same password at a login."""
    return fields == {"password"} and user._password is None and user.has_usable_password()
