"""Address of a client: the peer of the connection, or the one that a declared proxy forwards."""

from __future__ import annotations

from collections.abc import Iterable
from contextvars import ContextVar
from ipaddress import IPv4Address, IPv4Network, IPv6Address, IPv6Network, ip_address, ip_network
from typing import Any

from django.conf import settings
from django.http import HttpRequest

Address = IPv4Address | IPv6Address
SHARE = ContextVar("SHARE", default="nowhere")  # `client_key` of the current request
_ONE_SUBSCRIBER = 64  # prefix of IPv6 addresses that belong to one subscriber [bits]


def client_address(request: HttpRequest) -> str | None:
    """Return the address of the client, None if there is none, as over a Unix socket."""
    named = request.META.get("HTTP_X_FORWARDED_FOR", "").split(",")
    address = _caller(request.META.get("REMOTE_ADDR"), named, settings.EVA_PROXIES)
    return None if address is None else str(address)


def lockable_of(request: HttpRequest) -> str | None:
    """Return the address for which a user name is locked after failed logins; None if it is unknown.

    For IPv6 this is the network address of the subscriber's /64.
    """
    address = _parsed(client_address(request))
    if isinstance(address, IPv6Address):
        return str(ip_network((address, _ONE_SUBSCRIBER), strict=False).network_address)
    return None if address is None else str(address)


def client_key(scope: dict[str, Any]) -> str:
    """Return the key by which ASGI clients share limits: an address, an IPv6 /64 network, or "nowhere"."""
    named = [value.decode("latin-1") for name, value in scope["headers"] if name == b"x-forwarded-for"]
    peer = (scope.get("client") or [None])[0]
    address = _caller(peer, ",".join(named).split(","), settings.EVA_PROXIES)
    if isinstance(address, IPv6Address):
        return str(ip_network((address, _ONE_SUBSCRIBER), strict=False))
    return "nowhere" if address is None else str(address)


def _caller(
    peer: str | None, named: list[str], proxies: Iterable[IPv4Network | IPv6Network]
) -> Address | None:
    """Return the client's address: `peer`, unless that is a trusted proxy.

    `named` are the forwarded addresses of the request: each proxy appends the address from which it got the request.
    The list is read from its end, as long as the address just read is a trusted proxy's. The entries that are left are
    ignored, because any client can invent them.
    """
    address = _parsed(peer)
    while named and address is not None and any(address in network for network in proxies):
        before = _parsed(named.pop().strip())
        if before is None:
            return address
        address = before
    return address


def _parsed(text: str | None) -> Address | None:
    try:
        address = ip_address(text or "")
    except ValueError:
        return None
    if isinstance(address, IPv4Address):
        return address
    return address.ipv4_mapped or IPv6Address(int(address))  # without a zone id, which no database accepts
