"""Geometry of stations and robots for the 3D pages."""

from __future__ import annotations

from django.http import Http404, HttpRequest, HttpResponse, JsonResponse
from django.views.decorators.http import condition, require_safe

from evaweb.core.errors import NotFound
from evaweb.stations import geometry, meshes
from evaweb.stations.selectors import station_get
from runtime.benches.schema import DEFAULT_BENCH

_A_YEAR = 365 * 24 * 3600


@require_safe
def station_geometry(request: HttpRequest, name: str) -> JsonResponse:
    """Return the scene of a station as JSON.

    A runtime that says how the objects of its simulated bench look overrides "bench".

    The query ?groups=a,b selects the joint groups with which the robot is drawn: those that its runtime reports.
    """
    try:
        station = station_get(name=name)
        bench = DEFAULT_BENCH if station.simulated else ""
        document = geometry.scene_geometry(station.robot, _groups(request), bench=bench)
    except NotFound as error:
        raise Http404(str(error)) from None
    return JsonResponse(document)


@require_safe
def robot_geometry(request: HttpRequest, robot: str) -> JsonResponse:
    """Return the scene of a robot alone as JSON.

    The robot is drawn with the joint groups in ?groups=a,b; without this query, with all groups that are not optional.
    """
    try:
        return JsonResponse(geometry.scene_geometry(robot, _groups(request)))
    except NotFound as error:
        raise Http404(str(error)) from None


def _groups(request: HttpRequest) -> list[str] | None:
    text = request.GET.get("groups", "")
    return text.split(",") if text else None


def _etag(request: HttpRequest, robot: str, digest: str) -> str:
    return f'"{digest}"'


@require_safe
@condition(etag_func=_etag)
def robot_mesh(request: HttpRequest, robot: str, digest: str) -> HttpResponse:
    """Return a mesh of a robot; the URL contains the digest, so a browser may cache it for good."""
    try:
        content = meshes.mesh_content(robot=robot, digest=digest)
    except NotFound as error:
        raise Http404(str(error)) from None
    answer = HttpResponse(content, content_type="application/octet-stream")
    answer["Cache-Control"] = f"private, max-age={_A_YEAR}, immutable"
    return answer
