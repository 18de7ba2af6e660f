"""Addresses of the pictures of plans; the converter is that of evaweb.stations."""

from __future__ import annotations

from django.urls import path

from evaweb.plans import views
from evaweb.stations import urls as _  # noqa: F401  it registers "digest"

urlpatterns = [
    path("pictures/<digest:name>.jpg", views.picture, name="picture"),
    path("references/<int:id>/", views.reference, name="reference"),
]
