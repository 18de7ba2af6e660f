import pytest

from tests.evaweb.trials import builders


@pytest.fixture(autouse=True)
def _data_dir(settings, tmp_path):
    settings.DATA_DIR = tmp_path


@pytest.fixture
def bench(db):
    return builders.bench()


@pytest.fixture
def wire(monkeypatch):
    made = builders.Wire()
    for place in ("evaweb.stations.commands", "evaweb.trials.bench"):
        monkeypatch.setattr(f"{place}.wire_to", lambda name: made)
    return made
