"""Queries on stations, leases and commands."""

from __future__ import annotations

from uuid import UUID

from django.db.models import QuerySet

from evaweb.core.errors import NotFound
from evaweb.serving.error_pages import is_text
from evaweb.stations.models import NOT_CARRIED_OUT, Lease, LeaseRequest, Station
from runtime.core.sentences import Pattern

_NO_SUCH_STATION = Pattern(
    "stations.selectors.no_such_station",
    "station {name!r:.80} does not exist; there are: {known}",
)


def station_list(*, all_of_them: bool = False) -> QuerySet[Station]:
    """Return the active stations, or all."""
    return Station.objects.all() if all_of_them else Station.objects.filter(active=True)


def station_get(*, name: str) -> Station:
    """Return the station of that name. Raises: NotFound, which lists the existing ones."""
    station = Station.objects.filter(name=name).first() if is_text(name) else None
    if station is None:
        names = ", ".join(Station.objects.values_list("name", flat=True)) or "none yet"
        raise NotFound(_NO_SUCH_STATION(name=name, known=names))
    return station


def lease_open(*, station: Station) -> Lease | None:
    """Return the station's open lease according to the database, None if there is none."""
    return station.leases.filter(ended_at=None).select_related("user").first()


def leases_open() -> dict[int, Lease]:
    """Return the open leases by station id, according to the database."""
    return {lease.station_id: lease for lease in Lease.objects.filter(ended_at=None).select_related("user")}


def request_list(*, station: Station) -> QuerySet[LeaseRequest]:
    """Return the open requests for the station, oldest first."""
    return station.lease_requests.filter(answer=LeaseRequest.Answer.OPEN).select_related("user")


def last_set_up(*, station: Station) -> UUID | None:
    """Return the uuid of the newest set-up that may have been carried out, None if there is none."""
    setups = station.commands.filter(kind="setup").exclude(status__in=NOT_CARRIED_OUT)
    return setups.order_by("-issued_at").values_list("pk", flat=True).first()
