"""The doorbell goes through the filesystem, and may fail."""

from __future__ import annotations

from pathlib import Path

import pytest

from evaweb.celery import app
from evaweb.jobs import doorbell


@pytest.fixture
def broker(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder for the broker that only this test uses."""
    options = {
        "data_folder_in": str(tmp_path / "queue"),
        "data_folder_out": str(tmp_path / "queue"),
        "control_folder": str(tmp_path / "control"),
    }
    for folder in ("queue", "control"):
        (tmp_path / folder).mkdir()
    monkeypatch.setitem(app.conf, "broker_transport_options", options)
    monkeypatch.setattr(app, "_pool", None)
    monkeypatch.setattr(app.amqp, "_producer_pool", None)
    return tmp_path


def test_it_leaves_a_message_for_its_queue(broker: Path) -> None:
    assert doorbell.notify_workers("bench-1") is True
    (message,) = (broker / "queue").iterdir()
    assert message.name.endswith(".bench-1.msg")


def test_a_broker_that_cannot_be_written_is_no_error_of_who_asks(
    broker: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (broker / "queue").rmdir()
    (broker / "queue").write_text("in the way")
    assert doorbell.notify_workers("lab") is False
    assert "no doorbell for queue lab, a worker finds its jobs within seconds" in caplog.text


def test_what_it_names_is_a_task_that_workers_know() -> None:
    app.loader.import_default_modules()
    assert doorbell.TASK in app.tasks
