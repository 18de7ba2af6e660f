"""Command line of a tunnel, as a list of arguments without a shell."""

from __future__ import annotations

import math
import os
from urllib.parse import urlsplit

from runtime.core.errors import ConfigurationError
from runtime.policies.connection import Place
from runtime.policies.tunnel.settings import TunnelSettings, is_host

_USUAL_PORTS = {"ws": 80, "wss": 443}
# Runs until its input ends, in every shell, and echoes it.
_ECHO = "cat"
# No prompts, and nothing but the one forwarding; these options precede ssh's configuration.
_ALWAYS = (
    "BatchMode=yes",
    "NumberOfPasswordPrompts=0",
    "ExitOnForwardFailure=yes",
    "ControlMaster=no",  # a master connection belongs to others, and the tunnel would end with it
    "ControlPath=none",
    "PermitLocalCommand=no",
    "RemoteCommand=none",
    "UpdateHostKeys=no",
    "TCPKeepAlive=yes",
    "ServerAliveCountMax=3",
    "ConnectionAttempts=1",
    "LogLevel=INFO",  # below that, refusals of the far end are not reported
)


def far_end(url: str) -> Place:
    """Return host and port of a policy server, as the machine at the far end of the tunnel resolves them.

    Raises ConfigurationError if the url has no valid host and port.
    """
    try:
        parts = urlsplit(url)
        host, port = parts.hostname or "", parts.port or _USUAL_PORTS.get(parts.scheme, 0)
    except ValueError as error:
        raise ConfigurationError(f"policy.url = {url!r}: {error}; allowed: SCHEME://HOST:PORT") from None
    if not is_host(host) or not port:
        raise ConfigurationError(
            f"policy.url = {url!r} has no host and port that a tunnel could lead to; allowed: SCHEME://HOST:PORT as "
            "they are seen from policy.tunnel.host"
        )
    return host, port


def command(ssh: str, settings: TunnelSettings, port: int, far: Place) -> list[str]:
    """Return the arguments of ssh that forward `port` of the loopback to `far`."""
    options = [
        *_ALWAYS,
        f"StrictHostKeyChecking={'yes' if settings.host_keys == 'strict' else 'accept-new'}",
        f"ServerAliveInterval={settings.alive_interval}",
        f"ConnectTimeout={math.ceil(settings.connect_deadline)}",
    ]
    if settings.known_hosts_file is not None:
        options.append(f'UserKnownHostsFile="{_at_home(settings.known_hosts_file)}"')
    arguments = [ssh, "-T", "-a", "-x"]
    if not settings.session:
        arguments += ["-N", "-n"]
    if settings.ssh_config is not None:
        arguments += ["-F", _at_home(settings.ssh_config)]
    for option in options:
        arguments += ["-o", option]
    if settings.user is not None:
        arguments += ["-l", settings.user]
    if settings.port is not None:
        arguments += ["-p", str(settings.port)]
    if settings.identity_file is not None:
        arguments += ["-i", _at_home(settings.identity_file), "-o", "IdentitiesOnly=yes"]
    if settings.jump:
        arguments += ["-J", ",".join(settings.jump)]
    host = f"[{far[0]}]" if ":" in far[0] else far[0]
    arguments += ["-L", f"127.0.0.1:{port}:{host}:{far[1]}", "--", settings.host]
    return [*arguments, _ECHO] if settings.session else arguments


def require_files(settings: TunnelSettings) -> None:
    """Raise ConfigurationError if a file in the settings cannot be read: ssh would start without it and fail later."""
    files = ("identity_file", "known_hosts_file", "ssh_config")
    for name in files:
        value = getattr(settings, name)
        # The file of known hosts may not exist yet.
        if value in (None, "none") or (name == "known_hosts_file" and settings.host_keys == "accept-new"):
            continue
        path = _at_home(value)
        if not os.path.isfile(path):
            raise ConfigurationError(
                f"policy.tunnel.{name} = {value!r}: there is no such file on this machine"
            )
        if not os.access(path, os.R_OK):
            raise ConfigurationError(
                f"policy.tunnel.{name} = {value!r} cannot be read by this station's account"
            )


def _at_home(path: str) -> str:
    return os.path.expanduser(path)
