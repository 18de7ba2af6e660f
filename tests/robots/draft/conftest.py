from __future__ import annotations

import pytest


@pytest.fixture(autouse=True)
def no_robots_of_ones_own(monkeypatch: pytest.MonkeyPatch) -> None:
    """What lies in the folders of whoever runs the tests is no part of them."""
    monkeypatch.delenv("EVA_ROBOTS", raising=False)
