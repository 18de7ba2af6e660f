"""Enrolment of other computers as stations: one-time codes, the computers' keys, and the list of admitted keys."""

from __future__ import annotations

import logging
import socket
from datetime import timedelta
from types import MappingProxyType
from typing import Any, NamedTuple

from django.conf import settings
from django.db import transaction
from django.utils import timezone

from evaweb.accounts.roles import Role, require_role
from evaweb.core.errors import Conflict, EvaError
from evaweb.stations.models import EnrolmentCode, Station, StationKey
from runtime.link import codes, key_files
from runtime.link.admission import Allowed

log = logging.getLogger(__name__)
VALID = timedelta(minutes=15)
_EVERYWHERE = ("0.0.0.0", "::")


class Shown(NamedTuple):
    """Enrolment code with the data needed at the robot's computer; shown once, only its digest is stored."""

    code: str
    address: str
    second_port: int
    fingerprint: str
    expires_at: Any

    @property
    def command(self) -> str:
        """Command line to run on the robot's computer."""
        return f"python -m runtime.keys enrol {self.address} {self.code}"


@transaction.atomic
def code_make(*, user: Any, station: Station) -> Shown:
    """Create an enrolment code for this station and invalidate earlier ones.

    Raises: NotAllowed unless the user is an administrator; EvaError if the lab has no gate.
    """
    require_role(user, Role.ADMIN)
    if settings.EVA_GATE is None:
        raise EvaError(
            "this lab has no gate: start it with EVA_GATE=HOST:PORT, where stations are to connect"
        )
    code = codes.fresh(key_files.lab_key(settings.DATA_DIR).public)
    EnrolmentCode.objects.filter(station=station).delete()
    row = EnrolmentCode.objects.create(
        station=station, digest=codes.digest(code.secret), made_by=user, expires_at=timezone.now() + VALID
    )
    log.warning("%a has a code shown to enrol a computer as %s", user.get_username(), station.name)
    host, port = settings.EVA_GATE
    address = f"{settings.EVA_GATE_NAME or _named(host)}:{port}"
    return Shown(code.text(), address, port + 1, codes.fingerprint(code.lab), row.expires_at)


@transaction.atomic
def key_enrol(*, digest: str, key: str, computer: str) -> Station:
    """Make `key` the key of the station for which an enrolment code was made, and use up the code.

    An earlier key of the station is withdrawn. `digest` is the digest of the code, `computer` the name of the computer
    that sent it.

    Raises:
        Conflict: If the code is unknown, used or expired.
    """
    row = EnrolmentCode.objects.select_for_update().filter(digest=digest).first()
    if row is None or row.expires_at < timezone.now():
        raise Conflict(
            "this code is not known, was used, or is too old: have the administration show a new one"
        )
    station, by = row.station, row.made_by
    row.delete()
    before = station.keys.filter(withdrawn_at=None).exclude(key=key)
    before.update(withdrawn_at=timezone.now(), withdrawn="replaced by another computer or key")
    if not station.keys.filter(withdrawn_at=None, key=key).exists():
        StationKey.objects.create(station=station, key=key, computer=computer, enrolled_by=by)
    log.warning("%a is enrolled as %s, with the code of %a", computer, station.name, by.get_username())
    return station


def key_withdraw(*, user: Any, key: StationKey) -> StationKey:
    """Withdraw a computer's key; its connections are cut within a second."""
    require_role(user, Role.ADMIN)
    if key.withdrawn_at is None:
        key.withdrawn_at, key.withdrawn = timezone.now(), f"withdrawn by {user.get_username()}"
        key.save(update_fields=["withdrawn_at", "withdrawn"])
        log.warning("%a has withdrawn the key of %s", user.get_username(), key.station.name)
    return key


def keys_allowed() -> Allowed:
    """Return which keys may connect to the gate as which stations, and whether any code is valid."""
    names: dict[str, frozenset[str]] = {}
    for key, name in StationKey.objects.filter(withdrawn_at=None).values_list("key", "station__name"):
        names[key] = names.get(key, frozenset()) | {name}
    enrolling = EnrolmentCode.objects.filter(expires_at__gt=timezone.now()).exists()
    return Allowed(MappingProxyType(names), enrolling)


def _named(host: str) -> str:
    """Return the host for use in an address: this computer's name if the gate listens on all addresses."""
    if host in _EVERYWHERE:
        return socket.gethostname()
    return f"[{host}]" if ":" in host else host
