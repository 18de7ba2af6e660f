"""URLs of the pages of datasets and their media; `-` ends a dataset's name, which may contain slashes."""

from __future__ import annotations

from django.urls import path

from evaweb.datasets import bag_views, replay_views, subset_views, views

_EPISODE = "replay/datasets/<path:name>/-/<int:index>"

urlpatterns = [
    path("replay/datasets/", views.dataset_list, name="dataset-list"),
    path("replay/datasets/-/work", views.dataset_work, name="dataset-work"),
    path("replay/datasets/-/ask", views.dataset_ask, name="dataset-ask"),
    path("replay/datasets/-/bags", bag_views.bag_list, name="bag-list"),
    path("replay/datasets/-/mapping", bag_views.bag_mapping, name="bag-mapping"),
    path("replay/subsets/", subset_views.subsets, name="subset-list"),
    path("replay/subsets/remove", subset_views.remove, name="subset-remove"),
    path("replay/subsets/save", subset_views.save_subset, name="subset-save"),
    path("replay/side-by-side/", replay_views.side_by_side, name="side-by-side"),
    path("replay/on-robot/", replay_views.on_robot, name="on-robot"),
    path(f"{_EPISODE}/", replay_views.replay, name="dataset-replay"),
    path(f"{_EPISODE}/video/<path:camera>", replay_views.video, name="dataset-video"),
    path(f"{_EPISODE}/picture/<path:camera>", replay_views.picture, name="dataset-picture"),
    path(f"{_EPISODE}/curves", replay_views.curves, name="dataset-curves"),
    path(f"{_EPISODE}/geometry", replay_views.geometry_json, name="dataset-geometry"),
    path(f"{_EPISODE}/poses", replay_views.poses, name="dataset-poses"),
    path(f"{_EPISODE}/segments", replay_views.segments, name="dataset-segments"),
    path("replay/datasets/<path:name>/", views.dataset, name="dataset"),
]
