"""What pages draw of a station and of a robot."""

from __future__ import annotations

from django.http import Http404, HttpRequest, JsonResponse

from evaweb.errors import NotFound
from evaweb.stations import geometry
from evaweb.stations.selectors import station_get


def station_geometry(request: HttpRequest, name: str) -> JsonResponse:
    """The scene of a station."""
    try:
        station = station_get(name=name)
        return JsonResponse(geometry.geometry(station.robot, simulated=station.simulated))
    except NotFound as error:
        raise Http404(str(error)) from None


def robot_geometry(request: HttpRequest, robot: str) -> JsonResponse:
    """The scene of a robot by itself."""
    try:
        return JsonResponse(geometry.geometry(robot, simulated=False))
    except NotFound as error:
        raise Http404(str(error)) from None
