"""Episodes of datasets, ours and those of others, in every version; and the command line over all of them."""

import json
import os
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from runtime.core.errors import RecordingError
from runtime.datasets.operations import convert
from runtime.datasets.publishing import publish
from runtime.quality.__main__ import main
from runtime.quality.inspection import check_dataset_episode, check_episode
from tests.runtime.quality import built
from tests.runtime.quality.built import FPS, FRAMES, record, shown

SAMPLE = os.environ.get("EVA_SAMPLE_EPISODE")


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    """Two episodes of ours: a good one, and one with a camera that turns black."""
    root = tmp_path_factory.mktemp("published")
    black = shown(range(30, 40), lambda index: np.zeros((built.HEIGHT, built.WIDTH, 3), np.uint8))
    for spoil in (None, black):
        publish(record(root / "episodes", spoil), root / "set")
    return root / "set"


def flags(report):
    return [(flag.kind, flag.first, flag.last, flag.stream) for flag in report.flags]


def edit(dataset: Path, name: str, change) -> None:
    """One column of the first episode, as `change` makes it."""
    path = next(dataset.glob("data/*/episode_000000.parquet"))
    table = pq.read_table(path)
    place = table.column_names.index(name)
    pq.write_table(table.set_column(place, name, change(table.column(name))), path)


@pytest.mark.some(1)
@pytest.mark.parametrize("version", ["v2.1", "v3.0"])
def test_what_is_published_is_judged_as_the_episode_was(dataset, tmp_path, version):
    if version != "v2.1":
        convert(dataset, tmp_path / "other", version)
        dataset = tmp_path / "other"
    good, bad = check_dataset_episode(dataset, 0), check_dataset_episode(dataset, 1)
    assert good.clean
    assert flags(good) == []
    assert good.figures["tracking_lag_s"] == pytest.approx(built.LAG / FPS)
    assert flags(bad) == [("black", 30, 39, "cam_high")]
    uuids = [
        json.loads(line)["uuid"] for line in (dataset / "meta/eva_episodes.jsonl").read_text().splitlines()
    ]
    assert [good.episode, bad.episode] == uuids


def copy_of(dataset, tmp_path):
    convert(dataset, tmp_path / "copy", "v2.1")
    return tmp_path / "copy"


def test_uneven_timestamps_are_errors(dataset, tmp_path):
    copied = copy_of(dataset, tmp_path)
    times = (np.arange(FRAMES) / FPS + np.where(np.arange(FRAMES) == 20, 0.004, 0)).astype(np.float32)
    edit(copied, "timestamp", lambda column: pa.array(times))
    assert flags(check_dataset_episode(copied, 0)) == [("time_grid", 20, 20, "timestamp")]


def test_rows_out_of_order_are_errors(dataset, tmp_path):
    copied = copy_of(dataset, tmp_path)
    edit(copied, "frame_index", lambda column: pa.array([*range(50), *range(51, FRAMES + 1)]))
    assert flags(check_dataset_episode(copied, 0)) == [("missing_rows", 50, 50, "")]


def test_rows_of_another_width_and_without_numbers_are_errors(dataset, tmp_path):
    copied = copy_of(dataset, tmp_path)

    def spoil(column):
        rows = column.to_pylist()
        rows[10], rows[20], rows[30] = rows[10][:2], None, [float("nan"), *rows[30][1:]]
        return pa.array(rows, pa.list_(pa.float32()))

    edit(copied, "observation.state", spoil)
    found = flags(check_dataset_episode(copied, 0))
    assert ("dimensions", 10, 10, "observation.state") in found
    assert ("missing_values", 20, 20, "observation.state") in found
    assert ("not_finite", 30, 30, "observation.state") in found
    assert len(found) == 3


def test_an_episode_that_is_not_there_is_refused_by_number(dataset):
    with pytest.raises(RecordingError, match="no episode 7"):
        check_dataset_episode(dataset, 7)


def test_a_dataset_without_a_state_says_what_it_did_not_judge(dataset, tmp_path):
    copied = copy_of(dataset, tmp_path)
    info = json.loads((copied / "meta/info.json").read_text())
    info["features"]["joints"] = info["features"].pop("observation.state")
    (copied / "meta/info.json").write_text(json.dumps(info))
    path = next(copied.glob("data/*/episode_000000.parquet"))
    table = pq.read_table(path)
    pq.write_table(
        table.rename_columns(
            ["joints" if name == "observation.state" else name for name in table.column_names]
        ),
        path,
    )
    report = check_dataset_episode(copied, 0)
    assert any("--state" in sentence for sentence in report.unchecked)
    assert check_dataset_episode(copied, 0, state="joints").figures["tracking_lag_s"] == pytest.approx(
        built.LAG / FPS
    )
    with pytest.raises(RecordingError, match="no column 'elsewhere'"):
        check_dataset_episode(copied, 0, state="elsewhere")


def test_the_command_says_which_episodes_are_flagged(dataset, tmp_path, capsys):
    assert main([str(dataset), "--episodes", "0"]) == 0
    assert ": clean, 90 frames at 30 Hz" in capsys.readouterr().out
    assert main([str(dataset), "--json"]) == 1
    told = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [one["clean"] for one in told] == [True, False]
    assert told[1]["flags"][0]["text"].startswith("frames 30 to 39: cam_high is black")
    assert main([str(tmp_path)]) == 2
    assert "no episode and no dataset" in capsys.readouterr().err


def test_the_command_takes_a_folder_of_episodes_and_other_bounds(tmp_path, capsys):
    folder = record(tmp_path / "episodes")
    assert main([str(folder.parent)]) == 0
    assert folder.name in capsys.readouterr().out
    bounds = tmp_path / "bounds.toml"
    bounds.write_text("min_length_s = 60.0\n")
    assert main([str(folder), "--settings", str(bounds)]) == 1
    assert "too_short" in capsys.readouterr().out


def test_the_report_of_an_episode_is_plain_json(tmp_path):
    document = check_episode(record(tmp_path, frames=20)).to_dict()
    assert json.loads(json.dumps(document, allow_nan=False)) == document
    assert document["worst"] == "warning"


@pytest.mark.exhaustive
@pytest.mark.skipif(not SAMPLE, reason="EVA_SAMPLE_EPISODE does not name the real episode")
def test_the_real_episode_is_flagged_for_standing_at_its_end_alone():
    report = check_dataset_episode(Path(str(SAMPLE)), 0)
    assert [flag.kind for flag in report.flags] == ["idle_tail"]
    assert report.flags[0].last == 397
    assert report.figures["tracking_lag_s"] == pytest.approx(4 / 30)  # its action leads by four rows
    assert any("limits are not checked" in sentence for sentence in report.unchecked)
