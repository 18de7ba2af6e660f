"""Upload of a dataset to the Hugging Face hub, and download, through the hub's own client if it is installed."""

from __future__ import annotations

import re
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import Any

from pydantic import SecretStr

from runtime.core.errors import RecordingError
from runtime.datasets.assemble import ProgressCallback, ignore_progress
from runtime.datasets.card import LICENCES, Licence, render_card
from runtime.datasets.consistency import check
from runtime.datasets.layout import read_info
from runtime.datasets.reader import Dataset, open_dataset
from runtime.datasets.staging import LOCK, Draft

_REPLACED = ("data", "videos", "images", "meta", "eva")  # folders on the hub whose surplus files are deleted
_CARD = "README.md"
_DOWNLOADED = (*(f"{folder}/" for folder in _REPLACED), _CARD)  # beginnings of paths
_REPOSITORY = re.compile(r"[A-Za-z0-9][\w.-]{0,95}/[A-Za-z0-9][\w.-]{0,95}", re.ASCII)


def push(
    dataset: Path,
    repository: str,
    *,
    private: bool = True,
    licence: Licence = "",
    token: SecretStr | None = None,
    tell: ProgressCallback = ignore_progress,
) -> str:
    """Upload `dataset` as `repository` ("owner/name"), with a card, and a tag for the version of its format, which
    LeRobot looks for.

    Files of an older upload in the folders of a dataset are replaced. The card states the `licence`;
    a README.md in the dataset's folder is uploaded in place of our card. With a `token` the
    client uses it and no other; without, its own login: the environment's token, else the stored one.

    Returns:
        Address of the repository.

    Raises:
        RecordingError: The client is not installed, the dataset is damaged, or the hub refuses the upload.
    """
    _require_repository(repository)
    if licence and licence not in LICENCES:
        raise RecordingError(f"licence = {licence!r:.60}; allowed: {', '.join(LICENCES)}, or none")
    client = _client(f"{dataset} cannot be pushed")
    root = Path(dataset)
    version = str(read_info(root)["codebase_version"])
    tell("the dataset is checked")
    problems = check(root)
    if problems:
        raise RecordingError(
            f"{root} is not whole, and is not pushed: {problems[0]} ({len(problems)} problems)"
        )
    card = (
        "" if (root / _CARD).exists() else render_card(open_dataset(root), repository.split("/")[1], licence)
    )
    hub = client.HfApi(token=_plain(token))
    failure = f"{root} is not pushed to {repository}"
    tell(f"{repository} is created")
    with _hub_errors(failure, token):
        address = hub.create_repo(repository, repo_type="dataset", private=private, exist_ok=True)
    tell("the files are uploaded")
    with _hub_errors(failure, token):
        hub.upload_folder(
            repo_id=repository,
            repo_type="dataset",
            folder_path=root,
            ignore_patterns=[LOCK, ".*", "**/.*"],
            delete_patterns=[f"{folder}/**" for folder in _REPLACED],
        )
        if card:
            hub.upload_file(
                path_or_fileobj=card.encode(), path_in_repo=_CARD, repo_id=repository, repo_type="dataset"
            )
        # LeRobot loads what the tag names: that of an earlier upload would hide this one.
        tags = hub.list_repo_refs(repository, repo_type="dataset").tags
        if any(tag.name == version for tag in tags):
            hub.delete_tag(repository, tag=version, repo_type="dataset")
        hub.create_tag(repository, tag=version, repo_type="dataset")
    return str(address)


def pull(
    repository: str,
    target: Path,
    *,
    revision: str = "",
    reserve: int = 0,
    token: SecretStr | None = None,
    tell: ProgressCallback = ignore_progress,
) -> Dataset:
    """Download the dataset `repository` ("owner/name") into the new folder `target`, completely or not at all.

    `revision` is a branch, tag or commit; "" takes the newest files. Only files of a dataset are downloaded, and only
    if `reserve` bytes of the disk stay free. They are compared with the dataset's own metadata before it appears.
    `token` is as in `push`.

    Raises:
        RecordingError: The client is not installed, `target` is not empty, the disk has no room, the hub refuses, or
            the dataset is damaged.
    """
    _require_repository(repository)
    client = _client(f"{repository} cannot be pulled")
    with Draft(target, replacing=False) as draft:
        hub = client.HfApi(token=_plain(token))
        failure = f"{repository} is not pulled"
        with _hub_errors(failure, token):
            about = hub.dataset_info(repository, revision=revision or None, files_metadata=True)
        size = sum(file.size or 0 for file in about.siblings if file.rfilename.startswith(_DOWNLOADED))
        _require_room(draft.folder, repository, size, reserve)
        tell(f"{size / 1e6:.0f} MB of {repository} are downloaded")
        with _hub_errors(failure, token):
            client.snapshot_download(
                repository,
                repo_type="dataset",
                revision=about.sha,
                allow_patterns=[f"{start}*" for start in _DOWNLOADED],
                local_dir=draft.folder,
                token=_plain(token),
            )
        for folder in draft.folder.glob(".*/"):  # of the client
            shutil.rmtree(folder)
        tell("the dataset is checked")
        problems = check(draft.folder)
        if problems:
            raise RecordingError(
                f"{repository} is not whole, and is not kept: {problems[0]} ({len(problems)} problems)"
            )
        draft.commit()
    return open_dataset(target)


def has_login() -> bool:
    """Return True if the client has a login of its own: a token in the environment, or a stored one.

    Raises:
        RecordingError: The client is not installed.
    """
    return _client("the login of the hub cannot be found").get_token() is not None


def _plain(token: SecretStr | None) -> str | None:
    """Return the token for the client, to which None means its own login. Raises: ValueError if it is empty."""
    if token is None:
        return None
    if not token.get_secret_value():
        raise ValueError("the token is empty")
    return token.get_secret_value()


@contextmanager
def _hub_errors(failure: str, token: SecretStr | None) -> Iterator[None]:
    """Convert errors of the client, which have many types, to RecordingErrors that do not contain the token.

    The original error is dropped, because a traceback would show its message, and the client's include headers.
    """
    try:
        yield
    except Exception as error:  # network, hub, login
        text = f"{failure}: {type(error).__name__}: {error}"
        raise RecordingError(text.replace(token.get_secret_value(), "(token)") if token else text) from None


def _require_room(folder: Path, repository: str, size: int, reserve: int) -> None:
    free = shutil.disk_usage(folder).free
    if size + reserve > free:
        raise RecordingError(
            f"{repository} has {size / 1e6:.0f} MB, and {free / 1e6:.0f} MB are free, of which {reserve / 1e6:.0f} MB "
            "stay so"
        )


def _require_repository(repository: str) -> None:
    if not _REPOSITORY.fullmatch(repository):
        raise RecordingError(
            f"repository = {repository!r:.100}; allowed: OWNER/NAME of letters, digits, '.', '_', '-'"
        )


def _client(what_cannot: str) -> Any:
    try:
        return import_module("huggingface_hub")
    except ImportError as error:
        raise RecordingError(
            f"{what_cannot}: the package huggingface_hub is not installed ({error}); install it into the environment "
            "of the lab by pip install 'eva-web[hub]', and log in with its own command"
        ) from error
