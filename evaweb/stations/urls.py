"""Addresses of what pages draw of stations."""

from __future__ import annotations

from django.urls import path

from evaweb.stations import views

urlpatterns = [
    path("stations/<str:name>/geometry", views.station_geometry, name="station-geometry"),
    path("robots/<str:robot>/geometry", views.robot_geometry, name="robot-geometry"),
]
