"""Leases: the right to command a station, granted by the web and enforced by the station's runtime.

A lease begins when the runtime has accepted it, and ends when the runtime reports its end. The rows in the database are
the record of this. The page of the holder renews its lease continually; the renewals go to the runtime and do not touch
the database.
"""

from __future__ import annotations

from collections.abc import Mapping
from datetime import timedelta
from typing import Any
from uuid import uuid4

from django.contrib.auth import get_user_model
from django.db import transaction
from django.db.models import Max
from django.utils import timezone

from evaweb.accounts.roles import Role, require_role, role_of
from evaweb.core.errors import (
    Conflict,
    EvaError,
    NotAllowed,
    NotFound,
)
from evaweb.stations.lease_holders import holder_display_name, holder_of, with_display_names
from evaweb.stations.models import Lease, LeaseRequest, Station
from evaweb.stations.runtime_client import connection_to
from runtime.core.sentences import Pattern, fixed
from runtime.ipc import messages

_HELD_BY = Pattern(
    "stations.leases.held_by",
    "{who} has {station}: ask for it, and it can be handed over",
)
_NOBODY_HAS = Pattern("stations.leases.nobody_has", "{station} has no operator: take it")
_HELD_ALREADY = Pattern("stations.leases.held_already", "this page has {station} already")
_NOT_ASKED = Pattern(
    "stations.leases.not_asked",
    "{user} has not asked for {station}, or was answered already",
)
_ENDED_MEANWHILE = Pattern(
    "stations.leases.ended_meanwhile",
    "the lease has ended: {who} has {station} now",
)
_NO_PAGE_OF_YOURS = Pattern(
    "stations.leases.no_page_of_yours",
    "{who} has {station}, no other page of yours",
)
_TAKE_WITHOUT_REASON = fixed(
    "stations.leases.take_without_reason",
    "taking a station from someone needs a reason, which is recorded and shown",
)
_USER_SWITCHED_OFF = Pattern(
    "stations.leases.user_switched_off",
    "{user} is switched off: decline the request",
)
_SWITCHED_OFF = Pattern("stations.leases.switched_off", "{station} is switched off: {message}")
_NOT_GIVEN = Pattern("stations.leases.not_given", "{station} was not given: {why}")
_NOT_HELD = Pattern(
    "stations.leases.not_held",
    "this page does not have {station}",
)
_NO_SUCH_REQUEST = Pattern(
    "stations.leases.no_such_request",
    "request {request} for {station} does not exist",
)
_ANSWERED_ALREADY = Pattern(
    "stations.leases.answered_already",
    "the request of {user} was {answer} already",
)

_ECHO = timedelta(seconds=3)  # time for which an outdated snapshot may still arrive


def claim(*, user: Any, station: Station, page: str) -> Lease:
    """Acquire a free station, or confirm one's own lease. Raises: Conflict that names the holder."""
    require_role(user, Role.OPERATOR)
    _require_active(station)
    holder = holder_of(user.get_username(), page)
    lease = _current_lease(station)
    if lease["holder"] not in ("", holder):
        raise Conflict(_HELD_BY(who=holder_display_name(lease["holder"]), station=station))
    epoch = lease["epoch"] if lease["holder"] else _next_epoch(station, lease)
    return _grant(user, station, holder, epoch, end_reason="expired")


def renew(*, username: str, page: str, station: str, epoch: int, hidden: bool = False) -> messages.Ack:
    """Forward a page's heartbeat to the runtime, which alone decides; uses no database.

    A heartbeat of a `hidden` page counts only while nothing moves.
    """
    args = {"hidden": True} if hidden else {}
    return _send_lease_command(station, "lease_renew", holder_of(username, page), epoch, args=args)


def release(*, user: Any, station: Station, page: str) -> Lease:
    """End one's own lease; the runtime then holds an active run. Raises: Conflict if the runtime refuses."""
    lease = _own(user, station, page)
    ack = _send_lease_command(station.name, "lease_give_up", lease.holder, lease.epoch)
    if ack.status == "refused":
        raise Conflict(with_display_names(ack.reason))
    _end(lease, "given up")
    return lease


def request_handover(*, user: Any, station: Station, page: str) -> LeaseRequest:
    """Ask the holder to hand the station over; a repeated request moves to the page that repeats it."""
    require_role(user, Role.OPERATOR)
    _require_active(station)
    holder, current_holder = holder_of(user.get_username(), page), _current_lease(station)["holder"]
    if not current_holder:
        raise Conflict(_NOBODY_HAS(station=station))
    if current_holder == holder:
        raise Conflict(_HELD_ALREADY(station=station))
    request, _ = LeaseRequest.objects.update_or_create(
        station=station, user=user, answer=LeaseRequest.Answer.OPEN, defaults={"holder": holder}
    )
    return request


def withdraw_request(*, user: Any, station: Station) -> LeaseRequest:
    """Withdraw one's open request. Raises: NotFound if there is none."""
    request = LeaseRequest.objects.filter(station=station, user=user, answer=LeaseRequest.Answer.OPEN).first()
    if request is None:
        raise NotFound(_NOT_ASKED(user=user.get_username(), station=station))
    return _answered(request, LeaseRequest.Answer.WITHDRAWN)


def decline_request(*, user: Any, station: Station, page: str, request: int) -> LeaseRequest:
    """Decline a request, as the holder."""
    _own(user, station, page)
    return _answered(_open_request(station, request), LeaseRequest.Answer.DECLINED)


def hand_over(*, user: Any, station: Station, page: str, request: int) -> Lease:
    """Hand the station over to the page that requested it, as the holder; a run continues without a pause."""
    own = _own(user, station, page)
    open_request = _open_request(station, request)
    _require_commander(open_request.user)
    lease = _current_lease(station)
    if (lease["holder"], lease["epoch"]) != (own.holder, own.epoch):
        raise Conflict(
            _ENDED_MEANWHILE(who=holder_display_name(lease["holder"]) or "nobody", station=station)
        )
    epoch = _next_epoch(station, lease)
    return _grant(
        open_request.user, station, open_request.holder, epoch, f"handed over to {open_request.user}"
    )


def move(*, user: Any, station: Station, page: str) -> Lease:
    """Move one's own lease from another page to this one; a run continues without a pause.

    Raises: Conflict if the station is free or held by another user.
    """
    require_role(user, Role.OPERATOR)
    _require_active(station)
    holder, lease = holder_of(user.get_username(), page), _current_lease(station)
    if lease["holder"] == holder:
        return _grant(user, station, holder, lease["epoch"], end_reason="expired")
    if not lease["holder"].startswith(holder_of(user.get_username(), "")):
        raise Conflict(
            _NO_PAGE_OF_YOURS(who=holder_display_name(lease["holder"]) or "nobody", station=station)
        )
    return _grant(user, station, holder, _next_epoch(station, lease), "moved to another page")


def take_over(*, user: Any, station: Station, page: str, reason: str) -> Lease:
    """Take the station from its holder, as an administrator and with a reason."""
    require_role(user, Role.ADMIN)
    if not reason.strip():
        raise EvaError(_TAKE_WITHOUT_REASON)
    holder = holder_of(user.get_username(), page)
    epoch = _next_epoch(station, _current_lease(station))
    return _grant(user, station, holder, epoch, f"taken by {user.get_username()}: {reason.strip()}"[:240])


def record_snapshot_lease(*, station: Station, boot: str, held: Mapping[str, Any]) -> bool:
    """Record the lease that a snapshot of the runtime reports; return True if rows changed.

    `held` is the value of the snapshot's key "lease". Expired leases are ended in the records, and leases acquired by a
    terminal or script are added. A snapshot older than the newest row of the same boot is ignored.
    """
    holder, epoch = str(held["holder"]), int(held["epoch"])
    with transaction.atomic():
        _lock(station)
        last = station.leases.filter(ended_at=None).first()
        if last and last.boot == boot and last.epoch > epoch:
            return False
        if not holder:
            return last is not None and _end(last, _end_reason(last, boot))
        return _record(station, holder, epoch, boot, _end_reason(last, boot) if last else "")[1]


def _end_reason(lease: Lease, boot: str) -> str:
    return "expired: it was not renewed" if lease.boot == boot else "the station was restarted"


def _require_commander(user: Any) -> None:
    """Raise NotAllowed if the user who requested the lease may no longer command a station.

    Since the request, the user may have been deactivated or have become a viewer.
    """
    if not user.is_active:
        raise NotAllowed(_USER_SWITCHED_OFF(user=user.get_username()))
    require_role(user, Role.OPERATOR)


def _require_active(station: Station) -> None:
    if not station.active:
        raise NotAllowed(_SWITCHED_OFF(station=station, message=station.message or "ask an administrator"))


def _current_lease(station: Station) -> dict[str, Any]:
    """Return the lease as the runtime reports it now: holder, epoch."""
    lease: dict[str, Any] = connection_to(station.name).status()["lease"]
    return lease


def _next_epoch(station: Station, lease: Mapping[str, Any]) -> int:
    """Return an epoch above all known to runtime and database: a runtime that lost its folder starts at zero."""
    return 1 + max(int(lease["epoch"]), station.leases.aggregate(newest=Max("epoch"))["newest"] or 0)


def _send_lease_command(
    station: str,
    kind: str,
    holder: str,
    epoch: int,
    role: str = "",
    args: Mapping[str, Any] | None = None,
) -> messages.Ack:
    """Send a lease command to the runtime; renewing or ending a lease needs no role."""
    user = holder_display_name(holder)
    command = messages.Command(
        str(uuid4()), kind, args or {}, user=user, holder=holder, epoch=epoch, role=role
    )
    return connection_to(station).request(command)


def _grant(user: Any, station: Station, holder: str, epoch: int, end_reason: str) -> Lease:
    """Make the runtime accept the lease, then record it, and mark the holder's own request as granted.

    Raises: Conflict if another user was faster.
    """
    ack = _send_lease_command(station.name, "lease_claim", holder, epoch, role_of(user))
    if ack.status == "refused":
        raise Conflict(_NOT_GIVEN(station=station, why=with_display_names(ack.reason)))
    with transaction.atomic():
        _lock(station)
        lease = _record(station, holder, epoch, ack.boot, end_reason)[0]
        waiting = LeaseRequest.objects.filter(
            station=station, user=lease.user, answer=LeaseRequest.Answer.OPEN
        )
        waiting.update(answer=LeaseRequest.Answer.GRANTED, answered_at=timezone.now())
    return lease


def _record(station: Station, holder: str, epoch: int, boot: str, end_reason: str) -> tuple[Lease, bool]:
    """Open the row of this lease and end all others; return it and whether anything changed."""
    other_leases = station.leases.filter(ended_at=None).exclude(epoch=epoch)
    changed = other_leases.update(ended_at=timezone.now(), end_reason=end_reason) > 0
    lease, created = Lease.objects.get_or_create(
        station=station, epoch=epoch, defaults={"holder": holder, "boot": boot, "user": _user_of(holder)}
    )
    if created or _just_ended(lease) or (lease.ended_at, lease.holder, lease.boot) == (None, holder, boot):
        return lease, changed or created
    lease.ended_at, lease.end_reason, lease.holder, lease.boot = None, "", holder, boot
    lease.user = _user_of(holder)
    lease.save()
    return lease, True


def _just_ended(lease: Lease) -> bool:
    """Return True if the lease ended so recently that a report of it may be older than its end."""
    return lease.ended_at is not None and timezone.now() - lease.ended_at < _ECHO


def _lock(station: Station) -> None:
    """Lock the station's row, so that other writers of its leases wait until the transaction ends."""
    Station.objects.select_for_update().get(pk=station.pk)


def _user_of(holder: str) -> Any:
    users = get_user_model().objects
    return users.filter(username=holder_display_name(holder)).first() if holder.startswith("web:") else None


def _own(user: Any, station: Station, page: str) -> Lease:
    holder = holder_of(user.get_username(), page)
    lease = station.leases.filter(ended_at=None, holder=holder).first()
    if lease is None:
        raise Conflict(_NOT_HELD(station=station))
    return lease


def _open_request(station: Station, request: int) -> LeaseRequest:
    row = LeaseRequest.objects.filter(pk=request, station=station).select_related("user").first()
    if row is None:
        raise NotFound(_NO_SUCH_REQUEST(request=request, station=station))
    if row.answer != LeaseRequest.Answer.OPEN:
        raise Conflict(_ANSWERED_ALREADY(user=row.user, answer=row.get_answer_display()))
    return row


def _answered(request: LeaseRequest, answer: LeaseRequest.Answer) -> LeaseRequest:
    request.answer, request.answered_at = answer, timezone.now()
    request.save(update_fields=["answer", "answered_at"])
    return request


def _end(lease: Lease, reason: str) -> bool:
    """End the row; return True unless it had ended already."""
    lease.ended_at, lease.end_reason = timezone.now(), reason
    changed = Lease.objects.filter(pk=lease.pk, ended_at=None).update(
        ended_at=lease.ended_at, end_reason=reason
    )
    return changed > 0
