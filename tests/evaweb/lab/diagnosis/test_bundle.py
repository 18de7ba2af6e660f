"""A bundle of a lab in which secrets were planted wherever a text of it comes from."""

import json
import zipfile

import pytest
from django.contrib.auth.models import AnonymousUser
from django.core.management import CommandError, call_command
from django.db import OperationalError

from evaweb.blinding.visibility import FULL_VISIBILITY, HIDDEN, Visibility
from evaweb.jobs.kinds import JobContext, kind_named
from evaweb.jobs.models import Job, JobStatus
from evaweb.lab.diagnosis import bundle, contents
from evaweb.stations.models import Command, CommandStatus, Station

SECRET = "Zq7-planted-9x"
BLIND = Visibility(
    checkpoints=frozenset({1}),
    names=frozenset({"alder"}),
    stations=frozenset({"bench-1"}),
    plans="blocks v1 is blind",
)

pytestmark = pytest.mark.django_db


@pytest.fixture
def lab(settings, tmp_path, alma):
    """A station with a deployment, commands, a failed job, and logs."""
    settings.DATA_DIR = tmp_path / "data"
    logs, folder = settings.DATA_DIR / "logs", settings.DATA_DIR / "deployments"
    logs.mkdir(parents=True)
    folder.mkdir()
    (logs / "web.log").write_text(
        f"begin\nconnecting to ws://eva:{SECRET}@host:1 as alder\npassword={SECRET}\nend\n"
    )
    (logs / "policy-alder.log").write_text(f"Authorization: Bearer {SECRET}\n")
    (folder / "bench-1.toml").write_text(
        f'station = "bench-1" # the old token was {SECRET}\nrobot = "ur5e"\n'
        f'[policy]\nkind = "openpi"\nurl = "ws://eva:{SECRET}@host:1"\ntoken = "{SECRET}"\n'
    )
    station = Station.objects.create(name="bench-1", robot="ur5e", message=f"token={SECRET}")
    args = {"policy": {"url": f"ws://eva:{SECRET}@h:1", "api_key": SECRET}, "checkpoint": "alder"}
    Command.objects.create(
        station=station,
        user=alma,
        kind="setup",
        args=args,
        status=CommandStatus.REFUSED,
        reason=f"ws://eva:{SECRET}@h:1 does not serve alder",
    )
    Job.objects.create(
        kind="publish",
        key="publish:1",
        status=JobStatus.FAILED,
        error=f"alder: token={SECRET}",
        result={"secret": SECRET},
    )
    return settings.DATA_DIR


def made(folder, sight):
    path = folder / "bundle.zip"
    notes = bundle.write(path, sight, lambda part: None)
    assert path.stat().st_mode & 0o077 == 0
    with zipfile.ZipFile(path) as packed:
        return notes, {name: packed.read(name).decode() for name in packed.namelist()}


def test_no_text_of_it_has_a_secret_and_all_else_is_there(lab):
    _, texts = made(lab, FULL_VISIBILITY)
    assert [name for name, text in texts.items() if SECRET in text] == []
    assert texts["logs/web.log"].startswith("begin\n")
    assert texts["logs/web.log"].endswith("end\n")
    assert json.loads(texts["deployments/bench-1.json"])["policy"]["kind"] == "openpi"
    assert json.loads(texts["stations/bench-1/commands.json"])[0]["args"]["checkpoint"] == "alder"
    assert "bench-1 is not running" in texts["stations/bench-1/state.json"]
    assert json.loads(texts["database.json"])["migrations_to_apply"] == []
    assert "django" in {name.lower() for name in json.loads(texts["versions.json"])["packages"]}


def test_who_is_blind_is_told_nothing_of_a_hidden_checkpoint_and_that_something_is_left_out(lab):
    notes, texts = made(lab, BLIND)
    assert [name for name, text in texts.items() if "alder" in name + text] == []
    assert not any(name.startswith("logs/") for name in texts)
    assert json.loads(texts["deployments/bench-1.json"])["policy"] == HIDDEN
    command = json.loads(texts["stations/bench-1/commands.json"])[0]
    assert (command["kind"], command["args"], command["reason"]) == ("setup", {}, HIDDEN)
    assert json.loads(texts["programs.json"]) == [{"program": "lab", "runs": False}]
    assert "blocks v1 is blind" in notes[0]
    assert "blocks v1 is blind" in texts["summary.txt"]


def test_the_end_of_a_long_log_is_kept_from_a_whole_line_on_and_it_is_said(lab, monkeypatch):
    monkeypatch.setattr(bundle, "LONGEST_LOG", 30)
    lines = "".join(f"line {number}\n" for number in range(100))
    (lab / "logs" / "web.log").write_text(lines)
    notes, texts = made(lab, FULL_VISIBILITY)
    assert texts["logs/web.log"] == "line 97\nline 98\nline 99\n"
    assert f"logs/web.log: its last 30 of {len(lines)} bytes" in notes
    assert f"logs/web.log: its last 30 of {len(lines)} bytes" in texts["summary.txt"]


def test_all_logs_together_are_bounded(lab, monkeypatch):
    monkeypatch.setattr(bundle, "LONGEST_LOGS", 10)
    notes, texts = made(lab, FULL_VISIBILITY)
    assert sum(len(text) for name, text in texts.items() if name.startswith("logs/")) <= 10
    assert len([note for note in notes if note.startswith("logs/")]) == 2


def test_a_lab_whose_database_is_gone_still_has_a_bundle_and_a_blind_one(lab, monkeypatch):
    def gone(*given):
        raise OperationalError("no such table")

    monkeypatch.setattr(bundle, "visibility_for_user", gone)
    monkeypatch.setattr(contents, "database", gone)
    monkeypatch.setattr(contents, "station_parts", gone)
    notes, texts = made(lab, bundle.visibility_for(AnonymousUser()))
    assert "who is blind cannot be read (no such table)" in notes[0]
    assert "the database as far as it could not be read: no such table" in notes
    assert {"versions.json", "machine.json", "deployments/bench-1.json"} <= texts.keys()
    assert "which cannot be read" in texts["summary.txt"]
    assert not any(name.startswith("logs/") for name in texts)


def test_the_summary_is_a_page_that_needs_nothing_from_elsewhere(lab):
    page = made(lab, FULL_VISIBILITY)[1]["summary.html"]
    assert "<script" not in page
    assert "http" not in page
    assert "<a href='stations/bench-1/state.json'>" in page


def test_the_command_is_as_blind_as_who_has_looked_behind_nothing(lab, monkeypatch, tmp_path, capsys):
    seen = []
    monkeypatch.setattr(
        bundle, "write", lambda path, sight, tell: seen.append(sight) or path.write_bytes(b"") or []
    )
    monkeypatch.setattr(bundle, "visibility_for", lambda user: user)
    call_command("diagnose", out=tmp_path / "a.zip")
    call_command("diagnose", out=tmp_path / "b.zip", unblinded=True)
    assert seen == [AnonymousUser(), FULL_VISIBILITY]


def test_a_folder_that_cannot_be_written_is_named(lab, tmp_path):
    with pytest.raises(CommandError, match=r"nowhere/a\.zip: No such file"):
        call_command("diagnose", out=tmp_path / "nowhere" / "a.zip")


@pytest.mark.exhaustive
def test_the_job_leaves_three_bundles_for_who_asked_and_nobody_else(lab, alma, ann, client):
    told = []
    for number in range(4):
        name = f"eva-diagnosis-20260101-00000{number}.zip"
        done = kind_named("diagnose")(JobContext({"user": alma.pk, "name": name}, told.append))
    assert done["bytes"] > 1000
    assert "gathering logs" in told
    client.force_login(alma)
    page = client.get("/setup/diagnosis/", headers={"Accept": "text/html"}).content.decode()
    assert page.count(".zip</a>") == 3
    newest = client.get(f"/setup/diagnosis/{name}")
    assert b"".join(newest.streaming_content).startswith(b"PK")
    assert client.get("/setup/diagnosis/eva-diagnosis-20260101-000000.zip").status_code == 404
    client.force_login(ann)
    assert client.get(f"/setup/diagnosis/{name}").status_code == 403


def test_a_bundle_of_another_administrator_is_not_given(lab, alma, client):
    from tests.evaweb.conftest import person

    name = "eva-diagnosis-20260101-000000.zip"
    kind_named("diagnose")(JobContext({"user": alma.pk, "name": name}, lambda part: None))
    client.force_login(person("ada", "admin"))
    assert client.get(f"/setup/diagnosis/{name}").status_code == 404


def test_the_button_asks_for_one_and_the_page_says_how_far_it_is(lab, alma, client, monkeypatch):
    monkeypatch.setattr("evaweb.jobs.doorbell.notify_workers", lambda queue: True)
    client.force_login(alma)
    assert client.post("/setup/diagnosis/").status_code == 302
    job = Job.objects.get(kind="diagnose")
    assert "Waiting for the worker" in client.get("/setup/diagnosis/").content.decode()
    Job.objects.filter(pk=job.pk).update(status=JobStatus.RUNNING, progress="gathering logs")
    asked = {"HX-Request": "true"}
    fragment = client.get("/setup/diagnosis/", headers=asked)
    assert "gathering logs" in fragment.content.decode()
    assert "<html" not in fragment.content.decode()
    assert "HX-Refresh" not in fragment
    Job.objects.filter(pk=job.pk).update(status=JobStatus.DONE)
    assert client.get("/setup/diagnosis/", headers=asked)["HX-Refresh"] == "true"
