"""Who sleeps is woken by what is put into the shared state for it, and by nothing else."""

from __future__ import annotations

import os
import select
from collections.abc import Callable, Iterator

import pytest

from runtime.ipc.bells import Bell, bells
from runtime.ipc.shared_state import WOKEN, EStop, SharedState, SharedStateLayout
from tests.processes import PATIENCE_S

LAYOUT = SharedStateLayout(dim=2, eef_dim=8, cameras=(), picture_bytes=16)


@pytest.fixture
def shared() -> Iterator[SharedState]:
    made, descriptor = SharedState.create(LAYOUT)
    made.hang([Bell.create() for _ in WOKEN])
    yield made
    for bell in made.bells.values():
        bell.close()
    os.close(descriptor)


def rung(shared: SharedState) -> set[str]:
    """Whose bells were rung since the last time."""
    found = {name for name, bell in shared.bells.items() if select.select([bell.descriptor], [], [], 0)[0]}
    for bell in shared.bells.values():
        bell.hush()
    return found


@pytest.mark.parametrize(
    ("put", "wakes"),
    [
        (lambda shared: shared.rings["presses"].push(b"x"), {"guard"}),
        (lambda shared: shared.request_release(), {"guard"}),
        (lambda shared: shared.rings["minutes"].push(b"x"), {"media"}),
        (lambda shared: shared.rings["observations"].push(b"x"), {"media"}),
        (lambda shared: shared.rings["ticks"].push(b"x"), set()),
        (lambda shared: shared.rings["orders"].push(b"x"), set()),
        (lambda shared: shared.rings["control_events"].push(b"x"), {"coordinator"}),
        (lambda shared: shared.rings["reception_events"].push(b"x"), {"coordinator"}),
        (lambda shared: shared.rings["media_events"].push(b"x"), {"coordinator"}),
        (lambda shared: shared.set_estop(EStop.LATCHED), {"coordinator"}),
    ],
)
def test_each_message_wakes_its_reader(
    shared: SharedState, put: Callable[[SharedState], object], wakes: set[str]
) -> None:
    put(shared)
    assert rung(shared) == wakes
    assert rung(shared) == set()


def test_what_was_rung_before_the_wait_ends_it_once() -> None:
    bell = Bell.create()
    bell.ring()
    bell.ring()
    bell.wait(PATIENCE_S)  # or the test does not end
    assert not select.select([bell.descriptor], [], [], 0)[0]
    bell.close()


def test_an_inherited_bell_is_the_same_one() -> None:
    first, second = Bell.create(), Bell.create()
    _, inherited = bells(f"{first.descriptor},{second.descriptor}")
    inherited.ring()
    second.wait(PATIENCE_S)
    assert not select.select([first.descriptor], [], [], 0)[0]
    first.close()
    second.close()
