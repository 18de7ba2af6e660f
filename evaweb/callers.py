"""Address of a caller: the other end of the connection, or what a declared proxy says it forwards."""

from __future__ import annotations

from collections.abc import Iterable
from contextvars import ContextVar
from ipaddress import IPv4Address, IPv4Network, IPv6Address, IPv6Network, ip_address, ip_network
from typing import Any

from django.conf import settings
from django.http import HttpRequest

Address = IPv4Address | IPv6Address
SHARE = ContextVar("SHARE", default="nowhere")  # `share_of` the request that is worked on
_ONE_SUBSCRIBER = 64  # bits of an address of IPv6: whoever has one has all that begin with them


def client_address(request: HttpRequest) -> str | None:
    """The address of the caller, None where there is none, as over a socket of the file system."""
    named = request.META.get("HTTP_X_FORWARDED_FOR", "").split(",")
    found = _caller(request.META.get("REMOTE_ADDR"), named, settings.EVA_PROXIES)
    return None if found is None else str(found)


def lockable_of(request: HttpRequest) -> str | None:
    """The address at which names are locked: of IPv6 the first of the network, all of which is one subscriber's."""
    found = _parsed(client_address(request))
    if isinstance(found, IPv6Address):
        return str(ip_network((found, _ONE_SUBSCRIBER), strict=False).network_address)
    return None if found is None else str(found)


def client_key(scope: dict[str, Any]) -> str:
    """From where who asks over ASGI comes, for what each of them has a share of: an address, or a network of IPv6."""
    named = [value.decode("latin-1") for name, value in scope["headers"] if name == b"x-forwarded-for"]
    peer = (scope.get("client") or [None])[0]
    found = _caller(peer, ",".join(named).split(","), settings.EVA_PROXIES)
    if isinstance(found, IPv6Address):
        return str(ip_network((found, _ONE_SUBSCRIBER), strict=False))
    return "nowhere" if found is None else str(found)


def _caller(
    peer: str | None, named: list[str], proxies: Iterable[IPv4Network | IPv6Network]
) -> Address | None:
    """The last of those named that a proxy of ours has seen itself; what stands before it any client can write."""
    here = _parsed(peer)
    while named and here is not None and any(here in network for network in proxies):
        before = _parsed(named.pop().strip())
        if before is None:
            return here
        here = before
    return here


def _parsed(text: str | None) -> Address | None:
    try:
        found = ip_address(text or "")
    except ValueError:
        return None
    if isinstance(found, IPv4Address):
        return found
    return found.ipv4_mapped or IPv6Address(int(found))  # without a zone, which no database takes
