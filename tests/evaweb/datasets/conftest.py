"""Datasets in a data folder that each test has for itself."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from django.test import Client

from evaweb.jobs import doorbell
from tests.evaweb.conftest import person
from tests.runtime.datasets.foreign import Plan, write
from tests.runtime.datasets.small import record

Foreign = Callable[..., Path]


@pytest.fixture
def data(settings: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, db: None) -> Path:
    """The data folder of this test; no broker hears of its jobs."""
    settings.DATA_DIR = tmp_path
    monkeypatch.setattr(doorbell, "notify_workers", lambda queue: True)
    return tmp_path


@pytest.fixture
def foreign(data: Path) -> Foreign:
    """Make a dataset of somebody else; returns its folder."""

    def make(name: str = "cups", **plan: Any) -> Path:
        folder = data / "datasets" / name
        write(folder, Plan(**{"lengths": (6, 8, 7), "fps": 10.0, "gop": 3, "b_frames": 0, **plan}))
        return folder

    return make


@pytest.fixture
def journal(data: Path) -> Callable[..., Path]:
    """Record an episode with a small robot; returns its folder."""

    def make(**changes: Any) -> Path:
        return record(data / "episodes", **changes)

    return make


@pytest.fixture
def browser(client: Client, data: Path) -> Client:
    """Of an administrator."""
    client.force_login(person("alma", "operator", "admin"))
    return client


@pytest.fixture
def operator(client: Client, data: Path) -> Client:
    client.force_login(person("ann", "operator"))
    return client
