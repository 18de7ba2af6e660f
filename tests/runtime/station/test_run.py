import json

from runtime.core.git_revision import revision
from runtime.core.machine import installed_versions
from runtime.recording.files import to_json
from runtime.station.run import Provenance, Run
from tests.runtime.lockstep_station import stubbed

BEGUN = {"ticks": 900, "missed": 2, "records_lost": 1, "lateness_p99_ms": 0.4}


def test_what_control_counts_is_counted_from_the_beginning_of_the_run():
    run = Run(1, "uuid", 0.0, counted=BEGUN)
    ended = {"ticks": 1200, "missed": 3, "records_lost": 1, "lateness_p99_ms": 0.2}
    assert run.figures(ended) == {"ticks": 300, "missed": 1, "records_lost": 0, "lateness_p99_ms": 0.2}


def test_a_control_that_was_restarted_meanwhile_counts_from_its_own_beginning():
    restarted = {"ticks": 40, "missed": 0, "records_lost": 0, "lateness_p99_ms": 0.2}
    assert Run(1, "uuid", 0.0, counted=BEGUN).figures(restarted) == restarted


def test_a_manifest_says_what_the_run_was_made_with(tmp_path):
    made = stubbed(tmp_path, strategy="sync").spec
    manifest = Provenance(made, "boot-1", checkpoint={"id": 7, "name": "good"}).manifest("step", None)
    assert manifest["configuration"] == made.resolved.tree
    assert manifest["configuration_hash"] == made.resolved.digest
    assert (manifest["mode"], manifest["strategy"], manifest["task"]) == ("step", "sync", "stack the cups")
    assert manifest["checkpoint"] == {"id": 7, "name": "good"}
    assert manifest["versions"] == installed_versions()
    assert manifest["git"] == dict(revision())
    assert json.loads(to_json(manifest, "the manifest"))["git"] == dict(revision())
