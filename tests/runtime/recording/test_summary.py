from pathlib import Path

import pytest

from runtime.core.errors import RecordingError
from runtime.recording.columns import RecordedRow
from runtime.recording.layout import Layout
from runtime.recording.summary import summarise
from runtime.recording.tables import TableWriter

from .samples import CAMERAS, manifest, row

LAYOUT = Layout.from_manifest(manifest())


@pytest.fixture
def rows(tmp_path: Path) -> Path:
    writer = TableWriter(tmp_path, "rows", LAYOUT)
    for index, source in enumerate(["none", "policy", "hold", "teleop", "motion", "policy"]):
        repeated = frozenset(CAMERAS[:1] if index in (0, 4) else ())
        captured = {"joints": 1000.0, CAMERAS[0]: 1000.0 + 0.01 * index}
        writer.add(RecordedRow(row(index, control_source=source, captured=captured), repeated))
        if index % 2:
            writer.flush()
    writer.finish()
    writer.file.close()
    return tmp_path / "rows.arrow"


def test_held_rows_do_not_count_in_the_duration(rows: Path) -> None:
    summary = summarise(rows, LAYOUT, 6)
    assert summary.frames == 6
    assert summary.held_rows == 2
    assert summary.duration_s == pytest.approx(4 / 30)
    assert summary.repeated == {CAMERAS[0]: 2, CAMERAS[1]: 0}


def test_skew_is_the_spread_of_the_known_capture_times(rows: Path) -> None:
    summary = summarise(rows, LAYOUT, 6)
    assert summary.skew_max_s == pytest.approx(0.05)
    assert summary.skew_mean_s == pytest.approx(0.025)


def test_only_the_first_rows_count(rows: Path) -> None:
    summary = summarise(rows, LAYOUT, 3)
    assert (summary.frames, summary.held_rows) == (3, 2)
    assert summary.repeated[CAMERAS[0]] == 1


def test_an_episode_without_rows_has_no_skew(rows: Path) -> None:
    summary = summarise(rows, LAYOUT, 0)
    assert summary.to_dict()["skew"] == {"mean_s": None, "max_s": None}
    assert summary.duration_s == 0.0


def test_fewer_rows_than_expected_are_an_error(rows: Path) -> None:
    with pytest.raises(RecordingError, match="6 rows readable, 7 expected"):
        summarise(rows, LAYOUT, 7)
