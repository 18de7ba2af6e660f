"""The first account of a lab: made on a page with a code that the lab shows in its own terminal alone."""

from __future__ import annotations

import logging
import secrets
from pathlib import Path

from django.conf import settings
from django.contrib.auth.models import User
from django.db import Error, transaction

from evaweb.errors import Conflict
from evaweb.lab.seed import fresh_password, has_no_accounts
from evaweb.roles import Role, set_role
from runtime.recording.files import write_atomic

log = logging.getLogger(__name__)


def offer() -> str:
    """A new code, good until an account is made with it or the lab ends."""
    code = fresh_password()
    write_atomic(_path(), code.encode())
    _path().chmod(0o600)
    return code


def withdraw() -> None:
    """No code is good any more."""
    _path().unlink(missing_ok=True)


def is_offered() -> bool:
    """True if nobody can log in, and this lab has shown a code."""
    return _path().is_file() and is_missing()


def is_missing() -> bool:
    """True if nobody can log in; False also where the database does not say: the login will."""
    try:
        return has_no_accounts()
    except Error:
        return False


def is_code(given: str) -> bool:
    """True if that is the code."""
    try:
        code = _path().read_bytes()
    except FileNotFoundError:
        return False
    return secrets.compare_digest(given.strip().lower().encode(), code)


@transaction.atomic
def administrator_make(*, username: str, password: str) -> User:
    """The first administrator, once: of two who ask at once, one gets Conflict."""
    if not has_no_accounts():
        raise Conflict("this lab has an account already: log in, or ask an administrator for one")
    user, _ = User.objects.get_or_create(username=username)
    user.set_password(password)
    user.is_active = True
    user.save()
    set_role(user=user, role=Role.ADMIN)
    try:
        _path().unlink()
    except FileNotFoundError:
        raise Conflict("this code was used just now: log in") from None
    log.warning("%a is made an administrator with the code of the lab's terminal", username)
    return user


def _path() -> Path:
    return Path(settings.DATA_DIR) / "first_account"
