"""URLs of the pages of episodes and their media."""

from __future__ import annotations

from django.urls import path

from evaweb.episodes import views

urlpatterns = [
    path("replay/", views.replay_list, name="replay-list"),
    path("replay/<uuid:uuid>/", views.replay, name="replay"),
    path("replay/<uuid:uuid>/stage", views.playback_stage, name="replay-stage"),
    path("replay/<uuid:uuid>/preview", views.preview, name="replay-preview"),
    path("episodes/<uuid:uuid>/video/<str:camera>", views.video, name="episode-video"),
    path("episodes/<uuid:uuid>/sheet/<str:camera>", views.sheet, name="episode-sheet"),
    path("episodes/<uuid:uuid>/thumbnail", views.thumbnail, name="episode-thumbnail"),
    path("episodes/<uuid:uuid>/export", views.export, name="episode-export"),
    path("episodes/<uuid:uuid>/export/<str:format>", views.export, name="episode-export"),
    path("episodes/<uuid:uuid>/export/<str:format>/state", views.export_state, name="episode-export-state"),
    path("episodes/<uuid:uuid>/curves", views.episode_curves, name="episode-curves"),
    path("episodes/<uuid:uuid>/geometry", views.episode_geometry, name="episode-geometry"),
    path("episodes/<uuid:uuid>/bench", views.episode_bench, name="episode-bench"),
    path("episodes/<uuid:uuid>/poses", views.episode_poses, name="episode-poses"),
]
