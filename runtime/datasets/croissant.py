"""Croissant description of a dataset: its files with digests, and its columns, for catalogues outside the hub.

Source: MLCommons Croissant 1.0. The hub makes such a description by itself.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping
from datetime import date
from pathlib import Path
from typing import Any

from runtime.core.errors import RecordingError
from runtime.datasets import layout
from runtime.datasets.card import Licence
from runtime.datasets.reader import Dataset

# Terms of the description; those of schema.org are the default.
_CONTEXT: Mapping[str, Any] = {
    "@language": "en",
    "@vocab": "https://schema.org/",
    **{
        term: f"cr:{term}"
        for term in (
            *("citeAs", "column", "extract", "field", "fileObject", "fileProperty", "fileSet", "format"),
            *("includes", "isLiveDataset", "jsonPath", "key", "md5", "parentField", "path", "recordSet"),
            *("references", "regex", "repeated", "replace", "samplingRate", "separator", "source"),
            *("subField", "transform", "equivalentProperty"),
        )
    },
    "conformsTo": "dct:conformsTo",
    "cr": "http://mlcommons.org/croissant/",
    "data": {"@id": "cr:data", "@type": "@json"},
    "dataType": {"@id": "cr:dataType", "@type": "@vocab"},
    "dct": "http://purl.org/dc/terms/",
    "examples": {"@id": "cr:examples", "@type": "@json"},
    "rai": "http://mlcommons.org/croissant/RAI/",
    "sc": "https://schema.org/",
}
LICENCES: Mapping[Licence, str] = {
    "cc-by-4.0": "https://spdx.org/licenses/CC-BY-4.0",
    "cc-by-sa-4.0": "https://spdx.org/licenses/CC-BY-SA-4.0",
    "cc-by-nc-4.0": "https://spdx.org/licenses/CC-BY-NC-4.0",
    "cc0-1.0": "https://spdx.org/licenses/CC0-1.0",
    "apache-2.0": "https://spdx.org/licenses/Apache-2.0",
    "mit": "https://spdx.org/licenses/MIT",
    "odbl": "https://spdx.org/licenses/ODbL-1.0",
}
"""Addresses of the licences that a description may state, by the hub's names."""
_TYPES = {"float32": "sc:Float", "float64": "sc:Float", "bool": "sc:Boolean", "string": "sc:Text"}
_FORMATS = {
    ".parquet": "application/x-parquet",
    ".json": "application/json",
    ".jsonl": "application/jsonlines",
} | {
    ".mp4": "video/mp4",
    ".png": "image/png",
    ".md": "text/markdown",
}
_FOLDERS = ("data", "meta", "videos", "images", "eva")


def describe_croissant(
    dataset: Dataset, name: str, *, licence: Licence, url: str, description: str, published: date
) -> dict[str, Any]:
    """Return the description of a dataset that is published at `url` under this licence, as JSON-LD.

    Only facts of the dataset's own files are stated. Paths of files are relative to the description.

    Raises:
        RecordingError: The licence is missing or has no address, or a file cannot be read.
    """
    if licence not in LICENCES:
        raise RecordingError(f"licence = {licence!r:.60}; allowed for a description: {', '.join(LICENCES)}")
    files = [_file_object(dataset.root, path) for path in _files(dataset.root)]
    return {
        "@context": dict(_CONTEXT),
        "@type": "sc:Dataset",
        "name": name,
        "description": description,
        "conformsTo": "http://mlcommons.org/croissant/1.0",
        "license": LICENCES[licence],
        "url": url,
        "datePublished": published.isoformat(),
        "version": f"{dataset.version.removeprefix('v')}.0",
        "distribution": [
            *files,
            {
                "@type": "cr:FileSet",
                "@id": "rows-files",
                "name": "rows-files",
                "encodingFormat": _FORMATS[".parquet"],
                "includes": "data/*/*.parquet",
            },
        ],
        "recordSet": [
            {"@type": "cr:RecordSet", "@id": "rows", "name": "rows", "field": list(_fields(dataset))},
        ],
    }


def _files(root: Path) -> list[Path]:
    found = [path for folder in _FOLDERS for path in (root / folder).rglob("*") if path.is_file()]
    return sorted(path for path in found if not path.name.startswith("."))


def _file_object(root: Path, path: Path) -> dict[str, Any]:
    name = path.relative_to(root).as_posix()
    digest = hashlib.sha256()
    try:
        with path.open("rb") as file:
            while block := file.read(1 << 20):
                digest.update(block)
    except OSError as error:
        raise RecordingError(f"{path}: {error.strerror}") from error
    return {
        "@type": "cr:FileObject",
        "@id": name,
        "name": name,
        "contentUrl": name,
        "encodingFormat": _FORMATS.get(path.suffix, "application/octet-stream"),
        "sha256": digest.hexdigest(),
    }


def _fields(dataset: Dataset) -> Iterator[dict[str, Any]]:
    """Yield the columns of the rows; pictures are files."""
    pictures = {*layout.video_keys(dataset.features), *layout.image_keys(dataset.features)}
    for key, feature in dataset.features.items():
        if key not in pictures:
            width = [int(side) for side in feature["shape"]]
            yield {
                "@type": "cr:Field",
                "@id": f"rows/{key}",
                "name": f"rows/{key}",
                "dataType": _TYPES.get(str(feature["dtype"]), "sc:Integer"),
                **({"repeated": True} if width != [1] else {}),
                "source": {"fileSet": {"@id": "rows-files"}, "extract": {"column": key}},
            }
