"""Diagnostic bundles: requested by an administrator, who alone can download them."""

from __future__ import annotations

import logging
import re
from pathlib import Path

from django.contrib.auth.models import User
from django.utils import timezone

from evaweb.accounts.roles import Role, require_role
from evaweb.core.errors import NotFound
from evaweb.jobs.models import Job
from evaweb.jobs.selectors import job_newest
from evaweb.jobs.services import enqueue
from evaweb.lab.diagnosis.bundle import folder

log = logging.getLogger(__name__)
_NAME = re.compile(r"eva-diagnosis-\d{8}-\d{6}\.zip")


def bundle_ask(*, user: User) -> Job:
    """Enqueue a bundle with this administrator's visibility."""
    require_role(user, Role.ADMIN)
    name = f"eva-diagnosis-{timezone.now():%Y%m%d-%H%M%S}.zip"
    log.info("%a asks for the diagnostic bundle %s", user.get_username(), name)
    return enqueue(kind="diagnose", key=_key(user), args={"user": user.pk, "name": name})


def bundle_job(*, user: User) -> Job | None:
    """Return the newest bundle job of this user, or None."""
    return job_newest(key=_key(user))


def bundles(*, user: User) -> list[Path]:
    """Return this user's bundles, newest first."""
    return sorted((path for path in folder(user).iterdir() if _NAME.fullmatch(path.name)), reverse=True)


def bundle_get(*, user: User, name: str) -> Path:
    """Return a bundle of this user.

    Raises:
        NotFound: If there is none of that name.
    """
    bundle = next((path for path in bundles(user=user) if path.name == name), None)
    if bundle is None:
        raise NotFound(f"{name!r:.80} is no bundle of yours; it may have been replaced by newer ones")
    return bundle


def _key(user: User) -> str:
    return f"diagnose:{user.pk}"
