"""First account of a lab, created on a page with a code that only the lab's terminal shows."""

from __future__ import annotations

import logging
import secrets
from pathlib import Path

from django.conf import settings
from django.contrib.auth.models import User
from django.db import Error, transaction

from evaweb.accounts.roles import Role, set_role
from evaweb.core.errors import Conflict
from evaweb.lab.demo_rows import fresh_password, has_no_accounts
from runtime.recording.files import write_atomic

log = logging.getLogger(__name__)


def offer() -> str:
    """Return a new code, valid until an account is created with it or the lab ends."""
    code = fresh_password()
    write_atomic(_path(), code.encode())
    _path().chmod(0o600)
    return code


def withdraw() -> None:
    """Invalidate the code."""
    _path().unlink(missing_ok=True)


def is_offered() -> bool:
    """Return True if there is no account, and this lab has shown a code."""
    return _path().is_file() and is_missing()


def is_missing() -> bool:
    """Return True if there is no account.

    False if the database does not answer; the login page then reports that.
    """
    try:
        return has_no_accounts()
    except Error:
        return False


def is_code(given: str) -> bool:
    """Return True if `given` is the code."""
    try:
        code = _path().read_bytes()
    except FileNotFoundError:
        return False
    return secrets.compare_digest(given.strip().lower().encode(), code)


@transaction.atomic
def administrator_make(*, username: str, password: str) -> User:
    """Create the first administrator.

    Raises:
        Conflict: If there is an account already; of two simultaneous requests only one succeeds.
    """
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
