"""Addresses of the pages of trials."""

from __future__ import annotations

from django.urls import URLPattern

urlpatterns: list[URLPattern] = []
