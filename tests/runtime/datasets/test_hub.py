"""Pushing to the hub, with a client that writes down what it is asked for: the real hub is never reached."""

from __future__ import annotations

import shutil
import sys
import traceback
from fnmatch import fnmatch
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from pydantic import SecretStr

from runtime.core.errors import RecordingError
from runtime.datasets import consistency, hub
from runtime.datasets.__main__ import main
from tests.runtime.datasets.foreign import Plan, write


class Client:
    """Stands for the hub's own client."""

    def __init__(self) -> None:
        self.asked: list[tuple[str, dict[str, Any]]] = []
        self.refuses = ""
        self.has = Path()
        self.size = 10  # of each file [bytes]
        self.tags: list[str] = []
        self.tokens: list[str | None] = []

    def logged_in(self, token: str | None) -> Client:
        self.tokens.append(token)
        return self

    def create_repo(self, name: str, **given: Any) -> str:
        if self.refuses:
            raise OSError(self.refuses)
        self.asked.append(("create", {"name": name, **given}))
        return f"hub of datasets, {name}"

    def upload_folder(self, **given: Any) -> None:
        self.asked.append(("upload", given))

    def upload_file(self, **given: Any) -> None:
        self.asked.append(("card", given))

    def snapshot_download(self, name: str, *, local_dir: Path, token: str | None, **given: Any) -> None:
        self.tokens.append(token)
        self.asked.append(("download", {"name": name, **given}))
        for file in self.files:
            if any(fnmatch(file, pattern) for pattern in given["allow_patterns"]):
                (local_dir / file).parent.mkdir(parents=True, exist_ok=True)
                shutil.copy(self.has / file, local_dir / file)
        (local_dir / ".cache" / "huggingface").mkdir(parents=True)
        (local_dir / ".gitattributes").write_text("*.mp4 filter=lfs\n")

    @property
    def files(self) -> list[str]:
        return [str(path.relative_to(self.has)) for path in self.has.rglob("*") if path.is_file()]

    def dataset_info(self, name: str, *, revision: str | None, files_metadata: bool) -> SimpleNamespace:
        if self.refuses:
            raise OSError(self.refuses)
        self.asked.append(("info", {"name": name, "revision": revision}))
        sizes = [SimpleNamespace(rfilename=file, size=self.size) for file in self.files]
        return SimpleNamespace(sha="abc123", siblings=sizes)

    def list_repo_refs(self, name: str, *, repo_type: str) -> SimpleNamespace:
        return SimpleNamespace(tags=[SimpleNamespace(name=tag) for tag in self.tags])

    def delete_tag(self, name: str, **given: Any) -> None:
        self.asked.append(("untag", {"name": name, **given}))

    def create_tag(self, name: str, **given: Any) -> None:
        self.asked.append(("tag", {"name": name, **given}))


@pytest.fixture
def client(monkeypatch: pytest.MonkeyPatch) -> Client:
    made = Client()
    client = SimpleNamespace(
        HfApi=lambda token: made.logged_in(token), snapshot_download=made.snapshot_download
    )
    monkeypatch.setitem(sys.modules, "huggingface_hub", client)
    return made


@pytest.fixture
def dataset(tmp_path: Path) -> Path:
    write(tmp_path / "cups", Plan("v2.1", lengths=(4,), videos=()))
    return tmp_path / "cups"


def test_a_dataset_is_uploaded_privately_and_tagged_with_its_version(client: Client, dataset: Path) -> None:
    told: list[str] = []
    assert hub.push(dataset, "lab/cups", tell=told.append) == "hub of datasets, lab/cups"
    (_, made), (_, sent), (_, card), (_, tagged) = client.asked
    assert (made["name"], made["private"], made["repo_type"]) == ("lab/cups", True, "dataset")
    assert (sent["repo_id"], sent["folder_path"]) == ("lab/cups", dataset)
    assert tagged["tag"] == "v2.1"
    assert told[-1] == "the files are uploaded"
    assert (card["path_in_repo"], card["repo_id"], card["repo_type"]) == ("README.md", "lab/cups", "dataset")
    assert b"# cups\n" in card["path_or_fileobj"]


def test_the_tag_of_an_earlier_upload_is_replaced(client: Client, dataset: Path) -> None:
    client.tags = ["v2.1"]
    hub.push(dataset, "lab/cups")
    assert [name for name, _ in client.asked] == ["create", "upload", "card", "untag", "tag"]


def test_a_card_of_ones_own_is_uploaded_as_it_is(client: Client, dataset: Path) -> None:
    (dataset / "README.md").write_text("# Ours\n")
    hub.push(dataset, "lab/cups", licence="mit")
    assert [name for name, _ in client.asked] == ["create", "upload", "tag"]
    with pytest.raises(RecordingError, match=r"licence = 'wtf'; allowed: cc-by-4\.0, "):
        hub.push(dataset, "lab/cups", licence="wtf")  # type: ignore[arg-type]


def test_one_that_is_not_whole_stays_here(client: Client, dataset: Path) -> None:
    next((dataset / "data").rglob("*.parquet")).unlink()
    with pytest.raises(RecordingError, match="is not whole, and is not pushed"):
        hub.push(dataset, "lab/cups")
    assert client.asked == []


def test_what_the_hub_says_against_it_is_said(client: Client, dataset: Path) -> None:
    client.refuses = "you are not logged in"
    with pytest.raises(RecordingError, match="not pushed to lab/cups: OSError: you are not logged in"):
        hub.push(dataset, "lab/cups")


def test_a_token_is_the_only_one_used_and_in_no_error(client: Client, dataset: Path, tmp_path: Path) -> None:
    token = SecretStr("hf_of_ann_0123456789")
    client.has = dataset
    hub.push(dataset, "lab/cups", token=token)
    hub.pull("lab/cups", tmp_path / "back", token=token)
    assert client.tokens == [token.get_secret_value()] * 3
    client.refuses = f"illegal header 'Bearer {token.get_secret_value()}'"
    for call in (
        lambda: hub.push(dataset, "lab/cups", token=token),
        lambda: hub.pull("lab/cups", tmp_path / "again", token=token),
    ):
        with pytest.raises(RecordingError, match=r"illegal header 'Bearer \(token\)'") as caught:
            call()
        assert token.get_secret_value() not in "".join(traceback.format_exception(caught.value))
    with pytest.raises(ValueError, match="the token is empty"):
        hub.pull("lab/cups", tmp_path / "again", token=SecretStr(""))


def test_a_cancelled_push_ends_as_cancelled(client: Client, dataset: Path) -> None:
    def cancel(step: str) -> None:
        if "uploaded" in step:
            raise KeyError(step)

    with pytest.raises(KeyError):
        hub.push(dataset, "lab/cups", tell=cancel)
    assert [name for name, _ in client.asked] == ["create"]


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


# --- from the hub ------------------------------------------------------------------------------------------------


def test_a_dataset_is_downloaded_checked_and_appears_whole(
    client: Client, dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    client.has = dataset
    (dataset / "weights.bin").touch()
    target = tmp_path / "datasets" / "cups"
    assert main(["pull", "lab/cups", "--to", str(target), "--revision", "v2.1"]) == 0
    assert capsys.readouterr().out.endswith(f"pulled: 1 episodes of lab/cups to {target}\n")
    (_, info), (_, asked) = client.asked
    assert info == {"name": "lab/cups", "revision": "v2.1"}
    assert (asked["name"], asked["repo_type"], asked["revision"]) == ("lab/cups", "dataset", "abc123")
    assert consistency.check(target) == []
    assert not (target / ".cache").exists()
    assert not (target / "weights.bin").exists()
    assert [path.name for path in target.parent.iterdir()] == ["cups"]


def test_what_is_damaged_refused_or_in_the_way_leaves_nothing(
    client: Client, dataset: Path, tmp_path: Path
) -> None:
    client.has, target = dataset, tmp_path / "datasets" / "cups"
    next((dataset / "data").rglob("*.parquet")).unlink()
    with pytest.raises(RecordingError, match="lab/cups is not whole, and is not kept: "):
        hub.pull("lab/cups", target)
    client.size = 10**15
    with pytest.raises(
        RecordingError, match=r"lab/cups has \d+ MB, and \d+ MB are free, of which 5 MB stay so"
    ):
        hub.pull("lab/cups", target, reserve=5_000_000)
    client.refuses = "404 not found"
    with pytest.raises(RecordingError, match="lab/cups is not pulled: OSError: 404 not found"):
        hub.pull("lab/cups", target)
    with pytest.raises(RecordingError, match="allowed: OWNER/NAME"):
        hub.pull("cups", target)
    assert list(target.parent.iterdir()) == []
    target.mkdir()
    (target / "mine").touch()
    with pytest.raises(RecordingError, match="is there already and not empty"):
        hub.pull("lab/cups", target)
