"""Reading of a crate from outside: every digest is checked, and what pages show of it is parsed with bounds."""

from __future__ import annotations

import json
import re
import zipfile
from collections.abc import Iterator, Mapping
from typing import IO, Annotated, Any
from urllib.parse import unquote

from django.core.exceptions import ValidationError as NotOrcid
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from evaweb.accounts.orcid import ADDRESS, parse_orcid
from evaweb.core.canonical_json import digest
from evaweb.core.errors import EvaError
from evaweb.results.crates.hostile_zips import hash_member, opened_zip, read_member
from runtime.core.bounded_documents import UnreadableDocument, parse_json
from runtime.core.sentences import Pattern

_NO_METADATA = Pattern("results.crates.no_metadata", "this zip is no RO-Crate: {name} is not at its top")
_NO_ROOT = Pattern(
    "results.crates.no_root", "{name} does not describe an RO-Crate 1.1 or newer whose root is a Dataset"
)
_NOT_OURS = Pattern(
    "results.crates.not_ours",
    "the crate has no {name}; allowed: crates of an evaluation that EVA Web has exported",
)
_NOT_LISTED = Pattern("results.crates.not_listed", "{path:.200} is in the crate, and not in its metadata")
_ABSENT = Pattern(
    "results.crates.absent", "{path:.200} is in the metadata of the crate, and not in the crate"
)
_NO_DIGEST = Pattern("results.crates.no_digest", "the metadata has no SHA-256 of {path:.200}")
_OTHER_DIGEST = Pattern(
    "results.crates.other_digest",
    "{path:.200} is not the file that the metadata describes: its SHA-256 differs",
)
_OTHER_PLAN = Pattern(
    "results.crates.other_plan", "data/plan.json has another digest than {where} states: it was changed"
)
_MUCH_TEXT = Pattern(
    "results.crates.much_text",
    "what pages would show of the crate has {count} characters; allowed: at most {most}",
)
_INVALID = Pattern("results.crates.invalid", "{name} in the crate: {error:.300}")

METADATA = "ro-crate-metadata.json"
PLAN, SEAL, NUMBERS = "data/plan.json", "data/seal.json", "data/numbers.json"
_LARGEST_METADATA = 20_000_000  # [bytes]; of the numbers too
_MOST_VALUES = 500_000
_MOST_SHOWN = 500_000  # [characters] of what pages show of a crate; a list shows hundreds of crates
_SHA_256 = re.compile(r"[0-9a-f]{64}")
_NOT_PRINTED = re.compile("[\x00-\x09\x0b-\x1f\x7f-\x9f\u202a-\u202e\u2066-\u2069\ud800-\udfff\ufffe\uffff]")
_VERSION = re.compile(r"https://w3id\.org/ro/crate/1\.[1-9]\d*(-DRAFT)?")

Line = Annotated[str, Field(max_length=300)]
Text = Annotated[str, Field(max_length=8000)]
Hex = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
Count = Annotated[int, Field(ge=0, le=10_000_000)]


class _Bounded(BaseModel):
    model_config = ConfigDict(extra="ignore", strict=True)


class _Arm(_Bounded):
    successes: Count
    n: Count

    @model_validator(mode="after")
    def _within(self) -> _Arm:
        if self.successes > self.n:
            raise ValueError(f"{self.successes} successes of {self.n} trials")
        return self


class _Checkpoint(_Bounded):
    name: Line
    digest: Line = ""


class _Scene(_Bounded):
    title: Line
    instruction: Text


class _Plan(_Bounded):
    name: Line
    version: Count
    title: Line
    question: Text = ""
    blind: bool = True
    checkpoints: Annotated[list[_Checkpoint], Field(min_length=1, max_length=500)]
    scenes: Annotated[list[_Scene], Field(max_length=500)]


class _Reveal(_Bounded):
    headline: Annotated[list[Text], Field(max_length=500)] = []
    caveats: Annotated[list[Text], Field(max_length=500)] = []
    setting: Text = ""
    at: Line = ""


class _Seal(_Bounded):
    digest: Hex
    commitment: Line
    at_reveal: _Reveal | None = None


class _Numbers(_Bounded):
    n: Count
    arms: Annotated[dict[Line, _Arm], Field(max_length=500)]


def read_foreign_crate(file: IO[bytes]) -> dict[str, Any]:
    """Return what pages show of a crate, as plain JSON, after all of it was checked.

    Every file has to be in the metadata with its SHA-256, and every file of the metadata in the crate; the digest of
    the plan has to be that of the seal and of the metadata.

    Raises:
        EvaError: If the crate is invalid, tampered with, or not of an evaluation.
    """
    with opened_zip(file) as (archive, files):
        if METADATA not in files:
            raise EvaError(_NO_METADATA(name=METADATA))
        entities = _entities(_json(archive, files, METADATA))
        root = _root(entities)
        _check_files(archive, files, entities, root)
        absent = next((name for name in (PLAN, SEAL, NUMBERS) if name not in files), None)
        if absent:
            raise EvaError(_NOT_OURS(name=absent))
        document = _json(archive, files, PLAN)
        plan, seal, numbers = (
            _valid(kind, name, content)
            for kind, name, content in (
                (_Plan, PLAN, document),
                (_Seal, SEAL, _json(archive, files, SEAL)),
                (_Numbers, NUMBERS, _json(archive, files, NUMBERS)),
            )
        )
    try:
        found = digest(document)
    except (UnicodeEncodeError, EvaError) as error:  # half a surrogate pair; NaN
        raise EvaError(_INVALID(name=PLAN, error=_printable(str(error)))) from None
    stated = str(_entity(entities, root.get("identifier")).get("value", ""))
    for where, value in ((SEAL, seal.digest), (METADATA, stated)):
        if value != found:
            raise EvaError(_OTHER_PLAN(where=where))
    shown = _printable(
        {
            "origin": _origin(entities, root),
            "plan": plan.model_dump(),
            "seal": seal.model_dump(),
            "n": numbers.n,
            "arms": [{"checkpoint": name, **arm.model_dump()} for name, arm in numbers.arms.items()],
            "videos": sum(path.startswith("videos/") for path in files),
            "files": len(files),
        }
    )
    count = len(json.dumps(shown, ensure_ascii=False))
    if count > _MOST_SHOWN:
        raise EvaError(_MUCH_TEXT(count=count, most=_MOST_SHOWN))
    return shown


def _printable(value: Any) -> Any:
    """Return plain JSON without characters that databases or pages cannot hold, which become U+FFFD; keys stay."""
    if isinstance(value, str):
        return _NOT_PRINTED.sub("\ufffd", value)
    if isinstance(value, dict):
        return {key: _printable(inner) for key, inner in value.items()}
    return [_printable(inner) for inner in value] if isinstance(value, list) else value


def _json(archive: zipfile.ZipFile, files: Mapping[str, zipfile.ZipInfo], name: str) -> dict[str, Any]:
    entry = files[name]
    if entry.file_size > _LARGEST_METADATA:
        raise EvaError(_INVALID(name=name, error=f"{entry.file_size} bytes; allowed: {_LARGEST_METADATA}"))
    try:
        content = parse_json(read_member(archive, entry), name, _LARGEST_METADATA, _MOST_VALUES)
    except UnreadableDocument as error:
        raise EvaError(_INVALID(name=name, error=str(error).removeprefix(f"{name}: "))) from None
    if not isinstance(content, dict):
        raise EvaError(_INVALID(name=name, error="is no JSON object"))
    return content


def _valid(kind: type[Any], name: str, content: Mapping[str, Any]) -> Any:
    try:
        return kind.model_validate(content)
    except ValidationError as invalid:
        first = invalid.errors(include_url=False, include_input=False)[0]
        where = _printable(".".join(map(str, first["loc"])))
        raise EvaError(_INVALID(name=name, error=f"{where:.150}: {first['msg']}")) from None


def _entities(metadata: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    graph = metadata.get("@graph")
    rows = [row for row in graph if isinstance(row, dict)] if isinstance(graph, list) else []
    return {row["@id"]: row for row in rows if isinstance(row.get("@id"), str)}


def _root(entities: Mapping[str, dict[str, Any]]) -> dict[str, Any]:
    descriptor = entities.get(METADATA, {})
    versions = _references(descriptor.get("conformsTo"))
    root = _entity(entities, descriptor.get("about"))
    kinds = root.get("@type")
    if not any(map(_VERSION.fullmatch, versions)) or "Dataset" not in _listed(kinds):
        raise EvaError(_NO_ROOT(name=METADATA))
    return root


def _check_files(
    archive: zipfile.ZipFile,
    files: Mapping[str, zipfile.ZipInfo],
    entities: Mapping[str, dict[str, Any]],
    root: Mapping[str, Any],
) -> None:
    listed = {
        unquote(name).removeprefix("./"): entities.get(name, {}) for name in _references(root.get("hasPart"))
    }
    for path in files:
        if path != METADATA and path not in listed:
            raise EvaError(_NOT_LISTED(path=path))
    for path, entity in listed.items():
        if path not in files:
            raise EvaError(_ABSENT(path=_printable(path)))
        stated = entity.get("sha256")
        if not isinstance(stated, str) or not _SHA_256.fullmatch(stated):
            raise EvaError(_NO_DIGEST(path=path))
        if hash_member(archive, files[path]) != stated:
            raise EvaError(_OTHER_DIGEST(path=path))


def _origin(entities: Mapping[str, dict[str, Any]], root: Mapping[str, Any]) -> dict[str, Any]:
    people = [
        {"name": _line(entities.get(name, {}).get("name")), "orcid": _orcid(name)}
        for name in dict.fromkeys([*_references(root.get("author")), *_references(root.get("contributor"))])
    ]
    programs = (row for row in entities.values() if "SoftwareApplication" in _listed(row.get("@type")))
    return {
        "name": _line(root.get("name")),
        "description": _text(root.get("description")),
        "published": _line(root.get("datePublished")),
        "license": next((_line(name) for name in _references(root.get("license"))), ""),
        "lab": _line(_entity(entities, root.get("publisher")).get("name")),
        "people": people[:200],
        "programs": [f"{_line(row.get('name'))} {_line(row.get('version'))}".strip() for row in programs][
            :20
        ],
    }


def _orcid(identifier: str) -> str:
    """Return the address of an ORCID iD; "" for any other identifier, and for an iD with a wrong check digit."""
    try:
        orcid = parse_orcid(identifier) if identifier.startswith(ADDRESS) else ""
    except NotOrcid:
        return ""
    return f"{ADDRESS}{orcid}" if orcid else ""


def _entity(entities: Mapping[str, dict[str, Any]], reference: Any) -> dict[str, Any]:
    return next((entities[name] for name in _references(reference) if name in entities), {})


def _references(value: Any) -> list[str]:
    return list(_ids(value))


def _ids(value: Any) -> Iterator[str]:
    for row in value if isinstance(value, list) else [value]:
        if isinstance(row, dict) and isinstance(row.get("@id"), str):
            yield row["@id"]


def _listed(value: Any) -> list[Any]:
    return value if isinstance(value, list) else [value]


def _line(value: Any) -> str:
    return " ".join(value.split())[:300] if isinstance(value, str) else ""


def _text(value: Any) -> str:
    return value[:8000] if isinstance(value, str) else ""
