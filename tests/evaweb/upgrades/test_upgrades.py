"""The data folder of a lab of every tagged version is taken over by this one: nothing is lost, results are the same.

`make.py` packs one. A tag that changes tables or files adds its own.
"""

import json
import os
import subprocess
import sys
import tarfile
from pathlib import Path

import pytest

from runtime.recording.reader import open_episode
from runtime.recording.scrub import verify_episode

HERE = Path(__file__).parent
ROOT = HERE.parents[2]
RECORDS = (
    "trials_",
    "plans_",
    "episodes_",
    "reviews_",
    "results_",
    "collect_",
    "auth_user",
    "stations_command",
)
# As this version reads them; `expected.json` says how the one that wrote them did.
FOUND = """
import json
from django.db import connection
from evaweb.episodes.models import Episode
from evaweb.plans.models import Plan
from evaweb.core.canonical_json import digest
from evaweb.trials.models import Score
with connection.cursor() as cursor:
    tables = connection.introspection.table_names(cursor)
    rows = {name: cursor.execute(f"SELECT count(*) FROM {name}").fetchone()[0] for name in tables}
print(json.dumps({
    "rows": rows,
    "scores": [[uuid.hex, success, score] for uuid, success, score in
               Score.objects.order_by("uuid").values_list("uuid", "success", "score")],
    "plans": [[plan.name, plan.version, plan.state, plan.digest and digest(plan.document)]
              for plan in Plan.objects.order_by("name", "version")],
    "episodes": [[uuid.hex, frames] for uuid, frames in Episode.objects.order_by("uuid").values_list("uuid", "frames")],
}))
"""
pytestmark = pytest.mark.slow


@pytest.fixture(scope="module", params=sorted(path.name for path in HERE.glob("*.tar.xz")))
def lab(request, tmp_path_factory):
    """A data folder of that version, migrated by this one."""
    folder = tmp_path_factory.mktemp("lab")
    with tarfile.open(HERE / request.param) as archive:
        archive.extractall(folder, filter="data")
    manage(folder, "migrate", "--verbosity", "0")
    return folder


def manage(folder, *words):
    variables = os.environ | {"EVA_DATA_DIR": str(folder), "DJANGO_SETTINGS_MODULE": "evaweb.settings"}
    variables.pop("DATABASE_URL", None)
    program = [sys.executable, "manage.py", *words]
    done = subprocess.run(program, cwd=ROOT, env=variables, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def found(folder):
    return json.loads(manage(folder, "shell", "--verbosity", "0", "--command", FOUND).splitlines()[-1])


def test_no_record_is_lost_and_none_is_changed(lab):
    expected, now = json.loads((lab / "expected.json").read_text("utf-8")), found(lab)
    lost = {
        name: (count, now["rows"].get(name))
        for name, count in expected["rows"].items()
        if name.startswith(RECORDS) and now["rows"].get(name) != count
    }
    assert not lost
    for kind in ("scores", "plans", "episodes"):
        assert expected[kind], kind
        assert [list(map(plain, row)) for row in now[kind]] == [
            list(map(plain, row)) for row in expected[kind]
        ]


def plain(value):
    """SQLite has neither booleans nor empty digests of its own."""
    return int(value) if isinstance(value, bool) else value or ""


def test_a_recording_is_as_it_was_recorded(lab):
    [folder] = (lab / "episodes").iterdir()
    assert verify_episode(folder).state == "sound"
    episode = open_episode(folder)
    assert episode.frames == len(episode.rows) > 0


@pytest.mark.exhaustive
def test_a_report_is_made_and_recomputed_and_the_disk_changes_nothing(lab, tmp_path):
    before = found(lab)
    [revealed] = [name for name, _, state, _ in before["plans"] if state == "revealed"]
    manage(lab, "eval_report", revealed, "--out", str(tmp_path / "report"))
    words = [sys.executable, "-E", "-s", "-S", "-m", "recompute"]
    done = subprocess.run(words, cwd=tmp_path / "report", capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    manage(lab, "reconcile")
    after = found(lab)
    assert (after["scores"], after["plans"]) == (before["scores"], before["plans"])
