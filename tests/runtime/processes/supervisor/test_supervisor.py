import errno
import subprocess
from pathlib import Path

import pytest

from runtime.config.loader import load
from runtime.core.errors import SetupError, TransportError
from runtime.ipc.bus import Endpoints
from runtime.link.key_files import known_lab_path
from runtime.processes.supervisor import supervisor
from runtime.processes.supervisor.supervisor import Supervisor
from runtime.station.checks import check_deployment

DEMO = Path(__file__).parents[4] / "deployments" / "demo.toml"
WAITS = ["cat"]  # like our children it ends with its standard input
DIES = ["false"]
DEAF = ["sh", "-c", "trap '' TERM; echo deaf > $DEAF; while true; do sleep 0.05; done"]


@pytest.fixture
def started(monkeypatch):
    """What was started in place of each process, in order."""
    made = []
    real = subprocess.Popen
    modules = {**supervisor._MODULES, "channel": supervisor._CHANNEL, "link": supervisor._LINK}
    modules |= {"panel": supervisor._PANEL}

    class Started(real):
        commands = dict.fromkeys(
            ("guard", "reception", "media", "control", "coordinator", "headless", "channel", "link", "panel"),
            WAITS,
        )

        def __init__(self, arguments, **options):
            self.process = {module: name for name, module in modules.items()}[arguments[2]]
            self.environment = options["env"]
            super().__init__(self.commands[self.process], **options, stdout=subprocess.DEVNULL)
            made.append(self)

    monkeypatch.setattr(supervisor.subprocess, "Popen", Started)
    monkeypatch.setattr(supervisor.signal, "signal", lambda *_: None)
    monkeypatch.setattr(supervisor, "_LOOK_S", 0.005)
    monkeypatch.delenv("EVA_LOG_LEVEL", raising=False)
    made_commands = Started.commands
    yield made, made_commands
    for child in made:
        child.kill()
        child.wait()


@pytest.fixture
def station(tmp_path):
    return Supervisor(check_deployment(load(DEMO, [f'data_dir="{tmp_path}"'])))


def all_ended(made):
    return all(child.poll() is not None for child in made)


def test_the_end_of_what_drives_a_headless_run_ends_the_family(station, started):
    made, commands = started
    commands["headless"] = ["sh", "-c", "exit 3"]
    assert station.run(headless=True) == 3
    assert [child.process for child in made] == [
        "guard",
        "reception",
        "media",
        "control",
        "coordinator",
        "headless",
    ]
    assert all_ended(made)


def test_a_family_that_gives_up_takes_its_driver_with_it(station, started):
    made, commands = started
    commands["control"] = DIES
    assert station.run(headless=True) == 1
    assert [child.process for child in made].count("control") == 6
    assert all_ended(made)


@pytest.mark.parametrize(
    ("companion", "setting"), [("channel", "control_channel.enabled=true"), ("panel", "panel.port=0")]
)
def test_a_companion_that_dies_does_not_end_the_family_and_ends_with_it(
    tmp_path, started, companion, setting
):
    made, commands = started
    sets = [f'data_dir="{tmp_path}"', setting]
    commands[companion], commands["headless"] = DIES, ["sh", "-c", "sleep 0.3; exit 4"]
    assert Supervisor(check_deployment(load(DEMO, sets))).run(headless=True) == 4
    names = [child.process for child in made]
    assert names == ["guard", "reception", "media", "control", "coordinator", companion, "headless"]
    commands[companion] = WAITS
    assert Supervisor(check_deployment(load(DEMO, sets))).run(headless=True) == 4
    assert all_ended(made)


def test_a_station_that_is_enrolled_meanwhile_is_linked_and_the_link_ends_with_it(tmp_path, started):
    made, commands = started
    spec = check_deployment(load(DEMO, [f'data_dir="{tmp_path}"']))
    enrolled, linked = known_lab_path(spec.deployment.station_dir), tmp_path / "linked"
    commands["link"] = ["sh", "-c", f"touch '{linked}'; exec cat"]
    # As `python -m runtime.keys enrol` does, once the family is up; it ends when its link has begun.
    ending = f"touch '{enrolled}'; until [ -e '{linked}' ]; do sleep 0.01; done; exit 4"
    commands["headless"] = ["sh", "-c", ending]
    assert Supervisor(spec).run(headless=True) == 4
    names = [child.process for child in made]
    assert names == ["guard", "reception", "media", "control", "coordinator", "headless", "link"]
    assert all_ended(made)


def test_a_driver_that_does_not_listen_is_killed(station, started, tmp_path, monkeypatch, caplog):
    made, commands = started
    deaf = tmp_path / "deaf"
    monkeypatch.setattr(supervisor, "_DRIVER_PATIENCE_S", 0.05)
    station._environment["DEAF"] = str(deaf)
    commands["headless"] = DEAF
    commands["coordinator"] = ["sh", "-c", 'while [ ! -e "$DEAF" ]; do sleep 0.01; done']
    assert station.run(headless=True) == 1
    assert all_ended(made)
    assert "headless does not end: killed" in caplog.text


@pytest.mark.parametrize(
    ("headless", "given", "level"),
    [(True, None, "WARNING"), (False, None, None), (True, "DEBUG", "DEBUG")],
)
def test_headless_the_processes_log_only_what_matters_unless_told_otherwise(
    tmp_path, started, monkeypatch, headless, given, level
):
    made, commands = started
    commands["coordinator"] = DIES  # so that it ends
    if given:
        monkeypatch.setenv("EVA_LOG_LEVEL", given)
    Supervisor(check_deployment(load(DEMO, [f'data_dir="{tmp_path}"']))).run(headless)
    assert {child.environment.get("EVA_LOG_LEVEL") for child in made} == {level}


def test_a_full_disk_does_not_keep_a_process_from_being_restarted(station, started, monkeypatch, caplog):
    made, commands = started
    write = Path.write_text

    def full(path, *arguments):
        if path.parent.name == "endpoints":
            raise OSError(errno.ENOSPC, "No space left on device")
        return write(path, *arguments)

    monkeypatch.setattr(Path, "write_text", full)
    commands["media"] = DIES
    assert station.run(headless=False) == 1  # because it gives up after so many restarts, not before
    assert [child.process for child in made].count("media") == 6
    assert "No space left on device" in caplog.text
    assert all_ended(made)


def test_a_disk_that_is_full_at_the_start_is_a_sentence(station, started, monkeypatch):
    def full(path, *arguments):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(supervisor.Path, "write_text", full)
    with pytest.raises(SetupError, match=r"stations/demo cannot be written \(No space left on device\)"):
        station.run(headless=False)
    assert started[0] == []


def test_nothing_is_found_of_a_station_that_has_ended(station, started, tmp_path):
    started[1]["headless"] = DIES
    station.run(headless=True)
    with pytest.raises(TransportError, match="is not running here"):
        Endpoints(tmp_path / "stations" / "demo").read("supervisor")


@pytest.mark.parametrize("spoil", ["rm -r {0}", "echo garbage > {0}/supervisor.json"])
def test_what_somebody_did_to_its_file_is_mended(station, started, spoil):
    _, commands = started
    folder = station._station_dir / "endpoints"
    there = f"until grep -q boot {folder}/supervisor.json; do sleep 0.02; done"
    commands["headless"] = ["sh", "-c", f"{there}; {spoil.format(folder)}; {there}; exit 3"]
    assert station.run(headless=True) == 3
