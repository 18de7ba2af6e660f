"""Queries on stations, leases and commands."""

from __future__ import annotations

from uuid import UUID

from django.db.models import QuerySet

from evaweb.errors import NotFound
from evaweb.refusals import is_text
from evaweb.stations.models import NOT_CARRIED_OUT, Command, Lease, LeaseRequest, Station
from runtime.core.sentences import Pattern

_NO_SUCH_STATION = Pattern(
    "stations.selectors.no_such_station",
    "station {name!r:.80} does not exist; there are: {known}",
)


def station_list(*, all_of_them: bool = False) -> QuerySet[Station]:
    """The stations that are offered to operators, or all."""
    return Station.objects.all() if all_of_them else Station.objects.filter(active=True)


def station_get(*, name: str) -> Station:
    """The station of that name; NotFound lists those that there are."""
    found = Station.objects.filter(name=name).first() if is_text(name) else None
    if found is None:
        known = ", ".join(Station.objects.values_list("name", flat=True)) or "none yet"
        raise NotFound(_NO_SUCH_STATION(name=name, known=known))
    return found


def lease_open(*, station: Station) -> Lease | None:
    """Open lease of the station, as far as the database knows."""
    return station.leases.filter(ended_at=None).select_related("user").first()


def leases_open() -> dict[int, Lease]:
    """Open leases by the station's id, as far as the database knows."""
    return {lease.station_id: lease for lease in Lease.objects.filter(ended_at=None).select_related("user")}


def request_list(*, station: Station) -> QuerySet[LeaseRequest]:
    """Open requests for the station, the oldest first."""
    return station.lease_requests.filter(answer=LeaseRequest.Answer.OPEN).select_related("user")


def command_list(*, station: Station, limit: int = 100) -> QuerySet[Command]:
    """The newest commands first."""
    return station.commands.select_related("user")[:limit]


def last_set_up(*, station: Station) -> UUID | None:
    """The newest set-up of the station that may have been carried out."""
    asked = station.commands.filter(kind="setup").exclude(status__in=NOT_CARRIED_OUT)
    return asked.order_by("-issued_at").values_list("pk", flat=True).first()
