"""URL patterns of the pages for setting up a lab."""

from __future__ import annotations

from django.urls import path

from evaweb.setup import views

urlpatterns = [
    path("setup/", views.hub, name="setup"),
    path("setup/scenes/", views.scenes, name="setup-scenes"),
    path("setup/new-scene/", views.new_scene, name="setup-new-scene"),
    path("setup/scene-preview", views.preview, name="setup-preview"),
    path("setup/scenes/<str:name>/", views.scene, name="setup-scene"),
    path("setup/scenes/<str:name>/sheet/", views.sheet, name="setup-sheet"),
    path("setup/live/<str:name>/<str:camera>.jpg", views.live, name="setup-live"),
]
