"""Crates of another lab, as small as they may be; written without rocrate, so that any environment can."""

from __future__ import annotations

import hashlib
import io
import json
import zipfile
from collections.abc import Mapping
from typing import Any

from evaweb.core.canonical_json import digest
from evaweb.results.crates.foreign import METADATA


def foreign_files(
    checkpoints: Mapping[str, str] | None = None, title: str = "Cups elsewhere", **more: bytes
) -> dict[str, bytes]:
    """Files of a crate; `checkpoints` are digests by name, `more` further files by path."""
    named = checkpoints or {"cup-policy": "", "mug-policy": ""}
    plan = {
        "name": "cups",
        "version": 2,
        "title": title,
        "question": "Which is better?",
        "checkpoints": [
            {"name": name, "digest": sha} if sha else {"name": name} for name, sha in named.items()
        ],
        "scenes": [{"title": "cup", "instruction": "pick the cup"}],
    }
    reveal = {
        "headline": ["the first was better"],
        "caveats": ["one look"],
        "setting": "8 trials",
        "at": "2026",
    }
    seal = {"digest": digest(plan), "commitment": "c" * 64, "key": "", "at_reveal": reveal}
    numbers = {"n": 8, "arms": {name: {"successes": 1 + i, "n": 4} for i, name in enumerate(named)}}
    contents = {"plan": plan, "seal": seal, "numbers": numbers}
    return {f"data/{name}.json": json.dumps(content).encode() for name, content in contents.items()} | more


def foreign_metadata(files: Mapping[str, bytes]) -> dict[str, Any]:
    """Metadata of such a crate."""
    value = digest(json.loads(files["data/plan.json"])) if "data/plan.json" in files else ""
    root = {
        "@id": "./",
        "@type": "Dataset",
        "name": "Cups, elsewhere",
        "description": "Two policies & a cup",
        "datePublished": "2026-05-01",
        "license": {"@id": "https://spdx.org/licenses/CC-BY-4.0"},
        "publisher": {"@id": "#lab"},
        "author": {"@id": "https://orcid.org/0000-0002-1825-0097"},
        "identifier": {"@id": "#plan-digest"},
        "hasPart": [{"@id": path} for path in files],
    }
    described = {"@id": METADATA, "@type": "CreativeWork", "about": {"@id": "./"}}
    return {
        "@context": "https://w3id.org/ro/crate/1.3/context",
        "@graph": [
            root,
            {**described, "conformsTo": {"@id": "https://w3id.org/ro/crate/1.3"}},
            {"@id": "#lab", "@type": "Organization", "name": "The Other Lab"},
            {"@id": "https://orcid.org/0000-0002-1825-0097", "@type": "Person", "name": "josiah"},
            {"@id": "#plan-digest", "@type": "PropertyValue", "value": value},
            *(
                {"@id": path, "@type": "File", "sha256": hashlib.sha256(content).hexdigest()}
                for path, content in files.items()
            ),
        ],
    }


def packed(files: Mapping[str, bytes], metadata: Mapping[str, Any] | None = None) -> io.BytesIO:
    """The zip of it, the same to the byte at any time of the day."""
    target = io.BytesIO()
    described = json.dumps(metadata or foreign_metadata(files)).encode()
    with zipfile.ZipFile(target, "w") as archive:
        for path, content in {**files, METADATA: described}.items():
            archive.writestr(zipfile.ZipInfo(path), content, zipfile.ZIP_DEFLATED)
    return target


def foreign_crate(**given: Any) -> io.BytesIO:
    """A valid crate; see `foreign_files`."""
    return packed(foreign_files(**given))
