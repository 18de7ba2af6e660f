import csv
import io
import zipfile

import pytest
from django.test import Client

from evaweb.blinding.visibility import FULL_VISIBILITY, HIDDEN, Visibility
from evaweb.episodes.folders import preview_folder, preview_video
from evaweb.episodes.models import Episode
from evaweb.trials import clip_export, services
from evaweb.trials.clips import clip_of
from evaweb.trials.gallery import FailureFilters, failed_list, failure_groups, shown_group
from evaweb.trials.models import Checkpoint, FailureTerm, Trial
from evaweb.trials.selectors import TrialFilters
from runtime.datasets.video_frames import VideoFrames
from tests.evaweb.trials import builders
from tests.runtime.datasets.small import write_video


@pytest.fixture
def browser(bench):
    made = Client()
    made.force_login(bench.operator)
    return made


def failed(bench, cause="", phase="", times=(), **given):
    """A failed trial of which the first two milestones were reached, at those times."""
    trial = bench.ended(**given)
    Episode.objects.filter(pk=trial.episode_id).update(cameras=["top", "wrist"], fps=30.0)
    ticks = bench.ticks(True, True, False)
    services.score_trial(
        user=bench.operator,
        trial=trial,
        milestones=ticks,
        times=dict(zip(ticks, times, strict=False)),
        failure=cause,
        failure_phase=phase,
    )
    return Trial.objects.select_related("episode", "verdict").get(pk=trial.pk)


def groups(by, sight=FULL_VISIBILITY, **given):
    found = failure_groups(FailureFilters(group=by, **given), sight)
    return [(group.name, group.count) for group in found]


# --- the clip ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("times", "part"),
    [
        ((), (6.5, 12.5, "")),  # 375 rows at 30 Hz: its end
        ((2.0, 4.0), (3.0, 9.0, "lifted")),
        ((2.0,), (1.0, 7.0, "held")),
        ((0.4,), (0.0, 6.0, "held")),
        ((2.0, 11.0), (10.0, 12.5, "lifted")),
        ((2.0, 900.0), (1.0, 7.0, "held")),  # after the recording's end
    ],
)
def test_a_clip_begins_just_before_the_last_milestone_in_front_of_the_missed_one(bench, times, part):
    clip = clip_of(failed(bench, times=times))
    assert (clip.begin, clip.end, clip.after) == part
    assert clip.missed == "on the plate"
    assert clip.video.endswith("/video/top")
    assert f"from={part[0]:.2f}&to={part[1]:.2f}&loop=1" in clip.share


def test_a_trial_without_pictures_has_no_clip_and_is_in_the_gallery_all_the_same(bench, browser):
    trial = bench.scored(False)
    assert clip_of(trial) is None
    text = browser.get("/result/failures/").content.decode()
    assert f'<a href="/result/trials/{trial.pk}/">' in text
    assert "data-src" not in text


# --- groups and filters --------------------------------------------------------------------------------------


def test_failures_stand_in_groups_the_largest_named_first(bench):
    builders.failure_terms()
    other = Checkpoint.objects.create(name="act")
    failed(bench, "dropped", "grasp")
    failed(bench, "dropped", position=2)
    failed(bench, "missed", "approach", checkpoint=other)
    failed(bench)
    bench.scored(True)
    assert groups("failure") == [("dropped", 2), ("missed", 1), ("not specified", 1)]
    assert groups("failure_phase") == [("not specified", 2), ("approach", 1), ("grasp", 1)]
    assert groups("position") == [("block-on-plate/1", 3), ("block-on-plate/2", 1)]
    assert groups("checkpoint") == [("pi0-block", 3), ("act", 1)]
    assert groups("failure", failure_phase="not specified") == [("dropped", 1), ("not specified", 1)]
    assert groups("failure", position="block-on-plate/2") == [("dropped", 1)]
    assert groups("failure", trials=TrialFilters(checkpoint="act")) == [("missed", 1)]
    shown = [shown_group(trial, FailureFilters()) for trial in failed_list(FailureFilters(), FULL_VISIBILITY)]
    assert shown == ["dropped", "dropped", "missed", "not specified"]


def test_hidden_checkpoints_are_one_group_in_the_order_of_their_trials_and_no_filter(bench):
    names = [Checkpoint.objects.create(name=name) for name in ("zeta", "alpha")]
    trials = [failed(bench, checkpoint=names[i]) for i in (0, 1, 0)]
    sight = Visibility(checkpoints=frozenset(row.pk for row in names))
    failed(bench)
    filters = FailureFilters(group="checkpoint")
    assert groups("checkpoint", sight) == [(HIDDEN, 3), ("pi0-block", 1)]
    assert failure_groups(filters, sight)[0].address == ""
    rows = list(failed_list(filters, sight))
    assert [row.pk for row in rows if row.checkpoint in names] == [trial.pk for trial in reversed(trials)]


@pytest.mark.parametrize(
    ("query", "said"),
    [
        ("group=colour", "group = &#x27;colour&#x27;; allowed: failure, failure_phase, position, checkpoint"),
        ("position=two", "position = &#x27;two&#x27;; allowed: SCENE/NUMBER"),
        ("checkpoint=none", "checkpoint &#x27;none&#x27; does not exist"),
    ],
)
def test_a_wrong_filter_is_named_and_all_failures_are_shown(bench, browser, query, said):
    failed(bench)
    answer = browser.get(f"/result/failures/?{query}")
    assert answer.status_code in (400, 404)
    assert said in answer.content.decode()
    assert "data-trial" in answer.content.decode()
    assert browser.get(f"/result/failures.csv?{query}").status_code in (400, 404)


def test_each_filter_that_applies_is_a_chip_that_takes_it_off(bench, browser):
    bench.scored(success=False)
    text = browser.get(
        "/result/failures/?scene=block-on-plate&group=position&page=1&failure="
    ).content.decode()
    assert "Scene: block-on-plate" in text
    assert '<a href="?group=position" aria-label="Remove the filter Scene: block-on-plate"' in text
    assert text.count("filter-chip") == 1
    assert "filter-chip" not in browser.get("/result/failures/?evaluation=none").content.decode()


def test_the_gallery_has_a_clip_per_failure_with_its_link(bench, browser):
    trial = failed(bench, "slipped", times=(2.0, 4.0))
    preview_folder(trial.episode_id).mkdir(parents=True)
    text = browser.get("/result/failures/").content.decode()
    assert 'data-begin="3.0" data-end="9.0"' in text
    assert f"/result/trials/{trial.pk}/?t=3.00&amp;from=3.00&amp;to=9.00&amp;loop=1" in text
    assert "Missed “on the plate”, after “lifted”." in text
    assert "<h2>slipped" in text


def test_a_viewer_looks_and_a_lab_without_words_says_who_writes_them(bench, browser):
    failed(bench)
    looking = Client()
    looking.force_login(builders.user("eve", "viewer"))
    text = looking.get("/result/failures/").content.decode()
    assert "Operators assign categories" in text
    assert "data-field" not in text
    assert 'data-field="failure"' in browser.get("/result/failures/").content.decode()
    FailureTerm.objects.all().delete()
    assert "The lab has no failure phases or causes" in browser.get("/result/failures/").content.decode()


def test_a_milestones_time_leads_to_its_moment_where_there_is_a_recording_to_play(bench, browser):
    trial = failed(bench, times=(2.0, 4.25))
    address = f"/result/trials/{trial.pk}/"
    assert "data-seek" not in browser.get(address).content.decode()
    preview_folder(trial.episode_id).mkdir(parents=True)
    text = browser.get(address).content.decode()
    assert f'href="{address}?t=4.25" data-seek="4.25" data-key="2"' in text
    assert text.count("data-seek") == 2
    assert 'data-frames="375" data-fps="30.0"' in text
    assert "data-link" in text
    refused = browser.post(f"{address}score", {}).content.decode()
    assert "data-link" not in refused  # its address is none that is opened


def test_a_lab_without_failures_says_what_would_be_here(bench, browser):
    assert "No trial has failed yet" in browser.get("/result/failures/").content.decode()


def test_the_table_has_every_failure_with_the_address_of_its_clip(bench, browser):
    first, second = failed(bench, "=slip", times=(2.0,)), failed(bench)
    answer = browser.get("/result/failures.csv")
    rows = list(csv.DictReader(io.StringIO(b"".join(answer.streaming_content).decode())))
    assert [row["trial"] for row in rows] == [str(first.pk), str(second.pk)]
    assert rows[0]["failure"] == "'=slip"  # no formula for a spreadsheet
    assert rows[0]["clip"].startswith(f"http://testserver/result/trials/{first.pk}/?t=1.00")
    assert (rows[0]["missed"], rows[1]["begin_s"]) == ("on the plate", "6.5")


def archive(answer):
    """The table and the clips of a zip."""
    with zipfile.ZipFile(io.BytesIO(b"".join(answer.streaming_content))) as packed:
        assert packed.testzip() is None
        rows = list(csv.DictReader(io.StringIO(packed.read("failures.csv").decode())))
        return rows, {name: packed.read(name) for name in packed.namelist() if name.endswith(".mp4")}


def test_the_zip_has_a_clip_of_every_failure_that_can_be_played_and_the_table_says_of_the_others_why(
    bench, browser, tmp_path
):
    shown, unprepared, torn = failed(bench, "slipped", times=(2.0, 4.0)), failed(bench), failed(bench)
    for trial in (shown, torn):
        preview_folder(trial.episode_id).mkdir(parents=True)
    Episode.objects.filter(pk=shown.episode_id).update(frames=40, fps=8.0)
    write_video(preview_video(shown.episode_id, "top"), 40, 8, gop=10, b_frames=0)
    preview_video(torn.episode_id, "top").write_bytes(b"nothing")
    answer = browser.get("/result/failures.zip")
    assert answer["Content-Disposition"] == 'attachment; filename="failures.zip"'
    rows, clips = archive(answer)
    assert [(int(row["trial"]), row["file"], row["why_no_file"]) for row in rows] == [
        (shown.pk, f"clips/trial-{shown.pk}.mp4", ""),
        (unprepared.pk, "", "its video is not prepared"),
        (torn.pk, "", "its video cannot be read"),
    ]
    ((_, content),) = clips.items()
    (tmp_path / "clip.mp4").write_bytes(content)
    begin = float(rows[0]["file_begin_s"])
    assert begin <= float(rows[0]["begin_s"]) == 3.0
    with VideoFrames(tmp_path / "clip.mp4") as pictures:
        assert len(pictures) == round((5.0 - begin) * 8)
    only, none = archive(browser.get("/result/failures.zip?failure=not said"))
    assert (len(only), none) == (2, {})


def test_what_is_too_much_for_one_archive_is_said_before_it_begins(bench, browser, monkeypatch):
    for _ in range(2):
        failed(bench)
    assert "Zip of 2 clips" in browser.get("/result/failures/").content.decode()
    monkeypatch.setattr(clip_export, "MOST", 1)
    answer = browser.get("/result/failures.zip")
    assert answer.status_code == 400
    assert "2 failed trials; allowed in one archive: at most 1" in answer.content.decode()
    text = browser.get("/result/failures/").content.decode()
    assert "A zip holds up to 1 clip: narrow the list." in text


def test_of_a_hidden_checkpoint_the_zip_names_the_code_alone(bench):
    trial = failed(bench)
    sight = Visibility(frozenset({trial.checkpoint_id}), frozenset({trial.checkpoint.name}))
    told = b"".join(clip_export.clip_archive(FailureFilters(), sight, "http://lab"))
    with zipfile.ZipFile(io.BytesIO(told)) as packed:
        (row,) = csv.DictReader(io.StringIO(packed.read("failures.csv").decode()))
    assert row["checkpoint"] == HIDDEN  # it was handed out under no code
    assert trial.checkpoint.name.encode() not in told
