"""People, stations, and runtimes without robots."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterator
from pathlib import Path
from uuid import uuid4

import pytest
from django.conf import settings
from django.contrib.auth.models import Group, User
from django.db import Error, connections
from django.test import TransactionTestCase
from pytest_django import DjangoDbBlocker

from evaweb.core.errors import NotFound
from evaweb.serving import computations
from evaweb.serving.computations import Busy
from evaweb.stations import commands, stops
from evaweb.stations.models import Command, Station
from evaweb.trials import selectors as trial_selectors
from tests import migrated
from tests.evaweb.as_migrated import CHECK, AsMigrated
from tests.evaweb.stand_in import FakeStation
from tests.evaweb.trials import builders
from tests.processes import PATIENCE_S


@pytest.fixture(autouse=True)
def _noted_in_the_tests_own_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    """Threads see nothing of a test's transaction. Within an event loop they are the real ones."""
    note = commands.notes.record

    def here(row: Command) -> None:
        try:
            asyncio.get_running_loop()
        except RuntimeError:
            _written(row)
        else:
            note(row)

    monkeypatch.setattr(commands.notes, "record", here)


@pytest.fixture(autouse=True)
def _estops_are_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    """As long as EVA_COMMAND_TIMEOUT_S says: a press that a slow machine answers late is no press without answer."""
    monkeypatch.setattr(stops, "_ESTOP_S", PATIENCE_S)


@pytest.fixture(autouse=True)
def _computing_has_no_end(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nobody's budget is used up, and no slow machine is a refusal."""
    here = computations.Questions(
        lambda work, *given: (work(*given), 0.0), patience_s=PATIENCE_S, soon_s=PATIENCE_S
    )
    monkeypatch.setattr(computations, "questions", here)


@pytest.fixture(autouse=True)
def _no_summaries_of_another_test() -> None:
    """Its rows were rolled back, which no lab's are."""
    trial_selectors._known.clear()


def _written(row: Command) -> None:
    try:
        commands._stored_row(row)
    except Error:
        commands.unwritten.store(row)
    except NotFound as fault:
        commands.log.error("%s is not written down: %s", row, fault)


@pytest.fixture(scope="session")
def django_db_keepdb(django_db_modify_db_settings: None) -> bool:
    """The tests' database begins as a copy of one that is made once: every worker would make the same for seconds."""
    database = connections["default"]
    if database.vendor == "sqlite":
        migrated.copy_to(Path(database.settings_dict["TEST"]["NAME"]))
    return database.vendor == "sqlite"


@pytest.fixture(scope="session")
def django_db_setup(
    request: pytest.FixtureRequest, django_db_setup: None, django_db_blocker: DjangoDbBlocker
) -> Iterator[None]:
    """After a test with transactions Django empties all tables; tests count on what migrations wrote into some."""
    with django_db_blocker.unblock():
        kept = AsMigrated()

    def check() -> None:
        with django_db_blocker.unblock():
            kept.check()

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(TransactionTestCase, "_fixture_teardown", lambda case: kept.empty())
        request.config.stash[CHECK] = check
        yield
        del request.config.stash[CHECK]


@pytest.hookimpl(wrapper=True)
def pytest_runtest_teardown(item: pytest.Item) -> Iterator[None]:
    """A test that left the database without what migrations wrote is named: others would fail in its place."""
    try:
        return (yield)
    finally:
        item.config.stash.get(CHECK, lambda: None)()


def person(name: str, *groups: str) -> User:
    user = User.objects.create_user(name)
    user.groups.add(*(Group.objects.get_or_create(name=group)[0] for group in groups))
    return user


@pytest.fixture
def ann(db: None) -> User:
    """An operator."""
    return person("ann", "operator")


@pytest.fixture
def bob(db: None) -> User:
    """Another operator."""
    return person("bob", "operator")


@pytest.fixture
def vera(db: None) -> User:
    """A viewer."""
    return person("vera")


@pytest.fixture
def alma(db: None) -> User:
    """An administrator."""
    return person("alma", "admin")


@pytest.fixture
def nobody_computes(monkeypatch: pytest.MonkeyPatch) -> None:
    """The planner's process is busy: no test that asks every address waits for what it computes."""

    def busy(*asked: object, soon: bool = False) -> None:
        raise Busy("it computes for others")

    monkeypatch.setattr("evaweb.serving.computations.questions.result", busy)


@pytest.fixture
def make_stand_in() -> Iterator[Callable[..., FakeStation]]:
    """Starts runtimes; they end with the test. Each has a name of its own: wires and feeds are kept by name."""
    made: list[FakeStation] = []

    def make(ttl: float = 5.0) -> FakeStation:
        made.append(FakeStation(settings.DATA_DIR, f"bench-{uuid4().hex[:12]}", ttl))
        return made[-1]

    yield make
    for one in made:
        one.end()


@pytest.fixture
def runtime(make_stand_in: Callable[..., FakeStation]) -> FakeStation:
    """A runtime that waits for its first observation."""
    return make_stand_in()


@pytest.fixture
def live(runtime: FakeStation, db: None) -> Station:
    """The station whose runtime is `runtime`."""
    return Station.objects.create(name=runtime.name, robot="agilex_piper", title="Bench 1")


@pytest.fixture
def bench(db: None) -> builders.TrialBench:
    """A station without a runtime, with all that a trial is made of."""
    return builders.bench()


@pytest.fixture
def wire(monkeypatch: pytest.MonkeyPatch) -> builders.FakeConnection:
    """What stands where wires to runtimes stand."""
    made = builders.FakeConnection()
    places = (
        "stations.commands",
        "stations.stops",
        "stations.leases",
        "api.stations",
        "trials.station_commands",
    )
    for place in places:
        monkeypatch.setattr(f"evaweb.{place}.connection_to", lambda name: made)
    return made
