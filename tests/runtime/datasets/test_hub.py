"""Pushing to the hub, with a client that writes down what it is asked for: the real hub is never reached."""

from __future__ import annotations

import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from runtime.core.errors import RecordingError
from runtime.datasets import hub
from runtime.datasets.__main__ import main
from tests.runtime.datasets.foreign import Plan, write


class Client:
    """Stands for the hub's own client."""

    def __init__(self) -> None:
        self.asked: list[tuple[str, dict[str, Any]]] = []
        self.refuses = ""

    def create_repo(self, name: str, **given: Any) -> str:
        if self.refuses:
            raise OSError(self.refuses)
        self.asked.append(("create", {"name": name, **given}))
        return f"hub of datasets, {name}"

    def upload_folder(self, **given: Any) -> None:
        self.asked.append(("upload", given))

    def create_tag(self, name: str, **given: Any) -> None:
        self.asked.append(("tag", {"name": name, **given}))


@pytest.fixture
def client(monkeypatch: pytest.MonkeyPatch) -> Client:
    made = Client()
    monkeypatch.setitem(sys.modules, "huggingface_hub", SimpleNamespace(HfApi=lambda: made))
    return made


@pytest.fixture
def dataset(tmp_path: Path) -> Path:
    write(tmp_path / "cups", Plan("v2.1", lengths=(4,), videos=()))
    return tmp_path / "cups"


def test_a_dataset_is_uploaded_privately_and_tagged_with_its_version(client: Client, dataset: Path) -> None:
    told: list[str] = []
    assert hub.push(dataset, "lab/cups", tell=told.append) == "hub of datasets, lab/cups"
    (_, made), (_, sent), (_, tagged) = client.asked
    assert (made["name"], made["private"], made["repo_type"]) == ("lab/cups", True, "dataset")
    assert (sent["repo_id"], sent["folder_path"]) == ("lab/cups", dataset)
    assert (tagged["tag"], tagged["exist_ok"]) == ("v2.1", True)
    assert told[-1] == "the files are uploaded"


def test_one_that_is_not_whole_stays_here(client: Client, dataset: Path) -> None:
    next((dataset / "data").rglob("*.parquet")).unlink()
    with pytest.raises(RecordingError, match="is not whole, and is not pushed"):
        hub.push(dataset, "lab/cups")
    assert client.asked == []


def test_what_the_hub_says_against_it_is_said(client: Client, dataset: Path) -> None:
    client.refuses = "you are not logged in"
    with pytest.raises(RecordingError, match="not pushed to lab/cups: OSError: you are not logged in"):
        hub.push(dataset, "lab/cups")


@pytest.mark.parametrize("name", ["cups", "lab/../cups", "https://lab/cups", ""])
def test_a_repository_has_an_owner_and_a_name(client: Client, dataset: Path, name: str) -> None:
    with pytest.raises(RecordingError, match="allowed: OWNER/NAME"):
        hub.push(dataset, name)
    assert client.asked == []


def test_without_the_client_it_says_what_is_missing(
    dataset: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "huggingface_hub", None)
    assert main(["push", str(dataset), "lab/cups"]) == 1
    assert "the package huggingface_hub is not installed" in capsys.readouterr().err
