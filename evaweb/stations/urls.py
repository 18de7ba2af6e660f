"""URLs of geometry and meshes."""

from __future__ import annotations

from django.urls import path, register_converter

from evaweb.stations import views


class Digest:
    """Path converter for a SHA-256 in hexadecimal."""

    regex = "[0-9a-f]{64}"

    def to_python(self, value: str) -> str:
        """Return the value unchanged."""
        return value

    def to_url(self, value: str) -> str:
        """Return the value unchanged."""
        return value


register_converter(Digest, "digest")

urlpatterns = [
    path("stations/<str:name>/geometry", views.station_geometry, name="station-geometry"),
    path("robots/<str:robot>/geometry", views.robot_geometry, name="robot-geometry"),
    path("robots/<str:robot>/meshes/<digest:digest>", views.robot_mesh, name="robot-mesh"),
]
