"""Tokens: made and shown once, known afterwards by their SHA-256 alone."""

from __future__ import annotations

import hashlib
import logging
import secrets
from datetime import timedelta

from django.contrib.auth.models import User
from django.db import IntegrityError, OperationalError, transaction
from django.utils import timezone

from evaweb.api.models import Token
from evaweb.errors import Conflict, EvaError
from evaweb.lock_wait import lock_wait

log = logging.getLogger(__name__)
PREFIX = "eva_"  # so that a scanner of secrets knows one when it sees it
_USED_EVERY = timedelta(minutes=1)  # how exactly `used_at` is kept: not every request is a write


def token_create(*, user: User, name: str) -> str:
    """A new token of 256 random bits; the only time that it can be seen."""
    name = name.strip()
    if not 0 < len(name) <= 80:
        raise EvaError(f"name = {name!r:.100}; allowed: 1 to 80 characters that say what uses the token")
    secret = PREFIX + secrets.token_urlsafe(32)
    try:
        with transaction.atomic():
            Token.objects.create(user=user, name=name, digest=_digest(secret))
    except IntegrityError:
        raise Conflict(
            f"{user.get_username()} has a token named {name!r}: revoke it, or choose another name"
        ) from None
    return secret


def token_user(*, secret: str) -> User | None:
    """Whose token this is, None where nobody's, or of somebody who may not log in."""
    found = Token.objects.select_related("user").filter(digest=_digest(secret), user__is_active=True).first()
    if found is None:
        return None
    _note_use(found)
    user: User = found.user
    return user


def _note_use(token: Token) -> None:
    """Whoever comes may want to stop a robot: nobody is kept waiting while the database is locked."""
    now = timezone.now()
    if token.used_at is not None and now - token.used_at <= _USED_EVERY:
        return
    try:
        with lock_wait(0):
            Token.objects.filter(pk=token.pk).update(used_at=now)
    except OperationalError as error:
        log.warning("the use of token %s is not noted: %s", token, error)


def _digest(secret: str) -> str:
    """Not salted and not slow: a secret of 256 random bits cannot be guessed."""
    return hashlib.sha256(secret.encode("utf-8", "surrogateescape")).hexdigest()
