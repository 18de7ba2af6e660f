"""ASGI application that daphne serves: pages and REST over HTTP, live stations over websockets."""

from __future__ import annotations

import os

os.environ.setdefault("DJANGO_SETTINGS_MODULE", "evaweb.settings")

from django.core.asgi import get_asgi_application

http = get_asgi_application()  # sets up the apps, so it precedes all imports of models

from channels.routing import ProtocolTypeRouter, URLRouter
from channels.security.websocket import AllowedHostsOriginValidator
from channels.sessions import CookieMiddleware
from django.conf import settings

from evaweb.api.stop_gateway import StopGateway
from evaweb.console.routing import websocket_urlpatterns
from evaweb.serving.origins import SameOrigin
from evaweb.serving.request_limiter import RequestLimiter
from evaweb.serving.static_files import StaticFiles

application = ProtocolTypeRouter(
    {
        "http": StopGateway(StaticFiles(RequestLimiter(http), settings.STATIC_DIGEST)),
        "websocket": SameOrigin(
            AllowedHostsOriginValidator(CookieMiddleware(URLRouter(websocket_urlpatterns)))
        ),
    }
)
