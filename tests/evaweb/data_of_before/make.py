"""Makes disk/, lab.toml and rows.json beside it: what a lab writes, as the code of the day writes it.

    pytest tests/evaweb/data_of_before/make.py

They were made once, and are never made again for a change of the code: that today's code reads them is the point.
"""

import json
import shutil
from contextlib import ExitStack
from pathlib import Path
from unittest.mock import patch
from uuid import UUID

import pytest

from evaweb.collect import services as collecting
from evaweb.collect.models import CollectSession
from evaweb.collect.record import SESSIONS
from evaweb.episodes import services as episodes
from evaweb.episodes.folders import journal_folder, preview_folder
from evaweb.plans.allocation import allocate_trial
from evaweb.plans.models import Plan
from evaweb.plans.services import freeze_plan
from evaweb.plans.toml_exchange import export_toml
from evaweb.results.ratings import rating_queue
from evaweb.reviews import services as reviews
from evaweb.trials import services, voids
from evaweb.trials.models import Checkpoint
from evaweb.trials.selectors import trial_open
from runtime.core.types import Result
from runtime.recording.labels import Label, append_label
from runtime.recording.layout import Layout
from runtime.recording.outcome_seal import digests_of, seal_outcome, without_digests, write_outcome
from tests.evaweb.collect.conftest import collecting as collects
from tests.evaweb.data_of_before.reading import HERE, answers, restored, rows
from tests.evaweb.trials import builders
from tests.evaweb.trials.whole_lab import lab  # noqa: F401  a fixture

pytestmark = pytest.mark.django_db
KEPT = {
    *(
        "format",
        "uuid",
        "station",
        "robot",
        "fps",
        "cameras",
        "streams",
        "capture_streams",
        "started_monotonic",
    ),
    *(
        "started_wall",
        "max_skew_s",
        "task",
        "mode",
        "strategy",
        "kind",
        "checkpoint",
        "operator",
        "trial",
        "session",
    ),
    "configuration_hash",
}


@pytest.fixture(autouse=True)
def _data_dir(settings, tmp_path):
    settings.DATA_DIR = tmp_path


def test_disk(lab, tmp_path):  # noqa: F811
    text = _lived(lab)
    disk = HERE / "disk"
    shutil.rmtree(disk, ignore_errors=True)
    for folder in ("scores", "reviews", "sessions", "labels"):
        shutil.copytree(tmp_path / folder, disk / folder)
    for folder in (tmp_path / "episodes").iterdir():
        _slimmed(folder, disk / "episodes" / folder.name)
    (HERE / "lab.toml").write_text(text, "utf-8")


def test_rows(monkeypatch, settings, tmp_path):
    report = restored(monkeypatch, settings, tmp_path)
    assert report.problems == ()
    found = {**rows(), **answers()}
    blocks = [f'"{name}": [\n{_lines(found[name])}\n]' for name in found]
    (HERE / "rows.json").write_text("{\n" + ",\n".join(blocks) + "\n}\n", "utf-8")


def _lines(of_one):
    return ",\n".join(json.dumps(row, ensure_ascii=False) for row in of_one)


def _lived(lab):  # noqa: F811
    """A few days of a lab; its plan as a file."""
    ann, station = lab.bench.operator, lab.bench.station
    first = lab.run()
    lab.score(first, True, True, True, note="zuerst ⟂, dann gut")
    corrected = lab.run(position=2)
    lab.score(corrected, True, False, False, failure="slipped")
    lab.score(corrected, True, True, True, reason="seen on the video")
    voided = lab.run()
    lab.score(voided, True, False, False)
    voids.void_trial(user=ann, trial=voided, reason="a hand was in the picture")
    lab.bench.unrecorded(success=False)
    lab.run(position=2, seed=7)  # waits for its score
    waiting = trial_open(station)
    assert waiting is not None
    voids.void_trial(user=ann, trial=waiting, reason="the lamp was off")
    lab.run(smoke=True)
    _reviewed(first.episode, ann)
    text = _planned(lab)
    _collected(lab, journal_folder(first.episode_id))
    return text


def _reviewed(episode, ann):
    bob = builders.user("bob")
    reviews.add_review(user=ann, episode=episode, verdict="pass")
    reviews.add_review(user=bob, episode=episode, verdict="fail", note="it slips ⟂")
    held = reviews.save_segment(user=ann, episode=episode, first=0, last=3, label="reach", milestone="held")
    gone = reviews.save_segment(user=bob, episode=episode, first=4, last=5, label="wrong")
    reviews.save_segment(user=ann, episode=episode, first=1, last=4, label="reach", segment=held.uuid)
    reviews.remove_segment(user=bob, episode=episode, segment=gone.uuid)


def _planned(lab):  # noqa: F811
    """A blind plan, carried out in part, rated again and compared."""
    owner, rater = builders.user("olga"), builders.user("rita")
    other = Checkpoint.objects.create(
        name="pi0-new", policy={"url": "ws://127.0.0.1:8001"}, parent=lab.bench.checkpoint
    )
    plan = Plan.objects.create(
        name="blocks",
        title="Blocks",
        question="Is new better?",
        owner=owner,
        repetitions=2,
        strategy={"kind": "async", "blend_window": 4},
        second_rater_share=0.5,
        first=other,
        second=lab.bench.checkpoint,
    )
    plan.checkpoints.set([lab.bench.checkpoint, other])
    plan.positions.set(lab.bench.scene.positions.all())
    text = export_toml(plans=[plan])
    plan = freeze_plan(user=owner, plan=plan)
    for number in range(8):
        trial = allocate_trial(user=lab.bench.operator, station=lab.bench.station, plan=plan).trial
        builders.finished_trial(trial, 8.0 + number, cameras=["top"], uuid=UUID(int=100 + number))
        preview_folder(trial.episode_id).mkdir(parents=True)
        ok = number % 3 != 0
        times = dict(zip(lab.bench.ticks(1, 1, 1), (2.0, 3.25, None), strict=True))
        ticks = lab.bench.ticks(True, True, ok)
        services.score_trial(
            user=lab.bench.operator,
            trial=trial,
            milestones=ticks,
            times=times,
            failure="" if ok else "=dropped",
        )
    for reached in (True, False):
        handout = rating_queue.next_to_rate(rater).found
        assert handout is not None
        ticks = lab.bench.ticks(True, reached, reached)
        rating_queue.save_rating(
            user=rater,
            plan=plan,
            code=handout.code,
            milestones=ticks,
            failure="" if reached else "wölbt sich",
        )
    pair = rating_queue.next_to_compare(rater).found
    assert pair is not None
    codes = {"first": pair.first.code, "second": pair.second.code}
    rating_queue.save_preference(user=rater, plan=plan, outcome="second", why="sanfter ⟂", **codes)
    return text


def _collected(lab, recorded):  # noqa: F811
    """A session that was closed and resumed, with two demonstrations; another that lost its file."""
    station, ann = lab.bench.station, lab.bench.operator
    manifest = json.loads((recorded / "manifest.json").read_text())
    at = builders.FakeConnection()
    at.snapshot = {**at.snapshot, "collect": collects(), "lease": {"holder": "", "epoch": 0}}
    with ExitStack() as stack:
        stack.enter_context(patch("evaweb.collect.services.connection_to", lambda name: at))
        session = collecting.open_session(user=ann, station=station, task="stack the cups ⟂", target=20)
        collecting.set_session_target(user=ann, session=session, target=7)
        collecting.close_session(user=ann, session=session)
        collecting.resume_session(user=ann, session=session)
        collecting.close_session(user=ann, session=session)
        without = collecting.open_session(user=ann, station=station, task="pour", dataset="tea")
        collecting.close_session(user=ann, session=without)
    SESSIONS.path(without.pk).unlink()
    results: list[tuple[CollectSession, Result | None]] = [
        (session, "success"),
        (session, None),
        (without, "partial"),
    ]
    for number, (of, result) in enumerate(results):
        uuid = str(UUID(int=number + 1))
        folder = recorded.parent / uuid
        shutil.copytree(recorded, folder)
        named = {"kind": "demonstration", "mode": "collect", "task": of.task, "trial": None, "uuid": uuid}
        named["session"] = {"uuid": str(of.pk), "dataset": of.dataset}
        (folder / "manifest.json").write_text(json.dumps(manifest | named))
        _sealed(folder)
        episodes.record_closed(station=station, data={"uuid": uuid, "status": "finished"})
        if result:
            append_label(recorded.parent.parent, uuid, Label(1_700_000_000.0, "ann", result, note="n"))


def _slimmed(source: Path, target: Path) -> None:
    """What the database is restored from of an episode."""
    target.mkdir(parents=True)
    manifest = json.loads((source / "manifest.json").read_text())
    simulated = manifest["configuration"].get("transport", {}).get("simulated", False)
    told_of = {name: manifest[name] for name in manifest if name in KEPT and manifest[name] is not None}
    told_of["configuration"] = {"transport": {"simulated": simulated}}
    (target / "manifest.json").write_text(json.dumps(told_of))
    events = (source / "events.jsonl").read_text().splitlines(keepends=True)
    (target / "events.jsonl").write_text("".join(line for line in events if '"truth"' in line))
    shutil.copy(source / "outcome.json", target)
    _sealed(target)
    (target / "sealed.json").unlink()


def _sealed(folder: Path) -> None:
    outcome = without_digests(json.loads((folder / "outcome.json").read_text()))
    layout = Layout.from_manifest(json.loads((folder / "manifest.json").read_text()))
    write_outcome(folder, seal_outcome(outcome, digests_of(folder, layout)))
