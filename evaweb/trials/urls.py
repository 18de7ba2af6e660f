"""URLs of the pages of trials."""

from __future__ import annotations

from django.urls import path

from evaweb.trials import gallery_views, views

urlpatterns = [
    path("result/", views.result, name="result"),
    path("result/failures/", gallery_views.failure_gallery, name="result-failures"),
    path("result/failures.csv", gallery_views.failure_table, name="result-failures-csv"),
    path("result/failures.zip", gallery_views.failure_clips, name="result-failures-zip"),
    path("result/trials/<int:id>/", views.trial, name="result-trial"),
    path("result/trials/<int:id>/score", views.score, name="result-score"),
    path("result/trials/<int:id>/void", views.void, name="result-void"),
    path("result/trials/<int:id>/void/answer", views.void_answer, name="result-void-answer"),
]
