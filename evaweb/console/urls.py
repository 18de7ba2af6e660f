"""URL patterns of the console's pages."""

from __future__ import annotations

from django.urls import path

from evaweb.console import views, views_jobs, views_languages

urlpatterns = [
    path("", views.home, name="home"),
    path("languages/<str:code>.json", views_languages.catalogue, name="language"),
    path("jobs/", views_jobs.jobs, name="jobs"),
    path("jobs/cancel", views_jobs.job_act, {"what": "cancel"}, name="job-cancel"),
    path("jobs/repeat", views_jobs.job_act, {"what": "repeat"}, name="job-repeat"),
    path("history/", views.history, name="history"),
    path("stations/<str:name>/", views.station, name="station"),
    path("stations/<str:name>/still", views.still, name="station-still"),
    path("stations/<str:name>/debug/", views.debug, name="station-debug"),
    path("stations/<str:name>/eval/", views.evaluate, name="station-eval"),
    path("stations/<str:name>/eval/panel", views.panel, name="station-panel"),
    path("stations/<str:name>/collect/", views.collect, name="station-collect"),
    path("stations/<str:name>/collect/session", views.collect_session, name="collect-session"),
    path("stations/<str:name>/collect/progress", views.collect_progress, name="collect-progress"),
    path("stations/<str:name>/lease", views.lease, name="station-lease"),
]
