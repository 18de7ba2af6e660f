"""Metadata of a crate as JSON-LD, built by the library rocrate (RO-Crate 1.3, Process Run Crate 0.5)."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import PurePosixPath
from types import ModuleType
from typing import Any
from urllib.parse import quote

from evaweb.accounts.orcid import ADDRESS
from evaweb.accounts.profiles import orcids_of
from evaweb.core.errors import EvaError
from evaweb.plans.models import Plan
from evaweb.results.crates.facts import CrateFacts
from evaweb.results.crates.licenses import LICENSES, license_address
from evaweb.results.crates.options import CrateOptions
from runtime.core.sentences import Pattern

_NOT_INSTALLED = Pattern(
    "results.crates.not_installed",
    "crates are written by rocrate, which is not installed here: pip install 'eva-web[crates]' ({error})",
)

PROFILE = "https://w3id.org/ro/wfrun/process/0.5"
_MEDIA = {
    ".css": "text/css",
    ".csv": "text/csv",
    ".html": "text/html",
    ".jpg": "image/jpeg",
    ".json": "application/json",
    ".mp4": "video/mp4",
    ".py": "text/x-python",
}
_DESCRIPTIONS = {
    "index.html": "Report of the evaluation: one page that needs no network",
    "data/plan.json": "Plan as it was frozen before the first trial; its canonical form has the digest of the plan",
    "data/seal.json": "Digest of the plan, commitment to its schedule, and the record of the reveal",
    "data/numbers.json": "Every number of the report that the program recomputes",
    "data/integrity.json": "How the trials were made: looks, voids, corrections, amendments, delays",
    "data/trials.csv": "Every attempt with its place in the schedule and the score that counts",
    "data/scores.csv": "Every score, including those that were corrected later",
    "data/ratings.csv": "Second ratings by people who did not run the trial",
    "data/preferences.csv": "Preferences between two trials from the same initial condition",
    "data/judgements.csv": "Judgements of automatic judges",
    "data/laid_out.csv": "How the bench was laid out before each trial, with the match of each camera",
    "recompute/__main__.py": "Program that computes every number again: python3 -m recompute",
}
_FOLDERS = {
    "data/pictures": "Picture of a bench, named by its SHA-256",
    "recompute": "Part of the program that computes every number again",
    "videos": "Video of one camera in one trial",
}
_DERIVED = ("index.html", "data/numbers.json", "data/integrity.json")


@dataclass(frozen=True, slots=True)
class PackedFile:
    """File of a crate: its path, size [bytes] and SHA-256."""

    path: str
    size: int
    sha256: str


def rocrate_library() -> ModuleType:
    """Return the module of rocrate. Raises: EvaError, with what to install, if it is absent."""
    try:
        from rocrate import rocrate
    except ImportError as error:
        raise EvaError(_NOT_INSTALLED(error=error)) from None
    return rocrate


def crate_metadata(
    plan: Plan, facts: CrateFacts, options: CrateOptions, files: Sequence[PackedFile], remark: str
) -> dict[str, Any]:
    """Return the content of ro-crate-metadata.json for a plan and the files of its report.

    `remark` ends the description of the evaluation; "" for none. Raises: EvaError if rocrate is absent.
    """
    return _Graph(plan, facts, options).build(files, remark)


class _Graph:
    def __init__(self, plan: Plan, facts: CrateFacts, options: CrateOptions) -> None:
        self._library = rocrate_library()
        self._crate = self._library.ROCrate()
        self._plan, self._facts, self._options = plan, facts, options
        self._document: Mapping[str, Any] = plan.document or {}
        self._orcids = orcids_of([facts.owner, *facts.operators, *facts.raters])
        self._accounts: dict[str, list[str]] = {}  # by ORCID iD: one person may have several accounts
        for account, orcid in sorted(self._orcids.items()):
            self._accounts.setdefault(orcid, []).append(account)
        self._lab: Any = None
        self._people: dict[str, Any] = {}

    def build(self, files: Sequence[PackedFile], remark: str) -> dict[str, Any]:
        options, plan, root = self._options, self._plan, self._crate.root_dataset
        root["name"] = options.name or f"{plan.title}, version {plan.version}"
        root["description"] = options.description or self._description()
        root["datePublished"] = options.date or self._facts.recorded_at.astimezone(UTC).date().isoformat()
        root["license"] = self._license()
        root["conformsTo"] = self._entity(
            PROFILE, ["CreativeWork", "Profile"], name="Process Run Crate", version="0.5"
        )
        root["identifier"] = self._digest("#plan-digest", "Digest of the frozen plan", plan.digest)
        if options.lab:
            self._lab = self._entity("#lab", "Organization", name=options.lab)
            root["publisher"] = self._lab
        root["author"] = self._person(self._facts.owner)
        others = sorted({*self._facts.operators, *self._facts.raters})
        contributors = [name for name in others if self._person(name).id != root["author"].id]
        if contributors:
            root["contributor"] = self._persons(contributors)
        by_path = {file.path: self._file(file) for file in files}
        release = version("eva-web")
        address = (
            f"pkg:generic/eva-web@{release}"  # a package URL: a program that runs in labs has no one address
        )
        program = self._entity(
            address,
            "SoftwareApplication",
            name="EVA Web",
            version=release,
            url=address,
            description="Hands out the trials, records and scores them, and computes the results",
        )
        root["mentions"] = [self._evaluation(by_path, program, remark), self._analysis(by_path, program)]
        metadata: dict[str, Any] = self._crate.metadata.generate()
        return metadata

    def _description(self) -> str:
        question = self._plan.question or "Evaluation of robot policies"
        arms = ", ".join(row["name"] for row in self._document.get("checkpoints", ()))
        return f"{question} Checkpoints: {arms}."

    def _license(self) -> Any:
        identifier = self._options.license
        address = license_address(identifier)
        described = f"Licence {identifier} of the SPDX list, for all files of this crate"
        named = {"name": LICENSES[identifier], "identifier": identifier, "url": address}
        return self._entity(address, "CreativeWork", description=described, **named)

    def _persons(self, names: Iterable[str]) -> Any:
        return _single({person.id: person for person in map(self._person, names)}.values())

    def _person(self, name: str) -> Any:
        if name not in self._people:
            orcid = self._orcids.get(name)
            accounts = self._accounts[orcid] if orcid else [name]
            named = {"name": ", ".join(accounts)} | (
                {"affiliation": self._lab} if self._lab is not None else {}
            )
            identifier = f"{ADDRESS}{orcid}" if orcid else f"#person-{quote(name)}"
            self._people[name] = self._entity(identifier, "Person", **named)
        return self._people[name]

    def _file(self, file: PackedFile) -> Any:
        path = PurePosixPath(file.path)
        described = _DESCRIPTIONS.get(file.path) or _FOLDERS.get(str(path.parent), path.name)
        properties = {
            "name": path.name,
            "description": described,
            "encodingFormat": _MEDIA.get(path.suffix, "application/octet-stream"),
            "contentSize": str(file.size),
            "sha256": file.sha256,
        }
        return self._crate.add(self._library.File(self._crate, None, file.path, properties=properties))

    def _checkpoint(self, number: int, row: Mapping[str, Any]) -> Any:
        named = {"name": row["name"], "description": row.get("description") or "Checkpoint of the evaluation"}
        if row.get("digest"):
            name = f"Digest of the weights of {row['name']}"
            named["identifier"] = self._digest(f"#checkpoint-{number}-digest", name, row["digest"])
        return self._entity(f"#checkpoint-{number}", "CreativeWork", **named)

    def _digest(self, identifier: str, name: str, value: str) -> Any:
        return self._entity(identifier, "PropertyValue", name=name, propertyID="SHA-256", value=value)

    def _evaluation(self, by_path: Mapping[str, Any], program: Any, remark: str) -> Any:
        rows = self._document.get("checkpoints", ())
        checkpoints = [self._checkpoint(number, row) for number, row in enumerate(rows, start=1)]
        results = [
            entity
            for path, entity in by_path.items()
            if path.startswith(("data/", "videos/")) and path not in (*_DERIVED, "data/plan.json")
        ]
        return self._action(
            "#evaluation",
            name=f"Trials of {self._plan}",
            description=" ".join(filter(None, ("Trials of the frozen plan with their scores.", remark))),
            instrument=program,
            agent=self._persons(self._facts.operators or [self._facts.owner]),
            object=_single([by_path["data/plan.json"], *checkpoints]),
            result=_single(results),
            startTime=_time(self._facts.started_at),
            endTime=_time(self._facts.ended_at),
        )

    def _analysis(self, by_path: Mapping[str, Any], program: Any) -> Any:
        inputs = [
            entity for path, entity in by_path.items() if path.startswith("data/") and path not in _DERIVED
        ]
        return self._action(
            "#analysis",
            name=f"Analysis of {self._plan}",
            description="Every number and the report, by the design that the plan has frozen.",
            instrument=program,
            agent=self._person(self._facts.owner),
            object=_single(inputs),
            result=_single(by_path[path] for path in _DERIVED),
            endTime=_time(self._facts.recorded_at),
        )

    def _action(self, id: str, **properties: Any) -> Any:
        return self._entity(id, "CreateAction", **properties)

    def _entity(self, id: str, kind: str | list[str], **properties: Any) -> Any:
        entity = self._library.ContextEntity(self._crate, id, properties={"@type": kind})
        self._crate.add(entity)
        for name, value in properties.items():
            entity[name] = value
        return entity


def _single(entities: Iterable[Any]) -> Any:
    """Return a list of several entities, or the only one: JSON-LD recommends no lists of one."""
    listed = list(entities)
    return listed[0] if len(listed) == 1 else listed


def _time(at: datetime) -> str:
    return at.astimezone(UTC).isoformat(timespec="seconds")
