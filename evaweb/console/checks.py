"""System check for the third-party scripts of the pages."""

from __future__ import annotations

from typing import Any

from django.contrib.staticfiles import finders
from django.core.checks import CheckMessage, Warning, register

_WANTED = {"uplot/uPlot.iife.min.js": "curves", "meshcat/main.min.js": "the 3D scene"}


@register()
def check_third_party_scripts(**options: Any) -> list[CheckMessage]:
    """Return a warning for each third-party script that is not found among the static files."""
    return [
        Warning(
            f"{script} is absent: pages are shown without {feature}",
            hint="make setup brings it",
            id=f"console.W{number:03}",
        )
        for number, (script, feature) in enumerate(_WANTED.items(), 1)
        if finders.find(script) is None
    ]
