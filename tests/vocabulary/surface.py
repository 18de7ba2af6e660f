"""The public surface: every name that programs, browsers, files and people outside the source use.

`python -m tests.vocabulary.surface` writes it anew; a rename of ours changes nothing of it.
"""

from __future__ import annotations

import argparse
import ast
import json
import os
import runpy
import sys
from collections.abc import Iterator, Mapping
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import fields
from io import StringIO
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from unittest import mock

ROOT = Path(__file__).parents[2]
GOLDEN = Path(__file__).with_name("surface.json")
PROGRAMS = (
    *("runtime", "runtime.ctl", "runtime.keys", "runtime.datasets", "runtime.kinematics", "runtime.link"),
    *("runtime.preflight", "runtime.quality", "runtime.recording", "runtime.clients.channel"),
    *("runtime.clients.panel", "runtime.clients.headless", "robots", "benchmarks"),
)
_WORDS_OF_AN_EVENT = ("Event", "emit", "_emit", "_flag", "record_event", "_say", "note")


def surface() -> dict[str, Any]:
    """All of it, by what has it; Django has to be set up."""
    return {
        "rest": sorted(set(rest())),
        "addresses": sorted(addresses()),
        "models": models(),
        "programs": {name: program(name) for name in PROGRAMS},
        "manage.py": management(),
        "configuration": configuration(),
        "robot.toml": robot(),
        "journals": journals(),
        "messages": messages(),
        "snapshot": snapshot(),
        "columns": columns(),
        "events": sorted(event_kinds()),
    }


def rest() -> Iterator[str]:
    """Methods of each path with parameters, and the fields of every body, under no name of ours."""
    document = json.loads((ROOT / "docs" / "openapi.json").read_text("utf-8"))
    schemas = document["components"]["schemas"]

    def fields_of(node: Any, before: str, above: tuple[str, ...] = ()) -> Iterator[str]:
        if isinstance(node, list):
            for part in node:
                yield from fields_of(part, before, above)
        elif isinstance(node, Mapping):
            name = node.get("$ref", "").rsplit("/", 1)[-1]
            if name and name not in above:
                yield from fields_of(schemas[name], before, (*above, name))
            for key, value in node.get("properties", {}).items():
                yield f"{before}.{key}"
                yield from fields_of(value, f"{before}.{key}", above)
            for key in ("items", "anyOf", "oneOf", "allOf", "additionalProperties", "schema", "content"):
                yield from fields_of(node.get(key), before, above)
            for kind, value in node.items():
                if "/" in kind and isinstance(value, Mapping):  # a content type
                    yield from fields_of(value, f"{before} {kind}", above)
            for value in node.get("enum", ()):
                yield f"{before} = {value}"

    for path, methods in document["paths"].items():
        for method, one in methods.items():
            here = f"{method} {path}"
            yield here
            for parameter in one.get("parameters", ()):
                yield f"{here} {parameter['in']} {parameter['name']}"
            yield from fields_of(one.get("requestBody"), f"{here} in")
            for status, answer in one.get("responses", {}).items():
                found = fields_of(answer, f"{here} {status}")
                yield from (
                    found
                    if status < "400"
                    else [" ".join([here, status, *sorted({f.rsplit(".")[-1] for f in found})])]
                )


def addresses() -> Iterator[str]:
    """Every route with its name."""
    from django.urls import URLPattern, get_resolver

    def below(patterns: Any, before: str) -> Iterator[str]:
        for one in patterns:
            if isinstance(one, URLPattern):
                yield f"{before}{one.pattern} {one.name or ''}".strip()
            else:
                yield from below(one.url_patterns, f"{before}{one.pattern}")

    return below(get_resolver().url_patterns, "/")


def models() -> dict[str, Any]:
    """Tables with columns, and names of fields and relations."""
    from django.apps import apps

    return {
        model._meta.label: {
            "table": model._meta.db_table,
            "fields": sorted(
                f"{field.name} {getattr(field, 'column', '')}".strip() for field in model._meta.get_fields()
            ),
        }
        for model in apps.get_models(include_auto_created=True)
        if model.__module__.startswith("evaweb.")
    }


class _Parsed(BaseException):
    """Instead of parsing: the parser that was about to."""

    def __init__(self, parser: argparse.ArgumentParser) -> None:
        self.parser = parser


def program(name: str) -> dict[str, Any]:
    """Options and subcommands of `python -m name`."""

    def parse(parser: argparse.ArgumentParser, *given: Any, **more: Any) -> None:
        raise _Parsed(parser)

    with (
        mock.patch.object(argparse.ArgumentParser, "parse_known_args", parse),
        mock.patch.object(sys, "argv", [name, "--help"]),
        mock.patch.object(os, "execve", return_value=None),  # what begins again without the web's secrets
        redirect_stdout(StringIO()),
        redirect_stderr(StringIO()),
    ):
        try:
            runpy.run_module(name, run_name="__main__")
        except _Parsed as found:
            return options(found.parser)
    raise AssertionError(f"python -m {name} does not parse its arguments")


def management() -> dict[str, Any]:
    """Those of our commands of manage.py."""
    from django.core.management import get_commands, load_command_class

    return {
        name: options(load_command_class(app, name).create_parser("manage.py", name))
        for name, app in sorted(get_commands().items())
        if isinstance(app, str) and app.startswith("evaweb.")
    }


def options(parser: argparse.ArgumentParser) -> dict[str, Any]:
    """Of a parser, without its sentences."""
    found: dict[str, Any] = {}
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            found["subcommands"] = {name: options(one) for name, one in sorted(action.choices.items())}
            continue
        choices = sorted(map(str, action.choices)) if action.choices else None
        found[" ".join(action.option_strings) or f"<{action.dest}>"] = [action.nargs, choices]
    return dict(sorted(found.items()))


def configuration() -> list[str]:
    """Every key of a deployment file with its type, as the document has it."""
    lines = (ROOT / "docs" / "configuration.md").read_text("utf-8").splitlines()
    found, table = [], ""
    for line in lines:
        if line.startswith("## "):
            table = line.removeprefix("## ")
        elif line.startswith("| `"):
            key, kind, default, _ = (cell.strip() for cell in line.strip("|").split(" | ", 3))
            found.append(f"{table} {key} {kind} {default}")
    return found


def robot() -> dict[str, list[str]]:
    """Keys of robot.toml, by what has them."""
    from pydantic import BaseModel

    from robots.description import RobotTable

    found: dict[str, list[str]] = {}
    for path, model in _tables("", RobotTable, BaseModel):
        found[path] = sorted(model.model_fields)
    return found


def _tables(path: str, annotation: Any, base: type) -> Iterator[tuple[str, Any]]:
    from typing import get_args

    if isinstance(annotation, type) and issubclass(annotation, base):
        yield path, annotation
        for name, field in annotation.model_fields.items():  # type: ignore[attr-defined]
            yield from _tables(f"{path}.{name}", field.annotation, base)
    else:
        for part in get_args(annotation):
            yield from _tables(path, part, base)


def journals() -> dict[str, Any]:
    """Fields of the lines of every journal, by their kinds."""
    from evaweb.records.journal import Line

    found = {}
    for kind in _below(Line):
        named = {
            name: sorted(map(str, kind.model_fields[name].annotation.__args__))
            for name in ("kind",)
            if name in kind.model_fields and hasattr(kind.model_fields[name].annotation, "__args__")
        }
        found[f"{kind.__module__.split('.')[1]} {named.get('kind', '')}".strip()] = sorted(kind.model_fields)
    return dict(sorted(found.items()))


def _below(kind: type) -> Iterator[Any]:
    one: type
    for one in kind.__subclasses__():
        if one.__module__.startswith("evaweb."):
            yield one
            yield from _below(one)


def messages() -> dict[str, list[str]]:
    """Fields of what goes between stations and their clients."""
    from runtime.ipc.messages import Ack, Command, Event

    return {kind.__name__: [one.name for one in fields(kind)] for kind in (Command, Ack, Event)}


def snapshot() -> dict[str, Any]:
    """Keys of a station's state, from a station in lockstep that runs."""
    from tests.runtime.lockstep_station import Station, stubbed

    with TemporaryDirectory() as folder:
        state = Station(stubbed(Path(folder))).running(30).coordinator.snapshot()

    def keys(value: Any) -> Any:
        return (
            {str(name): keys(part) for name, part in sorted(value.items())}
            if isinstance(value, Mapping)
            else ""
        )

    return {name: keys(part) for name, part in sorted(state.items()) if name != "sentences"}


def columns() -> dict[str, list[str]]:
    """Columns of the tables that leave the lab."""
    from evaweb.results.reports import tables
    from runtime.recording.export import SCHEMA

    return {
        "episode": [f"{field.name} {field.type}" for field in SCHEMA],
        "trials.csv": list(tables.COLUMNS),
        "scores.csv": list(tables.SCORE_COLUMNS),
    }


def event_kinds() -> Iterator[str]:
    """Kinds that are written where an event is made."""
    for path in sorted((ROOT / "runtime").rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if isinstance(node, ast.Call) and node.args and isinstance(node.args[0], ast.Constant):
                called = (
                    node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
                )
                if called in _WORDS_OF_AN_EVENT and isinstance(node.args[0].value, str):
                    yield node.args[0].value


def main() -> None:
    """Write it anew."""
    os.environ.setdefault("DJANGO_SETTINGS_MODULE", "tests.evaweb.settings")
    import django

    django.setup()
    GOLDEN.write_text(json.dumps(surface(), indent=1, sort_keys=True, ensure_ascii=False) + "\n", "utf-8")


if __name__ == "__main__":
    main()
