"""A bundle of the lab of tests/evaweb/blinding/test_visibility.py, whose runtime says secrets wherever it can."""

import zipfile

import pytest

from evaweb.blinding.visibility import visibility_for_user
from evaweb.lab.diagnosis import bundle
from evaweb.plans.blinding_rules import record_unblinding
from tests.evaweb.blind_lab import NAMES, SECRETS, BlindLab
from tests.evaweb.episodes.conftest import recorded  # noqa: F401  a fixture

pytestmark = [pytest.mark.django_db(transaction=True), pytest.mark.slow]


@pytest.fixture(autouse=True)
def data(settings, tmp_path, monkeypatch):
    """Before the runtime, which has its sockets there."""
    settings.DATA_DIR = tmp_path
    monkeypatch.setattr("evaweb.jobs.doorbell.notify_workers", lambda queue: True)


@pytest.fixture
def lab(live, runtime, ann, recorded, settings, tmp_path):  # noqa: F811
    """A frozen plan, a runtime that says secrets, logs that name them."""
    made = BlindLab(live, runtime, ann, recorded["finished"], settings.DATA_DIR)
    (tmp_path / "logs").mkdir(exist_ok=True)
    (tmp_path / "logs" / f"policy-{SECRETS[0]}.log").write_text(f"serving {SECRETS[0]}\n")
    return made


def told(folder, user):
    path = folder / "bundle.zip"
    bundle.write(path, visibility_for_user(user), lambda part: None)
    with zipfile.ZipFile(path) as packed:
        return "".join(name + packed.read(name).decode() for name in packed.namelist())


def test_no_stage_of_a_trial_tells_a_blind_administrator_of_its_checkpoint(lab, alma, settings):
    lab.operator = alma  # an administrator who runs its trials is as blind as any operator
    for stage in ("allocate", "running", "failed", "scored"):
        getattr(lab, stage)()
        text = told(settings.DATA_DIR, alma)
        assert [secret for secret in SECRETS if secret in text] == [], stage
        assert '"veiled": true' in text, stage


def test_who_has_looked_is_told(lab, settings):
    lab.allocate()
    lab.running()
    record_unblinding(lab.plan, lab.owner)
    text = told(settings.DATA_DIR, lab.owner)
    assert NAMES[0] in text or NAMES[1] in text
    assert '"snapshot"' in text
    assert f"serving {SECRETS[0]}" in text
