"""Addresses of the websockets."""

from __future__ import annotations

from django.urls import path

from evaweb.console.consumers import StationConsumer

websocket_urlpatterns = [path("ws/stations/<str:name>", StationConsumer.as_asgi())]
