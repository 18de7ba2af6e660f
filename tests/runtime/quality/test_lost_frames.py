"""Pictures that were given and not kept: of some rows, or of all from one on; in episodes and in datasets."""

import numpy as np
import pyarrow as pa
import pytest

from runtime.datasets.publishing import publish
from runtime.quality.inspection import check_dataset_episode, check_episode
from tests.runtime.quality.built import CAMERAS, FRAMES, record, shown
from tests.runtime.recording.failing import fail_at
from tests.runtime.recording.samples import resealed

CAMERA = CAMERAS[0]


def flags(report):
    return [(flag.kind, flag.severity, flag.first, flag.last, flag.stream) for flag in report.flags]


def losing(root, *stretches):
    """An episode in which the recorder had no time for the pictures of these rows: repeats, which are flagged lost."""
    rows = [row for stretch in stretches for row in stretch]
    folder = record(root, shown(rows, lambda index: None))
    path = folder / "rows.arrow"
    with pa.OSFile(str(path)) as file:
        table = pa.ipc.open_stream(file).read_all()
    name = f"lost.{CAMERA}"
    marked = pa.array(np.isin(np.arange(FRAMES), rows))
    changed = table.set_column(table.column_names.index(name), table.schema.field(name), marked)
    with pa.OSFile(str(path), "wb") as file, pa.ipc.new_stream(file, table.schema) as stream:
        stream.write_table(changed)
    resealed(folder)
    return folder


def test_lost_pictures_are_flagged_by_rows_and_nobody_says_that_the_camera_gave_none(tmp_path):
    report = check_episode(losing(tmp_path, range(20, 23), range(40, 41), range(50, 75)))
    assert flags(report) == [
        ("lost", "warning", 20, 22, CAMERA),
        ("lost", "warning", 40, 40, CAMERA),
        ("lost", "error", 50, 74, CAMERA),
    ]
    assert report.flags[2].text == (
        f"frames 50 to 74: what {CAMERA} gave for 0.8 s is not in its video, the picture before is"
    )
    assert (report.flags[2].value, report.flags[2].bound) == (pytest.approx(25 / 30), 0.5)
    assert not report.clean


@pytest.mark.some(1)
@pytest.mark.parametrize("version", ["v2.1", "v3.0"])
def test_a_dataset_says_the_same(tmp_path, version):
    publish(losing(tmp_path / "episodes", range(20, 23)), tmp_path / "set", version=version)
    assert flags(check_dataset_episode(tmp_path / "set", 0)) == [("lost", "warning", 20, 22, CAMERA)]


def test_a_video_that_was_lost_is_one_flag_from_its_end_to_the_last_row(tmp_path, monkeypatch):
    fail_at(monkeypatch, CAMERA, 30, ValueError("lost its mind"))
    folder = record(tmp_path)
    report = check_episode(folder)
    assert flags(report) == [("video_lost", "error", 30, FRAMES - 1, CAMERA)]
    assert report.flags[0].text.startswith(f"from frame 30 on the video of {CAMERA} ended: ")
    assert "lost its mind" in report.flags[0].text
    assert report.counts["video_lost"].frames == FRAMES - 30


@pytest.mark.parametrize(
    ("row", "expected"),
    [
        (0, ("video_lost", "error", 0, FRAMES - 1, CAMERA)),
        (FRAMES, ("video_lost", "warning", -1, -1, CAMERA)),
    ],
)
def test_a_video_may_be_lost_before_the_first_row_and_after_the_last(tmp_path, row, expected):
    folder = record(tmp_path)
    if row == 0:
        (folder / f"{CAMERA}.mp4").unlink()
    told_of(folder, {CAMERA: {"row": row, "reason": "the encoder failed"}})
    assert flags(check_episode(folder)) == [expected]


def test_a_loss_that_says_no_row_is_an_error_that_names_it(tmp_path):
    folder = record(tmp_path)
    told_of(folder, {CAMERA: {"row": "thirty"}})
    (flag,) = check_episode(folder).flags
    assert (flag.kind, flag.severity) == ("unfinished", "error")
    assert f"lost_cameras.{CAMERA} is {{'row': 'thirty'}}, must be a table with a row from 0" in flag.text


def told_of(folder, lost):
    resealed(folder, lost_cameras=lost)
