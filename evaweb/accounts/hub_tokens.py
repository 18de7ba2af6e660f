"""Tokens of people for the Hugging Face hub, and whose account a push or pull uses.

A token is stored encrypted, and leaves this module only for the job that its person ordered. It is never shown. The key
is derived from the lab's secret key and from a file of the data folder that is in no backup: neither the database nor a
backup suffices to decrypt it.
"""

from __future__ import annotations

import base64
import logging
import re
import secrets
from dataclasses import dataclass
from datetime import datetime
from enum import StrEnum
from pathlib import Path
from typing import Any

from cryptography.fernet import Fernet, InvalidToken
from cryptography.hazmat.primitives.hashes import SHA256
from cryptography.hazmat.primitives.kdf.hkdf import HKDF
from django.conf import settings
from django.contrib.auth import get_user_model
from django.db.models.functions import Now
from django.views.decorators.debug import sensitive_variables
from pydantic import SecretStr

from evaweb.accounts.models import HubToken
from evaweb.core.environment import HUB_KEY
from evaweb.core.errors import Conflict, EvaError, NotAllowed
from runtime.core.durable_files import create_durably, write_durably
from runtime.core.sentences import Pattern, fixed

log = logging.getLogger(__name__)
_NOT_A_TOKEN = fixed(
    "accounts.hub_tokens.not_a_token",
    "this is no token of Hugging Face, and nothing was saved; allowed: a user access token, hf_ and 16 to 200 letters "
    "and digits",
)
_NONE = fixed(
    "accounts.hub_tokens.none",
    "you have no Hugging Face token here, and this lab lends none: enter yours under Your account",
)
_UNREADABLE = Pattern(
    "accounts.hub_tokens.unreadable",
    "the Hugging Face token of {user} was stored with another key of this lab and cannot be read any more: enter it "
    "again under Your account, or remove it there",
)
_REMOVED = Pattern(
    "accounts.hub_tokens.removed",
    "{user} ordered this with a Hugging Face token that was removed meanwhile: enter one under Your account, and order "
    "it again",
)
_SWITCHED_OFF = Pattern(
    "accounts.hub_tokens.switched_off",
    "{user} ordered this, and that account is switched off: another administrator has to order it",
)
_UNKNOWN_PERSON = fixed(
    "accounts.hub_tokens.unknown_person",
    "the account of the person who ordered this does not exist any more: another administrator has to order it",
)
_NOT_LENT = fixed(
    "accounts.hub_tokens.not_lent",
    "this was ordered with the lab's account on the hub, which EVA_HUB_LAB_ACCOUNT does not lend: enter your own token "
    "under Your account, and order it again",
)

_FORM = re.compile(r"hf_[A-Za-z0-9_]{16,200}")  # removed from diagnostic bundles by its beginning
_KEY_BYTES = 32


class HubAccount(StrEnum):
    """Account on the hub that a push or pull uses."""

    OWN = "own"  # of the person who orders it
    LAB = "lab"  # the login of the hub's client in the worker's environment


@dataclass(frozen=True, slots=True)
class HubLogin:
    """What a person may know of their login at the hub; `account` is None if a push or pull would be refused.

    `ending` has the last characters of their token, "" if there is none; `is_readable` is False if it cannot be
    decrypted any more.
    """

    account: HubAccount | None
    ending: str = ""
    entered_at: datetime | None = None
    is_readable: bool = True


@sensitive_variables()
def store_hub_token(*, user: Any, text: str) -> None:
    """Store a person's token in place of an earlier one. Raises: EvaError, which does not contain it, if malformed."""
    token = text.strip()
    if not _FORM.fullmatch(token):
        raise EvaError(_NOT_A_TOKEN)
    encrypted = _cipher(user.pk, _key()).encrypt(token.encode()).decode()
    fields = {"encrypted": encrypted, "ending": token[-4:], "entered_at": Now()}
    HubToken.objects.update_or_create(user=user, defaults=fields)
    log.info("%a has entered a Hugging Face token", user.get_username())


def remove_hub_token(*, user: Any) -> bool:
    """Delete a person's token; return False if there was none."""
    deleted, _ = HubToken.objects.filter(user=user).delete()
    if deleted:
        log.info("the Hugging Face token of %a is removed", user.get_username())
    return bool(deleted)


def describe_hub_login(user: Any) -> HubLogin:
    """Return whose account a push or pull of this person uses, without their token."""
    row = HubToken.objects.filter(user=user).first()
    if row is None:
        return HubLogin(HubAccount.LAB if settings.EVA_HUB_LAB_ACCOUNT else None)
    is_readable = _decrypt(row) is not None
    return HubLogin(HubAccount.OWN if is_readable else None, row.ending, row.entered_at, is_readable)


def choose_hub_account(user: Any) -> HubAccount:
    """Return whose account an order of this person uses.

    Raises: Conflict if they have no token and the lab lends none, or if theirs cannot be read any more.
    """
    login = describe_hub_login(user)
    if login.account is None:
        raise Conflict(_NONE if login.is_readable else _UNREADABLE(user=user.get_username()))
    return login.account


@sensitive_variables("token")
def load_hub_token(*, person: int | None, account: str) -> tuple[SecretStr | None, str]:
    """Return the token for an order of the person with this primary key, and their name.

    The token is None, and the name "", if it uses the lab's account. `person` is None for an order of an earlier
    version, which named nobody.

    Raises:
        NotAllowed: If the person is switched off, or the lab does not lend its account any more.
        Conflict: If their token was removed meanwhile, or cannot be read any more.
    """
    if person is not None:
        user: Any = get_user_model().objects.filter(pk=person).first()
        if user is None:
            raise NotAllowed(_UNKNOWN_PERSON)
        if not user.is_active:
            raise NotAllowed(_SWITCHED_OFF(user=user.get_username()))
        if account != HubAccount.LAB:
            row = HubToken.objects.filter(user=user).first()
            if row is None:
                raise Conflict(_REMOVED(user=user.get_username()))
            token = _decrypt(row)
            if token is None:
                raise Conflict(_UNREADABLE(user=user.get_username()))
            return token, user.get_username()
    if not settings.EVA_HUB_LAB_ACCOUNT:
        raise NotAllowed(_NOT_LENT)
    return None, ""


@sensitive_variables()
def _decrypt(row: HubToken) -> SecretStr | None:
    """Return the token; None if the key of the lab, or its file, is not that with which it was encrypted."""
    key = _read_key()
    if key is None:
        return None
    try:
        return SecretStr(_cipher(row.user_id, key).decrypt(row.encrypted.encode()).decode())
    except InvalidToken:
        return None


def _cipher(person: int, key: bytes) -> Fernet:
    """Return the cipher of one person: a row that is copied to another person cannot be decrypted."""
    derived = HKDF(SHA256(), 32, salt=key, info=b"evaweb hub token of person %d" % person)
    return Fernet(base64.urlsafe_b64encode(derived.derive(settings.SECRET_KEY.encode())))


def _path() -> Path:
    return Path(settings.DATA_DIR) / HUB_KEY


def _read_key() -> bytes | None:
    try:
        key = _path().read_bytes()
    except FileNotFoundError:
        return None
    return key if len(key) == _KEY_BYTES else None


def _key() -> bytes:
    """Return the content of the key's file, which is made if it is absent, and replaced if it is damaged."""
    if (key := _read_key()) is not None:
        return key
    fresh = secrets.token_bytes(_KEY_BYTES)
    create_durably(_path(), fresh, 0o600)
    if (key := _read_key()) is not None:  # that of a process that was faster, if there was one
        return key
    write_durably(_path(), fresh, 0o600)
    return fresh
