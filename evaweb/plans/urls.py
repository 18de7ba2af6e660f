"""URLs of the pictures of plans; evaweb.stations defines the `digest` converter."""

from __future__ import annotations

from django.urls import path

from evaweb.plans import views
from evaweb.stations import urls as _  # noqa: F401  it registers "digest"

urlpatterns = [
    path("pictures/<digest:name>.jpg", views.picture, name="picture"),
    path("references/<int:id>/", views.reference, name="reference"),
]
