"""Crates of other labs at this lab: import, removal, list, and when their content is hidden.

Each is kept as the zip that it came as, in DATA/crates under its SHA-256, and is never unpacked.
"""

from __future__ import annotations

import hashlib
import shutil
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

from django.contrib.auth.models import User
from django.db import transaction
from django.db.models import Q, QuerySet
from django.utils import timezone

from evaweb.accounts.roles import Role, require_role
from evaweb.blinding.visibility import Visibility
from evaweb.core.errors import Conflict, EvaError, NotAllowed, NotFound
from evaweb.episodes.folders import data_dir
from evaweb.jobs.locks import exclusive_job
from evaweb.plans.models import Plan
from evaweb.results.crates.foreign import read_foreign_crate
from evaweb.results.crates.limits import MOST_BYTES
from evaweb.results.models import ImportedCrate
from evaweb.trials.models import Checkpoint
from runtime.core.durable_files import creating_durably
from runtime.core.sentences import Pattern, fixed

_LARGEST_ALLOWED = Pattern(
    "results.crates.largest_allowed", "the crate has {count} bytes; allowed here: {most}"
)
_IN_WORK = fixed("results.crates.in_work", "this crate is being imported or removed: try again in a moment")
_IS_HERE = Pattern("results.crates.is_here", "this crate was imported already, by {user}")
_NONE_SUCH = Pattern("results.crates.none_such", "no imported crate has the SHA-256 {given:.64}")
_SEALED = Pattern(
    "results.crates.sealed",
    "a checkpoint of this crate may be compared blind here ({plans}): its results are shown after that reveal",
)
_NOT_ON_DISK = Pattern(
    "results.crates.not_on_disk", "{path} is not on this disk: remove the crate, and import it again"
)

_BLOCK = 1 << 20


def import_crate(*, user: User, file: IO[bytes], most: int = MOST_BYTES) -> ImportedCrate:
    """Check a crate, keep it and return its row; if anything is wrong, nothing is kept.

    Args:
        user: Administrator who imports it.
        file: Seekable zip.
        most: Limit of its size [bytes].

    Raises:
        NotAllowed: If the user is no administrator.
        Conflict: If it was imported already.
        EvaError: If it is too large, invalid or tampered with; the message names what.
    """
    require_role(user, Role.ADMIN)
    size = file.seek(0, 2)
    if size > most:
        raise EvaError(_LARGEST_ALLOWED(count=size, most=most))
    content = read_foreign_crate(file)
    sha256 = _digest(file)
    row = ImportedCrate(sha256=sha256, size=size, content=content, imported_by=user)
    with _alone(sha256):
        _require_new(sha256)
        path = crate_file(sha256)
        path.parent.mkdir(parents=True, exist_ok=True)
        is_new = _store_file(file, path)
        try:
            with transaction.atomic():
                row.save(force_insert=True)
        except BaseException:
            if is_new:
                path.unlink(missing_ok=True)
            raise
    return row


@contextmanager
def _alone(sha256: str) -> Iterator[None]:
    """Hold a crate during the block, so that no removal takes the file of an import. Raises: Conflict if it is held."""
    with exclusive_job(f"crate {sha256}", None) as is_held:
        if not is_held:
            raise Conflict(_IN_WORK)
        yield


def _store_file(file: IO[bytes], path: Path) -> bool:
    """Copy a crate to its place; return False if it is there, of a killed import or since a database was lost."""
    try:
        with creating_durably(path) as target:
            file.seek(0)
            shutil.copyfileobj(file, target, _BLOCK)
    except FileExistsError:
        return False
    return True


def _require_new(sha256: str) -> None:
    here = imported_crates().filter(sha256=sha256).first()
    if here is not None:
        raise Conflict(_IS_HERE(user=here.imported_by.get_username()))


def _digest(file: IO[bytes]) -> str:
    digest = hashlib.sha256()
    file.seek(0)
    while block := file.read(_BLOCK):
        digest.update(block)
    return digest.hexdigest()


def remove_crate(*, user: User, crate: ImportedCrate) -> None:
    """Remove file and content of a crate; its row records who removed it. Raises: NotAllowed; NotFound."""
    require_role(user, Role.ADMIN)
    with _alone(crate.sha256), transaction.atomic():
        changed = ImportedCrate.objects.filter(pk=crate.pk, removed_at=None).update(
            content={}, removed_by=user, removed_at=timezone.now()
        )
        if not changed:
            raise NotFound(_NONE_SUCH(given=crate.sha256))
        path = crate_file(crate.sha256)
        transaction.on_commit(lambda: path.unlink(missing_ok=True))


def crate_file(sha256: str) -> Path:
    """Return the path of an imported crate."""
    return data_dir() / "crates" / f"{sha256}.zip"


def open_crate_file(crate: ImportedCrate) -> IO[bytes]:
    """Return the opened zip of an imported crate. Raises: NotFound if it is not on this disk."""
    path = crate_file(crate.sha256)
    try:
        return path.open("rb")
    except OSError:
        raise NotFound(_NOT_ON_DISK(path=path.name)) from None


def imported_crates() -> QuerySet[ImportedCrate]:
    """Return the imported crates that were not removed, newest first."""
    return ImportedCrate.objects.filter(removed_at=None).select_related("imported_by")


def imported_crate(sha256: str) -> ImportedCrate:
    """Return an imported crate by its digest. Raises: NotFound."""
    row = imported_crates().filter(sha256=sha256).first()
    if row is None:
        raise NotFound(_NONE_SUCH(given=sha256))
    return row


def removed_crates() -> QuerySet[ImportedCrate]:
    """Return the records of removed crates, newest first."""
    return ImportedCrate.objects.exclude(removed_at=None).select_related("imported_by", "removed_by")


# --- visibility ---------------------------------------------------------------------------------------------


def hidden_crates(crates: Iterable[ImportedCrate], visibility: Visibility) -> set[int]:
    """Return the ids of the crates whose content is hidden from a user.

    A crate is hidden while a plan that is blind for the user has a checkpoint that the crate names anywhere in its
    content, or whose digest it has: its rates would tell which of the blind checkpoints is better. So is a crate of a
    plan of this lab that has such a checkpoint, whatever its name is now.
    """
    if visibility.hides_nothing:
        return set()
    digests = _digests(visibility)
    return {crate.pk for crate in crates if _names(crate.content, visibility, digests)}


def require_visible_crate(crate: ImportedCrate, visibility: Visibility) -> None:
    """Raise NotAllowed if the content of the crate is hidden from the user."""
    if hidden_crates([crate], visibility):
        raise NotAllowed(sealed_crate_reason(visibility))


def sealed_crate_reason(visibility: Visibility) -> str:
    """Return why crates are hidden; it names all blind plans, because a selection would tell what they compare."""
    return _SEALED(plans=visibility.plans)


def _digests(visibility: Visibility) -> set[str]:
    """Return the digests of the hidden checkpoints, and of all plans that have one of them."""
    digests = set(Checkpoint.objects.filter(pk__in=visibility.checkpoints).values_list("digest", flat=True))
    # Also as frozen: a checkpoint may have been changed since.
    for rows in Plan.objects.filter(pk__in=visibility.keys).values_list("document__checkpoints", flat=True):
        digests |= {row.get("digest", "") for row in rows or ()}
    own = Plan.objects.filter(Q(pk__in=visibility.keys) | Q(checkpoints__in=visibility.checkpoints))
    digests |= set(own.values_list("digest", flat=True))
    return {text.casefold() for text in digests if text}


def _names(content: dict[str, Any], visibility: Visibility, digests: set[str]) -> bool:
    stated = [
        content["seal"]["digest"],
        *(row["digest"].casefold() for row in content["plan"]["checkpoints"]),
    ]
    return bool(digests.intersection(stated)) or visibility.named_in("\n".join(_texts(content)))


def _texts(value: Any) -> Iterable[str]:
    if isinstance(value, str):
        yield value
    elif isinstance(value, dict):
        for inner in value.values():
            yield from _texts(inner)
    elif isinstance(value, list):
        for inner in value:
            yield from _texts(inner)
