"""Upload of a dataset to the Hugging Face hub, through its own client if it is installed."""

from __future__ import annotations

import re
from importlib import import_module
from pathlib import Path

from runtime.core.errors import RecordingError
from runtime.datasets.assemble import ProgressCallback, ignore_progress
from runtime.datasets.consistency import check
from runtime.datasets.layout import read_info
from runtime.datasets.staging import LOCK

_REPLACED = ("data", "videos", "images", "meta", "eva")  # folders on the hub whose surplus files are deleted
_REPOSITORY = re.compile(r"[A-Za-z0-9][\w.-]{0,95}/[A-Za-z0-9][\w.-]{0,95}", re.ASCII)


def push(
    dataset: Path, repository: str, *, private: bool = True, tell: ProgressCallback = ignore_progress
) -> str:
    """Upload `dataset` as `repository` ("owner/name"), with a tag for the version of its format, which LeRobot looks
    for.

    Files of an older upload in the folders of a dataset are replaced. The client uses its stored login.

    Returns:
        Address of the repository.

    Raises:
        RecordingError: The client is not installed, the dataset is damaged, or the hub refuses the upload.
    """
    if not _REPOSITORY.fullmatch(repository):
        raise RecordingError(
            f"repository = {repository!r:.100}; allowed: OWNER/NAME of letters, digits, '.', '_', '-'"
        )
    try:
        client = import_module("huggingface_hub")
    except ImportError as error:
        raise RecordingError(
            f"{dataset} cannot be pushed: the package huggingface_hub is not installed ({error}); install it into the "
            "environment of the lab, and log in with its own command"
        ) from error
    root = Path(dataset)
    version = str(read_info(root)["codebase_version"])
    tell("the dataset is checked")
    problems = check(root)
    if problems:
        raise RecordingError(
            f"{root} is not whole, and is not pushed: {problems[0]} ({len(problems)} problems)"
        )
    try:
        hub = client.HfApi()
        tell(f"{repository} is created")
        address = hub.create_repo(repository, repo_type="dataset", private=private, exist_ok=True)
        tell("the files are uploaded")
        hub.upload_folder(
            repo_id=repository,
            repo_type="dataset",
            folder_path=root,
            ignore_patterns=[LOCK, ".*", "**/.*"],
            delete_patterns=[f"{folder}/**" for folder in _REPLACED],
        )
        hub.create_tag(repository, tag=version, repo_type="dataset", exist_ok=True)
    except Exception as error:  # the client raises many types: network, hub, login
        raise RecordingError(
            f"{root} is not pushed to {repository}: {type(error).__name__}: {error}"
        ) from error
    return str(address)
