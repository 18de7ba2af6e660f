"""URL patterns of the websockets."""

from __future__ import annotations

from django.urls import path, re_path

from evaweb.console.consumers import StationConsumer, UnknownAddressConsumer

websocket_urlpatterns = [
    path("ws/stations/<str:name>", StationConsumer.as_asgi()),
    re_path("", UnknownAddressConsumer.as_asgi()),
]
