"""Address of a station's panel, read from the resolved deployment without loading anything that it names."""

from __future__ import annotations

import json
import re
import ssl
from dataclasses import dataclass
from ipaddress import ip_address
from pathlib import Path

from runtime.core.errors import ConfigurationError

_HOST = re.compile(r"([a-z0-9.-]+|\[[0-9a-f:.]+\])(?::\d{1,5})?")


@dataclass(frozen=True, slots=True)
class PanelPlace:
    """Address of the panel: address, port, host names in lower case, and the certificate's files, "" without TLS."""

    host: str
    port: int
    names: frozenset[str] = frozenset()
    certificate: str = ""
    key: str = ""

    @property
    def scheme(self) -> str:
        return "https" if self.certificate else "http"

    def context(self) -> ssl.SSLContext | None:
        """Return the TLS context, None without a certificate. Raises: ConfigurationError if its files are invalid."""
        if not self.certificate:
            return None
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        context.minimum_version = ssl.TLSVersion.TLSv1_2
        self.load(context)
        return context

    def load(self, context: ssl.SSLContext) -> None:
        """Load certificate and key into `context`; also used after a renewal. Raises: ConfigurationError."""
        try:
            context.load_cert_chain(self.certificate, self.key)
        except (OSError, ssl.SSLError) as error:
            raise ConfigurationError(
                f"panel.certificate = {self.certificate!r}, panel.key = {self.key!r}: {error}"
            ) from None

    @property
    def written(self) -> tuple[int, ...]:
        """Modification times of the certificate's files, which change with a renewal."""
        files = [Path(name) for name in (self.certificate, self.key) if name]
        return tuple(file.stat().st_mtime_ns for file in files if file.exists())

    def knows(self, host: str) -> bool:
        """Return True if the Host header is one of the panel's names or a numeric address.

        A page that reaches the panel through DNS rebinding sends its own name.
        """
        match = _HOST.fullmatch(host.strip().lower())
        if match is None:
            return False
        name = match[1].rstrip(".")
        if name in ("localhost", *self.names):
            return True
        try:
            ip_address(name.strip("[]"))
        except ValueError:
            return False
        return True


def place_of(station_dir: Path) -> PanelPlace:
    """Return the panel's address from the deployment of a station that runs or has run.

    Raises:
        ConfigurationError: The station is unknown or its deployment has no panel.
    """
    path = station_dir / "resolved.json"
    try:
        fields = json.loads(path.read_text("utf-8"))["panel"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ConfigurationError(
            f"station {station_dir.name!r} is not known here ({path}: {error.__class__.__name__}); start it "
            "with python -m runtime DEPLOYMENT, or name another data folder"
        ) from None
    if fields is None:
        raise ConfigurationError(f"the deployment of {station_dir.name!r} has no [panel]: add one")
    names = frozenset(name.lower() for name in fields["names"])
    files = fields["certificate"] or "", fields["key"] or ""
    return PanelPlace(fields["host"], fields["port"], names, *files)
