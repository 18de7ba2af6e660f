"""Settings of the SSH tunnel through which a checkpoint's policy server is reached."""

from __future__ import annotations

import ipaddress
import re
from typing import Annotated, Literal

from pydantic import AfterValidator, Field
from pydantic_core import PydanticCustomError

from runtime.core.host_references import HostReference
from runtime.core.settings import Settings

# Values must not begin with "-", which ssh would take for an option, nor have a meaning for a shell, which ssh itself
# starts for a jump.
_NAME = r"[A-Za-z0-9_](?:[A-Za-z0-9._-]{0,252}[A-Za-z0-9_])?"
_USER = r"[A-Za-z0-9_][A-Za-z0-9._@+-]{0,63}"
_JUMP = re.compile(rf"(?:{_USER}@)?(?P<host>{_NAME}|\[[0-9A-Fa-f:.]+\])(?::(?P<port>[0-9]{{1,5}}))?")


def is_host(name: str) -> bool:
    """Return True if `name` is nothing but a host name, an alias of ssh's configuration, or an address."""
    if re.fullmatch(_NAME, name):
        return True
    try:
        ipaddress.IPv6Address(name)
    except ValueError:
        return False
    return "%" not in name


def _host(name: str) -> str:
    if not is_host(name):
        raise ValueError(
            "must be a host's name, its address, or its alias in ssh's configuration, as in gpu-1.lab"
        )
    return name


def _user(name: str) -> str:
    if not re.fullmatch(_USER, name):
        raise ValueError("must be an account's name: letters, digits and . _ @ + -, with no - first")
    return name


def _jump(hop: str) -> str:
    match = _JUMP.fullmatch(hop)
    host = match["host"].strip("[]") if match else ""
    if not match or not is_host(host) or not 1 <= int(match["port"] or 22) <= 65535:
        raise ValueError("must be a host as in gateway.lab, user@gateway.lab or user@gateway.lab:2222")
    return hop


def _path(path: str) -> str:
    if "PRIVATE KEY" in path or "\n" in path:
        raise PydanticCustomError(
            "secret", "must be the path of a file: a key itself would end up in every recording's manifest"
        )
    if not path.startswith(("/", "~/")):
        raise ValueError("must be a path from the root or from home, as in ~/.ssh/id_lab")
    if not path.isprintable() or any(character in path for character in '"\\%$'):
        raise ValueError(
            'must be a path without " \\ % $ and control characters, which mean something to ssh'
        )
    return path


def _configuration(path: str) -> str:
    return path if path == "none" else _path(path)


File = Annotated[str, AfterValidator(_path), HostReference.FILE]


class TunnelSettings(Settings):
    """SSH tunnel to the policy server through the system's ssh; policy.url is then resolved at its far end."""

    host: Annotated[str, AfterValidator(_host)]
    """Far end of the tunnel: a name, an address, or an alias of the ssh configuration."""
    user: Annotated[str, AfterValidator(_user)] | None = None
    """Account at the far end; absent: that of the ssh configuration."""
    port: int | None = Field(default=None, ge=1, le=65535)
    """Port of the SSH server; absent: that of the ssh configuration, else 22."""
    identity_file: File | None = None
    """Path of the private key on the station's machine; no other key is then tried. Absent: the keys of the ssh
    configuration and of the agent."""
    jump: list[Annotated[str, AfterValidator(_jump)]] = Field(default_factory=list)
    """Jump hosts in their order, as user@host:port. This table's keys and host keys do not apply to them; theirs come
    from the ssh configuration."""
    host_keys: Literal["strict", "accept-new"] = "strict"
    """"strict": the host's key must be known; "accept-new": the key of an unknown host is accepted and stored. A
    changed key is always refused."""
    known_hosts_file: Annotated[str, AfterValidator(_path), HostReference.WRITTEN] | None = None
    """Path of the file with known host keys; absent: ssh's own."""
    ssh_config: Annotated[str, AfterValidator(_configuration), HostReference.FILE] | None = None
    """Path of an ssh configuration that replaces ~/.ssh/config; "none" reads none."""
    session: bool = True
    """Whether the command `cat` is run at the far end; it ends with the tunnel. Without a session OpenSSH's server
    collects its output, and responses arrive about 40 ms later; false for accounts that may not run commands."""
    alive_interval: int = Field(default=5, ge=1, le=3600)
    """Silence of the host after which it is probed [s]; after three probes without a reply the tunnel is closed and
    opened again."""
    connect_deadline: float = Field(default=10.0, ge=1, le=600)
    """Longest time for opening the tunnel [s], at set-up and whenever it is opened again."""

    @property
    def where(self) -> str:
        """Host of the far end as messages name it."""
        user, host = f"{self.user}@" if self.user else "", f"[{self.host}]" if ":" in self.host else self.host
        return f"{user}{host if self.port is None else f'{host}:{self.port}'}"
