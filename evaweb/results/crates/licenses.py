"""Licences under which results can be published, by their SPDX identifiers."""

from __future__ import annotations

from evaweb.core.errors import EvaError
from runtime.core.sentences import Pattern

_LICENSE_ALLOWED = Pattern("results.crates.license_allowed", "license = {given!r:.60}; allowed: {allowed}")

LICENSES = {
    "CC-BY-4.0": "Creative Commons Attribution 4.0 International",
    "CC0-1.0": "Creative Commons Zero v1.0 Universal",
    "CC-BY-SA-4.0": "Creative Commons Attribution Share Alike 4.0 International",
    "CC-BY-ND-4.0": "Creative Commons Attribution No Derivatives 4.0 International",
    "CC-BY-NC-4.0": "Creative Commons Attribution Non Commercial 4.0 International",
    "CC-BY-NC-SA-4.0": "Creative Commons Attribution Non Commercial Share Alike 4.0 International",
    "CC-BY-NC-ND-4.0": "Creative Commons Attribution Non Commercial No Derivatives 4.0 International",
    "CDLA-Permissive-2.0": "Community Data License Agreement Permissive 2.0",
    "ODC-By-1.0": "Open Data Commons Attribution License v1.0",
    "ODbL-1.0": "Open Data Commons Open Database License v1.0",
    "PDDL-1.0": "Open Data Commons Public Domain Dedication & License 1.0",
    "Apache-2.0": "Apache License 2.0",
    "MIT": "MIT License",
}
"""Names of the licences by SPDX identifier."""


def license_address(identifier: str) -> str:
    """Return the address of a licence in the SPDX list."""
    return f"https://spdx.org/licenses/{identifier}"


def require_license(identifier: str) -> None:
    """Raise EvaError, with the allowed ones, if no licence has this identifier."""
    if identifier not in LICENSES:
        raise EvaError(_LICENSE_ALLOWED(given=identifier, allowed=", ".join(LICENSES)))
