"""Addresses of the pages of stations."""

from __future__ import annotations

from django.urls import URLPattern

urlpatterns: list[URLPattern] = []
