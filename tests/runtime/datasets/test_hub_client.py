"""Push and pull with the hub's own client, against a stand-in of the hub on loopback."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.runtime.datasets.foreign import Plan, write
from tests.runtime.datasets.hub_server import TOKEN, Hub, served_hub
from tests.sources import ROOT


@pytest.fixture
def hub() -> Iterator[Hub]:
    with served_hub() as served:
        yield served


def run(hub: Hub, home: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    own = {"HF_ENDPOINT": hub.url, "HF_TOKEN": TOKEN, "HF_HUB_DISABLE_XET": "1", "HF_HOME": str(home / "hub")}
    return subprocess.run(
        [sys.executable, "-m", "runtime.datasets", *arguments],
        cwd=ROOT,
        env=os.environ | own | {"HF_HUB_DISABLE_TELEMETRY": "1"},
        capture_output=True,
        text=True,
        check=False,
    )


def files(folder: Path) -> dict[str, bytes]:
    """The files of a dataset, without its lock."""
    every = (path for path in folder.rglob("*") if path.is_file() and not path.name.startswith("."))
    return {str(path.relative_to(folder)): path.read_bytes() for path in every}


def test_a_dataset_goes_to_the_hub_and_comes_back_and_again_only_what_is_new(
    hub: Hub, tmp_path: Path
) -> None:
    dataset = tmp_path / "cups"
    write(dataset, Plan("v3.0", lengths=(4, 5), videos=()))
    pushed = run(hub, tmp_path, "push", str(dataset), "lab/cups")
    assert pushed.returncode == 0, pushed.stderr
    repository = hub.repositories["lab/cups"]
    assert repository.private
    assert repository.refs["v3.0"] == repository.files
    sent = {path: data for path, data in repository.files.items() if path != "README.md"}
    assert sent == files(dataset)
    assert b"LeRobot" in repository.files["README.md"]

    pulled = run(hub, tmp_path, "pull", "lab/cups", "--to", str(tmp_path / "back"))
    assert pulled.returncode == 0, pulled.stderr
    assert files(tmp_path / "back") == repository.files

    hub.uploads.clear()
    hub.operations.clear()
    again = run(hub, tmp_path, "push", str(dataset), "lab/cups")
    assert again.returncode == 0, again.stderr
    assert (hub.uploads, hub.operations) == ([], []), "a repeated push sends nothing"

    longer = tmp_path / "longer"
    write(longer, Plan("v3.0", lengths=(4, 5, 6), videos=()))
    shutil.rmtree(dataset)
    longer.rename(dataset)
    changed = run(hub, tmp_path, "push", str(dataset), "lab/cups")
    assert changed.returncode == 0, changed.stderr
    assert {path: data for path, data in repository.files.items() if path != "README.md"} == files(dataset)
    assert repository.refs["v3.0"] == repository.files, "the tag is that of the newest push"


def test_what_the_hub_refuses_is_said_without_the_token(hub: Hub, tmp_path: Path) -> None:
    dataset = tmp_path / "cups"
    write(dataset, Plan("v3.0", lengths=(4,), videos=()))
    hub.refused.add(TOKEN)
    refused = run(hub, tmp_path, "push", str(dataset), "lab/cups")
    assert refused.returncode != 0
    assert "is not pushed to lab/cups" in refused.stderr
    assert "401" in refused.stderr
    assert TOKEN not in refused.stderr + refused.stdout
    hub.refused.clear()
    absent = run(hub, tmp_path, "pull", "lab/cups", "--to", str(tmp_path / "back"))
    assert absent.returncode != 0
    assert "lab/cups is not pulled" in absent.stderr
    assert not (tmp_path / "back").exists()
