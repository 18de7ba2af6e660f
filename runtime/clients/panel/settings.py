"""Where a station's panel listens: as the deployment says, read without any of what that names."""

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
    """Address, port, names of hosts in lower case, and the files of a certificate, "" without."""

    host: str
    port: int
    names: frozenset[str] = frozenset()
    certificate: str = ""
    key: str = ""

    @property
    def scheme(self) -> str:
        return "https" if self.certificate else "http"

    def context(self) -> ssl.SSLContext | None:
        """For TLS, None without; ConfigurationError where its files are of no use."""
        if not self.certificate:
            return None
        made = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        made.minimum_version = ssl.TLSVersion.TLSv1_2
        self.load(made)
        return made

    def load(self, context: ssl.SSLContext) -> None:
        """Read certificate and key, also anew; raises ConfigurationError."""
        try:
            context.load_cert_chain(self.certificate, self.key)
        except (OSError, ssl.SSLError) as error:
            raise ConfigurationError(
                f"panel.certificate = {self.certificate!r}, panel.key = {self.key!r}: {error}"
            ) from None

    @property
    def written(self) -> tuple[int, ...]:
        """When the files of the certificate were written: others where it was renewed."""
        files = [Path(name) for name in (self.certificate, self.key) if name]
        return tuple(file.stat().st_mtime_ns for file in files if file.exists())

    def knows(self, host: str) -> bool:
        """True if a browser that says this Host came by one of the panel's own names, or by an address in numbers.

        A page of another name that is made to lead here (DNS rebinding) says that other name.
        """
        said = _HOST.fullmatch(host.strip().lower())
        if said is None:
            return False
        name = said[1].rstrip(".")
        if name in ("localhost", *self.names):
            return True
        try:
            ip_address(name.strip("[]"))
        except ValueError:
            return False
        return True


def place_of(station_dir: Path) -> PanelPlace:
    """What the deployment of the station that runs, or ran, says; ConfigurationError where it says nothing."""
    path = station_dir / "resolved.json"
    try:
        said = json.loads(path.read_text("utf-8"))["panel"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ConfigurationError(
            f"station {station_dir.name!r} is not known here ({path}: {error.__class__.__name__}); start it "
            "with python -m runtime DEPLOYMENT, or name another data folder"
        ) from None
    if said is None:
        raise ConfigurationError(f"the deployment of {station_dir.name!r} has no [panel]: add one")
    names = frozenset(name.lower() for name in said["names"])
    files = said["certificate"] or "", said["key"] or ""
    return PanelPlace(said["host"], said["port"], names, *files)
