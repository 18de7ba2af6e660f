"""URL patterns of the pages for setting up a lab."""

from __future__ import annotations

from django.urls import path

from evaweb.lab import views

urlpatterns = [
    path("first-account/", views.make_first_account, name="first-account"),
    path("first-steps/", views.steps, name="first-steps"),
    path("first-steps/news", views.news, name="first-steps-news"),
    path("first-steps/simulated", views.simulated, name="first-steps-simulated"),
    path("first-steps/draft", views.draft, name="first-steps-draft"),
    path("first-steps/scene", views.scene, name="first-steps-scene"),
    path("first-steps/<str:name>/deployment.toml", views.deployment, name="first-steps-deployment"),
    path("first-steps/<str:name>/check", views.check_draft, name="first-steps-check"),
    path("first-steps/<str:name>/again", views.again, name="first-steps-again"),
    path("first-steps/<str:name>/remove", views.remove, name="first-steps-remove"),
    path("first-steps/<str:name>/cameras", views.cameras, name="first-steps-cameras"),
    path("first-steps/<str:name>/cameras/<str:camera>.jpg", views.camera, name="first-steps-camera"),
    path("setup/machine/", views.machine, name="machine-check"),
    path("setup/diagnosis/", views.diagnosis, name="diagnosis"),
    path("setup/diagnosis/<str:file>", views.diagnosis_file, name="diagnosis-file"),
]
