"""A run starts again from its manifest: the same deployment, and a line about each thing that differs."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import pytest

from runtime import __main__ as command_line
from runtime.config import loader
from runtime.core.errors import ConfigurationError
from runtime.recording.files import to_json
from runtime.recording.reader import open_episode
from runtime.station import rerun
from runtime.station.rerun import find_episode
from runtime.station.run import Provenance
from tests.runtime.lockstep_station import stubbed

ONE = "1a2b3c4d-0000-4000-8000-000000000001"
CLEAN = {"commit": "c" * 40, "dirty": False}
OTHER = "1a2b9999-0000-4000-8000-000000000002"


def kept(data: Path, run: str = ONE, mode: str = "continuous", **changes: Any) -> dict[str, Any]:
    """The manifest of an episode in `data`, as a station writes it, with `changes`."""
    manifest = Provenance(stubbed(data, strategy="sync").spec, "boot-1").manifest(mode, None)
    manifest |= {"uuid": run, "git": CLEAN} | changes
    folder = data / "episodes" / run
    folder.mkdir(parents=True)
    (folder / "manifest.json").write_bytes(to_json(manifest, "the manifest", indent=1))
    return manifest


def line(lines: tuple[str, ...], name: str) -> str:
    """What is said of `name`."""
    (found,) = [text for text in lines if text.startswith(name)]
    return found.removeprefix(name).strip()


@pytest.fixture(autouse=True)
def _committed(monkeypatch: pytest.MonkeyPatch) -> None:
    """We run from a clean checkout."""
    monkeypatch.setattr(rerun, "revision", lambda: CLEAN)
    monkeypatch.delenv("EVA_DATA_DIR", raising=False)


# --- which run ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("given", [ONE, "1a2b3", "1A2B3C4D-", f" {ONE} "])
def test_how_its_uuid_begins_is_enough(tmp_path: Path, given: str) -> None:
    kept(tmp_path, ONE)
    kept(tmp_path, OTHER)
    assert find_episode(given, tmp_path) == tmp_path / "episodes" / ONE


@pytest.mark.parametrize(
    ("given", "sentence"),
    [
        ("1a2b", f"2 episodes begin so: {ONE}, {OTHER}"),
        ("ffff", r"no episode in .*/episodes begins so; name another data folder with --data-dir"),
        ("", "must be the uuid of a run"),
        ("../episodes", "must be the uuid of a run"),
        ("1a*", "must be the uuid of a run"),
    ],
)
def test_what_is_no_one_run_is_a_sentence(tmp_path: Path, given: str, sentence: str) -> None:
    kept(tmp_path, ONE)
    kept(tmp_path, OTHER)
    with pytest.raises(ConfigurationError, match=sentence):
        find_episode(given, tmp_path)


def test_a_data_folder_without_episodes_is_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match=rf"there are no episodes in {tmp_path}; .* --data-dir"):
        find_episode(ONE, tmp_path)


# --- what it was made with ---------------------------------------------------------------------------------


def test_nothing_differs_where_nothing_was_changed(tmp_path: Path) -> None:
    manifest = kept(tmp_path, trial={"id": 3})
    found = rerun.rerun(ONE, tmp_path)
    assert found.resolved.digest == manifest["configuration_hash"]
    assert found.resolved.tree == manifest["configuration"]
    assert line(found.lines, "versions") == "the same"
    assert line(found.lines, "git") == "the same, cccccccccccc"
    assert line(found.lines, "hash") == f"the same, {manifest['configuration_hash'][:12]}"
    told = line(found.lines, "run")
    assert told.startswith(ONE)
    assert told.endswith("station bench, mode continuous, strategy sync, task 'stack the cups'")


def test_each_thing_that_differs_is_told_in_a_line(tmp_path: Path) -> None:
    manifest = kept(tmp_path, git={"commit": "a" * 40, "dirty": True})
    manifest["versions"] |= {"numpy": "1.0", "torch": "2.0"}
    (tmp_path / "episodes" / ONE / "manifest.json").write_bytes(to_json(manifest, "the manifest"))
    found = rerun.rerun(ONE, tmp_path, ["strategy.k_max=3"])
    assert "numpy 1.0 then, " in line(found.lines, "versions")
    assert "torch 2.0 then, none now" in line(found.lines, "versions")
    assert line(found.lines, "git") == "aaaaaaaaaaaa with changes then, cccccccccccc now"
    then, now = manifest["configuration_hash"][:12], found.resolved.digest[:12]
    assert line(found.lines, "hash") == f"{then} then, {now} now: strategy.k_max null -> 3"
    assert len(found.lines) == 4


@pytest.mark.parametrize("then", [{}, None, {"commit": "c" * 40, "dirty": True}])
def test_what_was_not_committed_or_not_known_never_counts_as_the_same(tmp_path: Path, then: object) -> None:
    kept(tmp_path, git=then)
    assert "the same" not in line(rerun.rerun(ONE, tmp_path).lines, "git")


def test_what_the_run_was_asked_for_is_part_of_it(tmp_path: Path) -> None:
    kept(tmp_path, mode="sim", sim_state="live", duration_s=7.5)
    found = rerun.rerun(ONE, tmp_path)
    run = found.resolved.deployment.run
    assert (run.mode, run.sim_state, run.duration_s) == ("sim", "live", 7.5)
    assert 'run.mode "continuous" -> "sim"' in line(found.lines, "hash")


def test_a_recording_without_a_run_is_the_deployment_it_was_made_with(tmp_path: Path) -> None:
    kept(tmp_path, mode="observe")
    assert rerun.rerun(ONE, tmp_path).resolved.deployment.run.mode == "continuous"


def test_it_writes_where_the_run_was_found(tmp_path: Path) -> None:
    kept(tmp_path / "then")
    moved = (tmp_path / "then").rename(tmp_path / "now")
    found = rerun.rerun(ONE, moved)
    assert found.resolved.deployment.data == moved
    assert line(found.lines, "hash").count("->") == 1, "and only that differs"


def test_settings_that_there_were_not_yet_have_their_defaults(tmp_path: Path) -> None:
    manifest = kept(tmp_path)
    old = {name: value for name, value in manifest["configuration"].items() if name != "faults"}
    old["run"] = {"duration_s": None}
    changed = manifest | {"configuration": old, "configuration_hash": loader.config_digest(old)}
    for key in ("versions", "git"):
        del changed[key]
    (tmp_path / "episodes" / ONE / "manifest.json").write_bytes(to_json(changed, "the manifest"))
    found = rerun.rerun(ONE, tmp_path)
    assert found.resolved.digest == manifest["configuration_hash"]
    assert "faults.policy_error (none) -> " in line(found.lines, "hash")
    assert line(found.lines, "versions") == "of then are not known"


def test_the_ports_of_a_bus_of_before_say_nothing_of_what_was_done(tmp_path: Path) -> None:
    manifest = kept(tmp_path)
    old = dict(manifest["configuration"])
    old["bus"] = old["bus"] | {"host": "127.0.0.1", "command_port": 5, "estop_port": 0}
    changed = manifest | {"configuration": old, "configuration_hash": loader.config_digest(old)}
    (tmp_path / "episodes" / ONE / "manifest.json").write_bytes(to_json(changed, "the manifest"))
    assert rerun.rerun(ONE, tmp_path).resolved.digest == manifest["configuration_hash"]


# --- what keeps it from starting ---------------------------------------------------------------------------


def test_a_manifest_that_was_altered_is_refused(tmp_path: Path) -> None:
    manifest = kept(tmp_path)
    manifest["configuration"]["strategy"]["blend_window"] = 99
    (tmp_path / "episodes" / ONE / "manifest.json").write_bytes(to_json(manifest, "the manifest"))
    with pytest.raises(ConfigurationError, match=r"configuration has the hash .* was altered since"):
        rerun.rerun(ONE, tmp_path)


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"configuration": {}}, "has no configuration: that run cannot be started again"),
        ({"configuration_hash": ""}, "has no configuration_hash"),
    ],
)
def test_what_a_manifest_lacks_is_named(tmp_path: Path, changes: dict[str, Any], sentence: str) -> None:
    kept(tmp_path, **changes)
    with pytest.raises(ConfigurationError, match=sentence):
        rerun.rerun(ONE, tmp_path)


def test_a_manifest_that_is_torn_or_absent_is_named(tmp_path: Path) -> None:
    kept(tmp_path)
    path = tmp_path / "episodes" / ONE / "manifest.json"
    path.write_text("{")
    with pytest.raises(ConfigurationError, match=r"manifest\.json is not a whole JSON document"):
        rerun.rerun(ONE, tmp_path)
    path.unlink()
    with pytest.raises(ConfigurationError, match=r"manifest\.json cannot be read"):
        rerun.rerun(ONE, tmp_path)


def test_a_setting_that_is_none_any_more_is_named_with_its_run(tmp_path: Path) -> None:
    manifest = kept(tmp_path)
    manifest["configuration"]["control"]["magic"] = 7
    manifest["configuration_hash"] = loader.config_digest(manifest["configuration"])
    (tmp_path / "episodes" / ONE / "manifest.json").write_bytes(to_json(manifest, "the manifest"))
    with pytest.raises(ConfigurationError, match=rf"configuration of run {ONE}.*(?s:.)*magic"):
        rerun.rerun(ONE, tmp_path)


# --- the command line --------------------------------------------------------------------------------------


def test_check_prints_what_differs_and_the_deployment(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    manifest = kept(tmp_path)
    given = ["--from-run", "1a2b3", "--data-dir", str(tmp_path), "--check"]
    assert command_line.main([*given, "--set", "strategy.kind=async"]) == 0
    said = capsys.readouterr().out
    assert 'strategy.kind "sync" -> "async"' in said
    assert f"hash {manifest['configuration_hash']}" not in said
    assert command_line.main(given) == 0
    assert f"hash {manifest['configuration_hash']}" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("given", "sentence"),
    [
        ([], "give one of the two"),
        (["deployments/demo.toml", "--from-run", "1a"], "give one of the two"),
        (["deployments/demo.toml", "--data-dir", "x"], "--data-dir belongs to --from-run"),
        (["--from-run", "1a", "--data-dir", "/nowhere"], "there are no episodes in /nowhere"),
    ],
)
def test_what_cannot_be_meant_ends_with_code_two(
    given: list[str], sentence: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert command_line.main([*given, "--check"]) == 2
    assert sentence in capsys.readouterr().err


def test_the_data_folder_is_that_of_the_environment(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    kept(tmp_path)
    monkeypatch.setenv("EVA_DATA_DIR", str(tmp_path))
    assert command_line.main(["--from-run", ONE, "--check"]) == 0
    assert "hash      the same" in capsys.readouterr().out


def test_a_run_in_lockstep_is_exported_and_one_of_mode_sim_is_in_no_dataset(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = {"duration_s": 0.5, "mode": "sim"}
    made = stubbed(tmp_path, run=run, publish={"dataset": "set"})
    assert command_line.run_in_lockstep(made.spec, made.peers) == 0
    (path,) = (tmp_path / "exports" / "stack-the-cups" / "sim" / "async").glob("*.parquet")
    assert f"export   {path}" in capsys.readouterr().out
    assert not (tmp_path / "set").exists()
    episode = open_episode(tmp_path / "episodes" / path.stem)
    told = json.loads(pq.read_schema(path).metadata[b"eva.manifest"])
    assert told == json.loads(to_json(episode.manifest, "it"))
    assert rerun.rerun(path.stem, tmp_path).resolved.digest == made.spec.resolved.digest
    assert "sim" in set(episode.ticks["control_source"].to_pylist())
