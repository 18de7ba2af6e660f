import shutil
from pathlib import Path

import pytest

from tests.e2e.lab import CHROMIUM, NO_CHROMIUM, Demo, browsing

# A machine whose cores draw pictures, encode and browse at once is late now and then. These labs wait for what is late
# instead of holding; what holds when is asked of `shared`, of tests/crash, and of the runtime's own tests.
PATIENT = {
    "bus.preview_rate": 5,
    "control.heartbeat_timeout_s": 10,
    "control.coordinator_timeout_s": 10,
    "control.orphan_hold_s": 0.5,  # each lab waits for it at its end
    "control.starvation_hold_s": 10,
    "recording.heartbeat_timeout_s": 20,
    "faults.patience_s": 20,
    "safety.following_error": 3,
    "safety.joint_age_s": 5,
    "safety.picture_age_s": 10,
    "lease.ttl_s": 20,
}
SMALL = "--pictures=400x300"  # less processor time; those of --once and of tests/crash are whole
SETS = [SMALL, *(f"--set={key}={value}" for key, value in PATIENT.items())]
LOCKSTEP = [
    "--lockstep",
    SMALL,
    "--set=bus.preview_rate=5",
    "--set=lease.ttl_s=20",
]  # the web is in real time
# Of a lab whose programs may be killed: starvation, patience and leases strike there, what a slow machine does not.
SHARED = {
    name: PATIENT[name] for name in PATIENT if name.partition(".")[0] in ("control", "safety", "recording")
}
SHARED |= {"control.starvation_hold_s": 1, "lease.ttl_s": 10}
FIRST, LAST = (
    "test_story",
    ("test_plan", "test_plan_wizard", "test_lifetime"),
)  # it sees a fresh lab; they leave it blind, or end it
LABS = ("patient", "shared")
running: dict[str, Demo] = {}  # by the name of the fixture


def pytest_collection_modifyitems(items):
    """Those of one lab after each other, so that it can end before anything else begins: two are too much at once."""

    def place(item):
        used = [number for number, lab in enumerate(LABS) if lab in item.fixturenames]
        stem = item.path.stem
        return (used or [len(LABS)])[0], stem != FIRST, 1 + LAST.index(stem) if stem in LAST else 0

    items.sort(key=place)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_teardown(item, nextitem):
    """End each lab after the last test that uses it, also where a fixture fails at its end; a bad end is shown."""
    try:
        return (yield)
    finally:
        for name in [name for name in running if nextitem is None or name not in nextitem.fixturenames]:
            lab = running.pop(name)
            if lab.runs:
                assert lab.end() == 0, (lab.folder / "demo.log").read_text()[-2000:]


@pytest.fixture(scope="session")
def patient(tmp_path_factory):
    """A lab with more people and a dead checkpoint, whose station collects too and waits for a slow machine."""
    running["patient"] = lab = (
        Demo(tmp_path_factory.mktemp("patient"), "--collect", *LOCKSTEP).start().people()
    )
    return lab


@pytest.fixture(scope="session")
def shared(tmp_path_factory):
    """A lab with more people and a dead checkpoint, whose programs may be killed."""
    folder, sets = (
        tmp_path_factory.mktemp("shared"),
        [f"--set={key}={value}" for key, value in SHARED.items()],
    )
    running["shared"] = lab = Demo(folder, SMALL, *sets, EVA_JOB_STALE_S="6").start().people()
    return lab


@pytest.fixture(scope="module")
def browser():
    if not (shutil.which("chromium") or Path(CHROMIUM).exists()):
        pytest.skip(NO_CHROMIUM)
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright, browsing(playwright) as opened:
        yield opened
