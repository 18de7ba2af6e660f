"""Tokens: shown once when created, stored only as SHA-256, with an expiry date."""

from __future__ import annotations

import logging
import secrets
from collections.abc import Iterable
from datetime import timedelta
from typing import Any

from django.contrib.auth.models import User
from django.db import IntegrityError, OperationalError, transaction
from django.db.models.signals import post_delete, pre_save
from django.dispatch import receiver
from django.utils import timezone

from evaweb.accounts.credentials import (
    EXPIRED_ALLOWED,
    TOKEN,
    credentials,
    digest,
)
from evaweb.accounts.hub_tokens import remove_hub_token
from evaweb.api.models import Token
from evaweb.core.errors import Conflict, EvaError
from evaweb.core.lock_wait import lock_wait
from runtime.core.sentences import Pattern

log = logging.getLogger(__name__)
_NAME_ALLOWED_1_80_CHARACTERS = Pattern(
    "api.tokens.name_allowed_1_80_characters",
    "name = {name!r:.100}; allowed: 1 to 80 characters that say what uses the token",
)
_DAYS_ALLOWED_1 = Pattern("api.tokens.days_allowed_1", "days = {days}; allowed: 1 to {most_days}")
_HAS_TOKEN_NAMED_REVOKE_CHOOSE = Pattern(
    "api.tokens.has_token_named_revoke_choose",
    "{user} has a token named {name!r}: revoke it, or choose another name",
)
UNKNOWN = "is not known, or its time is over"
PREFIX = "eva_"  # recognisable by secret scanners
DAYS, MOST_DAYS = 90, 366
_LENGTH = len(PREFIX) + 43
_USED_EVERY = timedelta(
    minutes=1
)  # resolution of `used_at`, so that not every request writes to the database


def create_token(*, user: User, name: str, days: int = DAYS) -> str:
    """Return a new token of 256 random bits that expires after `days`; it cannot be displayed again."""
    name = name.strip()
    if not 0 < len(name) <= 80 or not name.isprintable():
        raise EvaError(_NAME_ALLOWED_1_80_CHARACTERS(name=name))
    if not 1 <= days <= MOST_DAYS:
        raise EvaError(_DAYS_ALLOWED_1(days=days, most_days=MOST_DAYS))
    secret, end = PREFIX + secrets.token_urlsafe(32), timezone.now() + timedelta(days=days)
    try:
        with transaction.atomic():
            Token.objects.create(user=user, name=name, digest=digest(secret), ends_at=end)
    except IntegrityError:
        raise Conflict(_HAS_TOKEN_NAMED_REVOKE_CHOOSE(user=user.get_username(), name=name)) from None
    log.info("token %a of %a is made, until %s", name, user.get_username(), f"{end:%Y-%m-%d}")
    return secret


def revoke_tokens(*, user: User, why: str) -> None:
    """Delete every token of a user."""
    for token in Token.objects.filter(user=user):
        token.delete()
        log.info("token %a of %a is withdrawn: %s", token.name, user.get_username(), why)


def user_of_token(*, secret: str, ended: bool = False) -> User | None:
    """Return the token's user; None if it is unknown or expired, or the user is deactivated.

    With `ended` expired tokens are accepted too: stopping a robot must not fail because of a date.
    """
    if not ended and (len(secret) != _LENGTH or not secret.startswith(PREFIX)):
        return None  # no database query for other formats
    token = Token.objects.select_related("user").filter(digest=digest(secret), user__is_active=True).first()
    if token is None or (token.ends_at <= timezone.now() and not ended):
        return None
    _note_use(token)
    user: User = token.user
    return user


def _note_use(token: Token) -> None:
    """Record the use of a token without waiting for a locked database, because the caller may want to stop a robot."""
    now = timezone.now()
    if token.used_at is not None and now - token.used_at <= _USED_EVERY:
        return
    try:
        with lock_wait(0):
            Token.objects.filter(pk=token.pk).update(used_at=now)
    except OperationalError as error:
        log.warning("the use of token %s is not noted: %s", token, error)


@receiver(post_delete, sender=Token)
def _withdrawn(instance: Token, **named: Any) -> None:
    for kind in (TOKEN, EXPIRED_ALLOWED[TOKEN]):
        credentials.forget(kind, instance.digest)


credentials.register_kind(TOKEN, lambda secret: user_of_token(secret=secret))
credentials.register_kind(EXPIRED_ALLOWED[TOKEN], lambda secret: user_of_token(secret=secret, ended=True))


@receiver(pre_save, sender=User)
def _ended(
    sender: Any, instance: User, raw: bool, update_fields: Iterable[str] | None = None, **named: Any
) -> None:
    """Delete the tokens of an account whose password changes, or that is deactivated.

    Its Hugging Face token is deleted only in the second case.
    """
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
        remove_hub_token(user=instance)


def _hashed_anew(user: User, fields: set[str]) -> bool:
    """Return True if Django only updates the hash of the same password at a login."""
    return fields == {"password"} and user._password is None and user.has_usable_password()
