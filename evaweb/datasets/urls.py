"""URLs of the pages of datasets and their media; `-` ends a dataset's name, which may contain slashes."""

from __future__ import annotations

from django.urls import path

from evaweb.datasets import replaying, views

_EPISODE = "replay/datasets/<path:name>/-/<int:index>"

urlpatterns = [
    path("replay/datasets/", views.dataset_list, name="dataset-list"),
    path("replay/datasets/-/work", views.dataset_work, name="dataset-work"),
    path("replay/datasets/-/ask", views.dataset_ask, name="dataset-ask"),
    path("replay/side-by-side/", replaying.side_by_side, name="side-by-side"),
    path("replay/on-robot/", replaying.on_robot, name="on-robot"),
    path(f"{_EPISODE}/", replaying.replay, name="dataset-replay"),
    path(f"{_EPISODE}/video/<path:camera>", replaying.video, name="dataset-video"),
    path(f"{_EPISODE}/picture/<path:camera>", replaying.picture, name="dataset-picture"),
    path(f"{_EPISODE}/curves", replaying.curves, name="dataset-curves"),
    path(f"{_EPISODE}/geometry", replaying.geometry_json, name="dataset-geometry"),
    path(f"{_EPISODE}/poses", replaying.poses, name="dataset-poses"),
    path(f"{_EPISODE}/segments", replaying.segments, name="dataset-segments"),
    path("replay/datasets/<path:name>/", views.dataset, name="dataset"),
]
