"""Where a panel listens, and by which names it may be reached."""

from __future__ import annotations

import pytest

from runtime.clients.panel.__main__ import main
from runtime.clients.panel.settings import PanelPlace
from runtime.config.schema import PanelSettings
from runtime.core.errors import ConfigurationError


@pytest.mark.parametrize(
    ("host", "known"),
    [
        ("localhost:8480", True),
        ("LOCALHOST.", True),
        ("127.0.0.1:8480", True),
        ("[::1]:8480", True),
        ("192.168.1.20", True),
        ("robot-7.lab:8480", True),
        ("robot-7.lab.evil.example:8480", False),
        ("evil.example", False),
        ("", False),
        ("127.0.0.1.evil.example", False),
        ("localhost:8480@evil.example", False),
    ],
)
def test_a_host_is_known_by_its_names_and_by_addresses_in_numbers(host, known):
    assert PanelPlace("0.0.0.0", 8480, frozenset(["robot-7.lab"])).knows(host) is known


@pytest.mark.parametrize("host", ["0.0.0.0", "192.168.1.20", "::"])
def test_beyond_this_machine_a_certificate_is_asked_for(host):
    with pytest.raises(ConfigurationError, match="beyond this machine it needs"):
        PanelSettings(host=host)
    assert PanelSettings(host=host, certificate="a.pem", key="b.pem").host == host


@pytest.mark.parametrize(
    ("settings", "sentence"),
    [
        ({"certificate": "a.pem"}, "belong together"),
        ({"host": "robot.example"}, "must be an address in numbers"),
    ],
)
def test_what_does_not_fit_is_refused(settings, sentence):
    with pytest.raises(ConfigurationError, match=sentence):
        PanelSettings(**settings)


def test_a_certificate_that_cannot_be_read_is_named(tmp_path):
    place = PanelPlace("127.0.0.1", 0, certificate=str(tmp_path / "none.pem"), key=str(tmp_path / "none.pem"))
    with pytest.raises(ConfigurationError, match=r"none\.pem.*No such file"):
        place.context()


@pytest.mark.parametrize(
    ("resolved", "sentence"), [(None, "is not known here"), ('{"panel": null}', "has no [panel]: add one")]
)
def test_a_station_without_a_panel_is_a_sentence(tmp_path, capsys, monkeypatch, resolved, sentence):
    monkeypatch.setattr("runtime.clients.panel.__main__.logs.configure_logging", lambda process: None)
    folder = tmp_path / "stations" / "bench-1"
    folder.mkdir(parents=True)
    if resolved:
        (folder / "resolved.json").write_text(resolved)
    assert main(["bench-1", "--data-dir", str(tmp_path)]) == 2
    assert sentence in capsys.readouterr().err
