"""A key that is declared, documented and validated, and that nothing obeys, is a lie: each has a reader."""

from __future__ import annotations

import dataclasses
import inspect
import typing
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest
from pydantic import BaseModel

from robots.description import RobotTable
from robots.robot import Gripper, Group, Robot
from runtime.config.schema import Deployment
from runtime.core.plugins import union_members
from tests.runtime.reading import Reads, attribute_reads

ROOT = Path(__file__).parents[3]
# They print or judge what was declared. What they read is not obeyed for that.
SHOW = {"runtime.config.reference", "runtime.processes.coordinator.snapshot", "robots.inspection"}

# Read otherwise than as attributes: the module, which must name the key or hand the whole table on.
ELSEWHERE = {
    "runtime.config.schema.Deployment.tasks": (
        "runtime/processes/coordinator/snapshot.py",
        "spec.deployment.tasks",
    ),  # offered on pages
    "runtime.config.schema.GripperSettings": (
        "runtime/station/spec.py",
        "robots.GripperChoice(**choice.model_dump())",
    ),
    "runtime.config.collection.CollectionSettings.streams": (
        "runtime/recording/schema.py",
        'collection["streams"]',
    ),
    "runtime.config.collection.CollectionSettings.columns": (
        "runtime/recording/schema.py",
        'collection["columns"]',
    ),
    "runtime.config.collection.CollectionSettings.max_skew_s": (
        "runtime/recording/schema.py",
        'collection.get("max_skew_s")',
    ),
    # Read by a process that reads no deployment, of what the supervisor has resolved.
    "runtime.config.schema.PanelSettings": ("runtime/clients/panel/settings.py", '["panel"]'),
    "runtime.transports.ros.topics.GroupTopics": ("runtime/transports/ros/topics.py", '"{key}"'),
    "robots.description.RosGroupTable.eef_command": ("runtime/transports/ros/topics.py", '"{key}"'),
    "robots.description.LerobotJointTable": ("runtime/lerobot/settings.py", "features[joint].model_dump()"),
    # Without it a validator refuses what leaves this machine.
    "runtime.transports.ros1.Link.insecure_link": ("runtime/transports/ros1.py", "self.insecure_link"),
    "runtime.transports.ros2.Link.insecure_link": ("runtime/transports/ros2.py", "self.insecure_link"),
    "runtime.transports.zmq.Config.insecure_link": ("runtime/transports/zmq.py", "self.insecure_link"),
    "runtime.teleoperators.zmq.Config.insecure_link": ("runtime/teleoperators/zmq.py", "self.insecure_link"),
    # "Where the limits come from": for people alone, required, and printed by `robots check`.
    "robots.robot.Robot.limits_source": ("robots/inspection.py", "robot.limits_source"),
    "robots.robot.Robot.overrides": (
        "robots/limits.py",
        "limits.overrides",
    ),  # sentences, made there
}
TUNNELLED = ("runtime/policies/tunnel/policy.py", '"tunnel"')


def keys(*roots: type) -> Iterator[tuple[type, str, frozenset[str]]]:
    """Every field of every table below `roots`: the class that declares it, its name, all classes it may be read of."""
    seen: list[type] = []
    for root in roots:
        _tables(root, seen)
    for table in seen:
        classes = frozenset(_name(base) for base in table.__mro__)
        for name in _fields(table):
            owner = next(base for base in table.__mro__ if name in inspect.get_annotations(base))
            yield owner, name, classes


def _tables(annotation: Any, seen: list[type]) -> None:
    is_class = isinstance(annotation, type) and annotation not in seen
    if is_class and (issubclass(annotation, BaseModel) or dataclasses.is_dataclass(annotation)):
        seen.append(annotation)
        for inner in _fields(annotation).values():
            _tables(inner, seen)
    for part in union_members(annotation):
        _tables(part, seen)


def _fields(table: type) -> Mapping[str, Any]:
    if issubclass(table, BaseModel):
        return {name: field.annotation for name, field in table.model_fields.items()}
    hints = typing.get_type_hints(table)
    return {field.name: hints[field.name] for field in dataclasses.fields(table)}


def _name(kind: type) -> str:
    return f"{kind.__module__}.{kind.__qualname__}"


def unread(reads: Reads, *roots: type) -> set[str]:
    """The keys that no module reads, but to show them."""
    found = set()
    for owner, name, classes in keys(*roots):
        # Sections of several kinds are typed as what they have in common.
        common = {
            f"runtime.config.schema.{part}" for part in ("Variant", "StrategyConfig", "KinematicsConfig")
        }
        readers = {
            module
            for kind in classes | (common if name == "kind" else set())
            for module in reads.get((kind, name), ())
        }
        if not readers - SHOW:
            found.add(f"{_name(owner)}.{name}")
    return found


def modules() -> dict[str, Path]:
    found = {}
    for package in ("runtime", "robots"):
        for path in sorted((ROOT / package).rglob("*.py")):
            parts = path.relative_to(ROOT).with_suffix("").parts
            found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


def excused(key: str) -> tuple[str, str] | None:
    """Where a key is read otherwise, and by which words; None where nowhere."""
    name = key.rsplit(".", 1)[1]
    where = TUNNELLED if name == "tunnel" else ELSEWHERE.get(key) or ELSEWHERE.get(key.rsplit(".", 1)[0])
    return (
        None if where is None else (where[0], where[1].format(key=name) if "{key}" in where[1] else where[1])
    )


@pytest.mark.exhaustive
def test_every_declared_key_is_read_by_what_it_is_for() -> None:
    silent = unread(attribute_reads(modules(), ROOT), Deployment, RobotTable, Robot, Group, Gripper)
    lies = []
    for key in sorted(silent):
        where = excused(key)
        if where is None or where[1] not in (ROOT / where[0]).read_text("utf-8"):
            lies.append(key)
    assert lies == []
    used = {name for name in ELSEWHERE if any(key == name or key.startswith(f"{name}.") for key in silent)}
    assert used == set(ELSEWHERE), "no longer needed"


@pytest.mark.exhaustive
def test_a_key_that_is_only_checked_and_shown_is_found(tmp_path: Path) -> None:
    class Table(BaseModel):
        obeyed: int = 1
        checked: int = 2
        shown: int = 3
        forgotten: int = 4

    (tmp_path / "pyproject.toml").write_text("[tool.mypy]\nstrict = true\n")
    sources = {
        "settings": "from pydantic import BaseModel, model_validator\n\n\nclass Table(BaseModel):\n"
        "    obeyed: int = 1\n    checked: int = 2\n    shown: int = 3\n    forgotten: int = 4\n\n"
        '    @model_validator(mode="after")\n    def _check(self) -> "Table":\n'
        "        assert self.checked\n        return self\n",
        "robots_inspection": "from settings import Table\n\n\ndef show(table: Table) -> int:\n    return table.shown\n",
        "doing": "from settings import Table\n\n\ndef do(tables: list[Table | None]) -> list[int]:\n"
        "    return [table.obeyed for table in tables if table]\n",
    }
    for name, text in sources.items():
        (tmp_path / f"{name}.py").write_text(text)
    found = attribute_reads({name: tmp_path / f"{name}.py" for name in sources}, tmp_path)
    reads = {
        (_name(Table), name): {module.replace("robots_", "robots.") for module in readers}
        for (_, name), readers in found.items()
    }
    assert unread(reads, Table) == {f"{_name(Table)}.{name}" for name in ("checked", "shown", "forgotten")}
