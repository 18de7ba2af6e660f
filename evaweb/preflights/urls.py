"""URLs of the pages of preflights."""

from __future__ import annotations

from django.urls import path

from evaweb.preflights import views

urlpatterns = [
    path("preflights/newest/", views.newest, name="preflight-newest"),
    path("preflights/<uuid:id>/", views.preflight, name="preflight"),
]
