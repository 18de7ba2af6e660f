"""What other programs write beside the format's letter: read right, or refused by a sentence that names it."""

from __future__ import annotations

import io
import json
import re
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from PIL import Image

from runtime.core.errors import RecordingError
from runtime.datasets.catalog import Catalog
from runtime.datasets.consistency import check
from runtime.datasets.entries import Span
from runtime.datasets.operations import convert, delete
from runtime.datasets.reader import open_dataset
from runtime.datasets.stats import video_statistic
from runtime.datasets.video_frames import StoredImages
from runtime.datasets.video_segments import encode_segment
from tests.runtime.datasets.foreign import Plan, write
from tests.runtime.datasets.small import HEIGHT, WIDTH, seen, write_video

CAM = "observation.images.cam"
ROWS = "data/chunk-000/episode_000000.parquet"
Edit = Callable[[Any], Any]


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """Episodes of 7 and 5 rows, the second begins at 7; without cameras."""
    write(tmp_path / "set", Plan("v2.1", lengths=(7, 5), videos=()))
    return tmp_path / "set"


@pytest.fixture
def stills(tmp_path: Path) -> Path:
    """One episode of 3 rows with pictures in a column."""
    write(tmp_path / "set", Plan("v2.1", lengths=(3,), videos=(), images=("cam",)))
    return tmp_path / "set"


def edit(root: Path, name: str, made: Edit, path: str = ROWS) -> None:
    """Put what `made` makes of the column's rows in their place."""
    table = pq.read_table(root / path)
    column = made(table[name].to_pylist())
    column = column if isinstance(column, pa.Array) else pa.array(column, table.schema.field(name).type)
    pq.write_table(table.set_column(table.column_names.index(name), name, column), root / path)


def declare(root: Path, name: str, **said: Any) -> None:
    path = root / "meta/info.json"
    info = json.loads(path.read_text())
    info["features"][name] = info["features"].get(name, {}) | said
    path.write_text(json.dumps(info))


def restate(root: Path, made: Callable[[dict[str, Any]], object]) -> None:
    """Change the statistics of episode 1, or of the only one."""
    path = root / "meta/episodes_stats.jsonl"
    lines = [json.loads(line) for line in path.read_text().splitlines()]
    made(lines[-1]["stats"])
    path.write_text("".join(json.dumps(line) + "\n" for line in lines))


def stated(root: Path, name: str, index: int = 0) -> dict[str, Any]:
    line = json.loads((root / "meta/episodes_stats.jsonl").read_text().splitlines()[index])
    found: dict[str, Any] = line["stats"][name]
    return found


def spoiled(name: str, value: Any) -> Callable[[dict[str, Any]], object]:
    return lambda stats: stats["action"].update({name: value})


UNUSABLE: list[tuple[Callable[[dict[str, Any]], object], str]] = [
    (spoiled("mean", [float("nan")] * 6), "mean is [nan, nan, nan, nan, nan, nan], expected finite numbers"),
    (spoiled("max", [float("inf")] * 6), "max is [inf, inf, inf, inf, inf, inf], expected finite numbers"),
    (spoiled("std", None), "std has shape (), expected (6,)"),
    (spoiled("min", [None] * 6), "min is [None, None, None, None, None, None], expected finite numbers"),
    (spoiled("min", ["a"] * 6), "min is ['a', 'a', 'a', 'a', 'a', 'a'], expected numbers"),
    (spoiled("mean", [1.0]), "mean has shape (1,), expected (6,)"),
    (spoiled("q01", [float("nan")] * 6), "q01 is [nan, nan, nan, nan, nan, nan], expected finite numbers"),
    (spoiled("count", 5), "count is 5, expected [n] of the rows that it is of"),
    (spoiled("count", [0]), "count is [0], expected [n] of the rows that it is of"),
    (lambda stats: stats["action"].pop("count"), "count is None, expected [n] of the rows that it is of"),
    (lambda stats: stats["action"].pop("max"), "has no max"),
    (lambda stats: stats.update(action=None), "is None, expected min, max, mean, std and count"),
]


@pytest.mark.some(4)
@pytest.mark.parametrize(("spoil", "why"), UNUSABLE, ids=[why for _, why in UNUSABLE])
def test_unusable_statistics_are_named_and_made_anew(
    root: Path, tmp_path: Path, spoil: Callable[[dict[str, Any]], object], why: str
) -> None:
    whole = stated(root, "action", 1)
    restate(root, spoil)
    assert check(root) == [f"episode 1: statistics of 'action': {why}"]
    done = convert(root, tmp_path / "new", "v2.1")
    assert done.left_out == (f"statistics of {root}, episode 1, 'action': {why}; they are made anew",)
    assert check(tmp_path / "new") == []
    made = stated(tmp_path / "new", "action", 1)
    assert all(np.allclose(made[name], whole[name]) for name in whole)
    with pytest.raises(
        RecordingError, match=r"statistics of episode 1, 'action': .*`convert` makes them anew"
    ):
        Catalog.read(root).documents_after_data()


def test_an_episode_without_statistics_gets_them(root: Path, tmp_path: Path) -> None:
    path = root / "meta/episodes_stats.jsonl"
    path.write_text(path.read_text().splitlines()[0] + '\n{"episode_index": 1, "stats": null}\n')
    assert check(root) == ["episode 1: no statistics in meta/episodes_stats.jsonl"]
    convert(root, tmp_path / "new", "v3.0")
    assert check(tmp_path / "new") == []


@pytest.mark.parametrize(
    ("value", "said"),
    [
        (float("inf"), "'action' is infinite in 1 rows, the first is 2"),
        (None, "'action' is null in 1 rows, the first is 2"),
    ],
)
def test_rows_that_are_no_numbers_are_named_and_do_not_count(
    root: Path, tmp_path: Path, value: float | None, said: str
) -> None:
    def one(rows: Any) -> Any:
        return [*rows[:2], None if value is None else [value] * 6, *rows[3:]]

    edit(root, "action", one)
    assert f"episode 0: {said}" in check(root)
    restate(root, lambda stats: stats.clear())
    (root / "meta/episodes_stats.jsonl").write_text("")
    convert(root, tmp_path / "new", "v2.1")
    assert check(tmp_path / "new") == [f"episode 0: {said}"]
    kept = [
        row for number, row in enumerate(open_dataset(root).table(0)["action"].to_pylist()) if number != 2
    ]
    made = stated(tmp_path / "new", "action")
    assert made["count"] == [6]
    assert np.allclose(made["max"], np.max(kept, axis=0))


def test_columns_that_hold_something_else_are_named_one_by_one(root: Path) -> None:
    edit(root, "action", lambda rows: pa.array([row[: 3 + k % 2] for k, row in enumerate(rows)]))
    edit(root, "action_eef", lambda rows: pa.array(["x"] * len(rows)))
    edit(root, "timestamp", lambda rows: pa.array(["x"] * len(rows)))
    said = check(root)
    assert "episode 0: rows of 'action' have lengths [3, 4], expected one" in said
    assert "episode 0: 'action_eef' is stored as string, expected numbers" in said
    assert "episode 0: 'timestamp' is stored as string, expected numbers" in said


def test_absent_and_undeclared_columns_are_told_apart(root: Path) -> None:
    table = pq.read_table(root / ROWS)
    pq.write_table(table.drop_columns(["action"]).append_column("extra", pa.array(range(7))), root / ROWS)
    said = check(root)
    assert "episode 0: there is no column 'action', though info.json declares it" in said
    assert (
        "episode 0: column 'extra' is declared nowhere in info.json: loaders pass it over, or refuse the dataset"
        in said
    )


def test_a_shape_of_no_axis_is_one_number(root: Path, tmp_path: Path) -> None:
    declare(root, "next.reward", dtype="float32", shape=[], names=["reward"])
    for index, length in enumerate((7, 5)):
        path = root / f"data/chunk-000/episode_{index:06d}.parquet"
        reward = pa.array(np.arange(length, dtype=np.float32))
        pq.write_table(pq.read_table(path).append_column("next.reward", reward), path)
    (said,) = {problem for problem in check(root) if "shape" in problem}
    assert said.startswith("feature 'next.reward' has shape []: ")
    convert(root, tmp_path / "new", "v2.1")
    assert check(tmp_path / "new") == []
    assert open_dataset(tmp_path / "new").features["next.reward"]["shape"] == [1]
    assert open_dataset(tmp_path / "new").table(0)["next.reward"].to_pylist() == list(range(7))


def test_a_feature_of_no_numbers_is_left_out_with_a_word(root: Path, tmp_path: Path) -> None:
    declare(root, "observation.environment_state", dtype="float32", shape=[0], names=None)
    for index, length in enumerate((7, 5)):
        path = root / f"data/chunk-000/episode_{index:06d}.parquet"
        empty = pa.array([[]] * length, pa.list_(pa.float32()))
        pq.write_table(pq.read_table(path).append_column("observation.environment_state", empty), path)
    assert len(check(root)) == 1
    done = convert(root, tmp_path / "new", "v3.0")
    assert done.left_out == ("feature 'observation.environment_state': its shape is [0], it holds nothing",)
    assert check(tmp_path / "new") == []
    assert "observation.environment_state" not in open_dataset(tmp_path / "new").features


def test_timestamps_within_the_tolerance_of_loaders_are_no_problem(root: Path) -> None:
    edit(root, "timestamp", lambda rows: [stamp + 0.9e-4 for stamp in rows])
    restate(root, lambda stats: None)
    assert not [problem for problem in check(root) if "k / fps" in problem]
    edit(root, "timestamp", lambda rows: [*rows[:4], *(stamp + 2e-4 for stamp in rows[4:])])
    assert "episode 0: 'timestamp' is not k / fps: row 4 has 0.40029, expected 0.4 s" in check(root)


def coded(pixels: np.ndarray, kind: str = "PNG") -> bytes:
    sink = io.BytesIO()
    Image.fromarray(pixels).save(sink, kind)
    return sink.getvalue()


def depth(number: int) -> np.ndarray:
    """Millimetres, 0 where nothing is known: the upper half."""
    made = np.zeros((HEIGHT, WIDTH), np.uint16)
    made[HEIGHT // 2 :] = 1000 * (number + 1)
    return made


def test_depth_in_a_column_counts_with_its_16_bits_and_is_shown_in_shades(
    stills: Path, tmp_path: Path
) -> None:
    edit(stills, CAM, lambda rows: [{"bytes": coded(depth(k)), "path": None} for k in range(len(rows))])
    declare(stills, CAM, shape=[HEIGHT, WIDTH, 1])
    restate(stills, lambda stats: stats.pop(CAM))
    convert(stills, tmp_path / "new", "v2.1")
    assert check(tmp_path / "new") == []
    made = stated(tmp_path / "new", CAM)
    assert {name: np.shape(made[name]) for name in ("min", "max", "mean", "std")} == dict.fromkeys(
        ("min", "max", "mean", "std"), (3, 1, 1)
    )
    assert (made["count"], made["min"][0][0][0]) == ([3], 0.0)
    assert made["max"][2][0][0] == pytest.approx(3000 / 65535)
    assert made["mean"][1][0][0] == pytest.approx(1000 / 65535)
    with open_dataset(tmp_path / "new").episode(0).pictures("cam") as pictures:
        assert sorted(np.unique(pictures[0])) == [0, 255]
    kept = open_dataset(tmp_path / "new").episode(0).images["cam"].row(1)
    assert kept is not None
    assert np.array_equal(np.asarray(Image.open(io.BytesIO(kept["bytes"]))), depth(1))


def deep_video(path: Path, frames: int) -> None:
    """Depth as LeRobot codes it: 12 bits of grey in HEVC."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(path), "w") as container:
        stream = container.add_stream(
            "libx265", rate=Fraction(10), options={"x265-params": "lossless=1:log-level=0"}
        )
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "gray12le"
        for number in range(frames):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(depth(number), format="gray12le")))
        container.mux(stream.encode())


def test_a_depth_video_as_lerobot_declares_it_is_whole(tmp_path: Path) -> None:
    root = tmp_path / "set"
    write(root, Plan("v2.1", lengths=(3,), videos=("cam",)))
    deep_video(root / f"videos/chunk-000/{CAM}/episode_000000.mp4", 3)
    declare(root, CAM, shape=[HEIGHT, WIDTH, 1], info={"is_depth_map": True})
    one = {name: [[[0.1]]] for name in ("min", "max", "mean", "std")} | {"count": [3]}
    restate(root, lambda stats: stats.update({CAM: one}))
    assert check(root) == []
    convert(root, tmp_path / "v30", "v3.0")
    assert check(tmp_path / "v30") == []
    convert(root, tmp_path / "v21", "v2.1")
    assert stated(tmp_path / "v21", CAM)["mean"] == [[[0.1]]] * 3
    restate(root, lambda stats: stats.pop(CAM))
    convert(root, tmp_path / "anew", "v2.1")
    assert stated(tmp_path / "anew", CAM)["max"][0][0][0] == pytest.approx(3000 / 4095)


def test_depth_is_not_coded_again_with_8_bits(tmp_path: Path) -> None:
    deep_video(tmp_path / "film.mp4", 3)
    assert video_statistic(tmp_path / "film.mp4", 3)["max"][0][0][0] == pytest.approx(3000 / 4095)
    with pytest.raises(RecordingError, match=r"film\.mp4 has depth of more than 8 bits"):
        encode_segment(Span(tmp_path / "film.mp4"), tmp_path / "new.mp4", 3, 10.0)


@pytest.mark.parametrize("kind", [pa.binary(), pa.large_binary()])
def test_pictures_stored_as_their_bytes_alone_are_read_and_written_as_the_format_has_them(
    stills: Path, tmp_path: Path, kind: pa.DataType
) -> None:
    edit(stills, CAM, lambda rows: pa.array([row["bytes"] for row in rows], kind))
    with open_dataset(stills).episode(0).pictures("cam") as pictures:
        assert [seen(pictures[k]) for k in range(3)] == [0, 1, 2]
    convert(stills, tmp_path / "new", "v2.1")
    assert check(tmp_path / "new") == []


def test_missing_and_turned_pictures_are_named(stills: Path) -> None:
    turned = coded(np.zeros((WIDTH, HEIGHT, 3), np.uint8))
    edit(stills, CAM, lambda rows: [rows[0], None, {"bytes": turned, "path": None}])
    said = check(stills)
    assert f"episode 0: '{CAM}' has no picture in 1 rows, the first is 1" in said
    assert (
        f"episode 0: picture 2 of '{CAM}' is {WIDTH} rows by {HEIGHT} columns, declared {HEIGHT} by {WIDTH}: "
        "rows and columns are exchanged"
    ) in said


def test_a_turned_video_is_named(tmp_path: Path) -> None:
    write(tmp_path / "set", Plan("v2.1", lengths=(3,), videos=("cam",)))
    declare(tmp_path / "set", CAM, shape=[WIDTH, HEIGHT, 3])
    assert check(tmp_path / "set") == [
        f"episode 0: '{CAM}' is {HEIGHT} rows by {WIDTH} columns, declared {WIDTH} by {HEIGHT}: "
        "rows and columns are exchanged"
    ]


@pytest.mark.parametrize("names", [["channels", "height", "width"], ["channel", "height", "width"], None])
def test_pictures_declared_with_their_channels_first_are_whole(
    tmp_path: Path, names: list[str] | None
) -> None:
    write(tmp_path / "set", Plan("v2.1", lengths=(3,), videos=("cam",), images=("wrist",)))
    for key in (CAM, "observation.images.wrist"):
        declare(tmp_path / "set", key, shape=[3, HEIGHT, WIDTH], names=names)
    assert check(tmp_path / "set") == []


def own(tmp_path: Path, column: pa.Array, dtype: str) -> Path:
    """A dataset of one episode of 7 rows with a column of its own that is declared so."""
    root = tmp_path / "set"
    write(root, Plan("v2.1", lengths=(7,), videos=()))
    table = pq.read_table(root / ROWS)
    pq.write_table(table.append_column("mine", column), root / ROWS)
    declare(root, "mine", dtype=dtype, shape=[1], names=None)
    return root


ONE_ROW = "other than one value per row"


@pytest.mark.parametrize(
    ("column", "dtype", "said"),
    [
        (pa.array([[1.0, 2.0], [], *([float(k)] for k in range(5))]), "float32", ONE_ROW),
        (pa.array([[1.0], None, [4.0, 5.0], *([float(k)] for k in range(4))]), "float32", ONE_ROW),
        (pa.array([1.7e9 + k / 10 for k in range(7)]), "float32", "cannot hold 1700000000"),
        (pa.array([1e300, *range(6)], pa.float64()), "float32", "cannot hold 1.0"),
        (pa.array(range(7), pa.int64()), "bool", "cannot hold 2"),
    ],
)
def test_values_that_a_declared_type_cannot_hold_are_refused(
    tmp_path: Path, column: pa.Array, dtype: str, said: str
) -> None:
    root = own(tmp_path, column, dtype)
    with pytest.raises(RecordingError, match=f"episode 0, column 'mine' .*{said}"):
        convert(root, tmp_path / "new", "v3.0")
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize(
    ("column", "dtype"),
    [
        (pa.array([0.1 * k for k in range(7)]), "float32"),
        (pa.array([1.7e9] * 7), "float64"),
        (pa.array([k % 2 for k in range(7)], pa.int64()), "bool"),
        (pa.array([float("nan"), *(0.5 * k for k in range(6))]), "float32"),
    ],
)
def test_values_that_it_can_hold_are_taken(tmp_path: Path, column: pa.Array, dtype: str) -> None:
    root = own(tmp_path, column, dtype)
    made = convert(root, tmp_path / "new", "v3.0")
    assert made.frames == 7


def test_a_task_number_of_two_tasks_is_refused(root: Path) -> None:
    path = root / "meta/tasks.jsonl"
    path.write_text(path.read_text() + json.dumps({"task_index": 0, "task": "another"}) + "\n")
    with pytest.raises(RecordingError, match="task_index 0 is 'task 0' and 'another'"):
        open_dataset(root)


def test_a_video_of_another_rate_than_its_rows_is_refused(tmp_path: Path) -> None:
    write(tmp_path / "set", Plan("v2.1", lengths=(8,), videos=("cam",)))
    path = next((tmp_path / "set/videos").rglob("*.mp4"))
    write_video(path, 16, fps=20.0)
    with pytest.raises(
        RecordingError, match=r"its pictures are up to 0.35 s off the rows, which come at 10 Hz"
    ):
        convert(tmp_path / "set", tmp_path / "new", "v3.0")


def test_links_that_lead_out_of_a_dataset_are_left_out_with_a_word(root: Path, tmp_path: Path) -> None:
    (tmp_path / "secret").write_text("key")
    (root / "README.md").symlink_to(tmp_path / "secret")
    (root / "notes.md").write_text("here")
    (root / "same.md").symlink_to("notes.md")
    made = convert(root, tmp_path / "new", "v3.0")
    assert not (tmp_path / "new/README.md").exists()
    assert [one for one in made.left_out if "README.md: a link to" in one]
    assert (tmp_path / "new/same.md").read_text() == "here"


def test_sound_that_a_video_loses_is_named(tmp_path: Path) -> None:
    write(tmp_path / "set", Plan("v2.1", lengths=(8,), videos=("cam",)))
    path = next((tmp_path / "set/videos").rglob("*.mp4"))
    silent = path.rename(path.with_suffix(".silent"))
    with av.open(str(silent)) as source, av.open(str(path), "w", format="mp4") as container:
        pictures = container.add_stream_from_template(source.streams.video[0])
        sound = container.add_stream("aac", rate=16_000, layout="mono")
        for packet in source.demux(video=0):
            if packet.size:
                packet.stream = pictures
                container.mux(packet)
        frame = av.AudioFrame.from_ndarray(np.zeros((1, 1024), np.float32), format="fltp", layout="mono")
        frame.rate, frame.pts = 16_000, 0
        container.mux(sound.encode(frame))
        container.mux(sound.encode(None))
    silent.unlink()
    made = convert(tmp_path / "set", tmp_path / "new", "v3.0")
    assert made.left_out == (f"audio of {path}: the video is written without it",)


@pytest.mark.parametrize("stored", [None, pa.null()])
def test_a_column_that_is_null_in_all_of_an_episode_is_named_and_copied(
    root: Path, tmp_path: Path, stored: pa.DataType | None
) -> None:
    edit(root, "action", lambda rows: pa.nulls(len(rows), stored) if stored else [None] * len(rows))
    (root / "meta/episodes_stats.jsonl").write_text("")
    assert "episode 0: 'action' is null in 7 rows, the first is 0" in check(root)
    convert(root, tmp_path / "new", "v2.1")
    assert check(tmp_path / "new") == ["episode 0: 'action' is null in 7 rows, the first is 0"]


def test_times_finer_than_those_of_python_are_kept_as_text(tmp_path: Path) -> None:
    write(tmp_path / "set", Plan("v3.0", lengths=(3, 4), videos=()))
    path = next((tmp_path / "set/meta/episodes").rglob("*.parquet"))
    table = pq.read_table(path)
    pq.write_table(table.append_column("recorded", pa.array([1, 2], pa.timestamp("ns"))), path)
    convert(tmp_path / "set", tmp_path / "new", "v2.1")
    listed = (tmp_path / "new/meta/episodes.jsonl").read_text()
    assert '"recorded": "1970-01-01 00:00:00.000000002"' in listed


def test_an_episode_is_deleted_through_a_link_that_stays(root: Path, tmp_path: Path) -> None:
    (tmp_path / "links").mkdir()
    link = tmp_path / "links" / "set"
    link.symlink_to(root)
    delete(link, [0])
    assert link.is_symlink()
    assert [path.name for path in link.parent.iterdir()] == ["set"]
    assert [entry.length for entry in open_dataset(root).episodes] == [5]


def test_rows_whose_axes_are_exchanged_are_named(root: Path, tmp_path: Path) -> None:
    kind = pa.list_(pa.list_(pa.float32()))
    edit(root, "action", lambda rows: pa.array([[row[:2], row[2:4], row[4:]] for row in rows], kind))
    declare(root, "action", shape=[2, 3], names=None)
    (root / "meta/episodes_stats.jsonl").write_text("")
    said = "'action' has rows of shape [3, 2], declared [2, 3]"
    assert f"episode 0: {said}" in check(root)
    with pytest.raises(RecordingError, match=re.escape(said)):
        convert(root, tmp_path / "new", "v2.1")


INFOS = [
    ('"total_episodes": 2', '"total_episodes": 1e999', "gives total_episodes inf, expected a whole number"),
    ('"chunks_size": 1000', '"chunks_size": 0', "gives chunks_size 0, expected a whole number from 1 on"),
    ('"splits": {', '"splits": true, "was": {', "features and splits are JSON objects"),
    ('"features": {', '"features": null, "were": {', "features and splits are JSON objects"),
    ('"shape": [6]', '"shape": 6', "expected an object with dtype and shape"),
    ('"dtype": "float32"', '"dtype": null', "expected an object with dtype and shape"),
]


@pytest.mark.parametrize(("one", "other", "said"), INFOS, ids=[other for _, other, _ in INFOS])
def test_an_info_that_is_none_is_refused_by_everything(root: Path, one: str, other: str, said: str) -> None:
    path = root / "meta/info.json"
    text = json.dumps(json.loads(path.read_text()))
    assert one in text
    path.write_text(text.replace(one, other, 1))
    assert said in check(root)[0]
    with pytest.raises(RecordingError, match=said):
        open_dataset(root)


def test_two_columns_of_one_name_are_refused(root: Path, tmp_path: Path) -> None:
    table = pq.read_table(root / ROWS)
    pq.write_table(table.append_column("action", table["action"]), root / ROWS)
    said = f"{root / ROWS} has more than one column named 'action'"
    assert f"episode 0: {said}" in check(root)
    with pytest.raises(RecordingError, match="more than one column named 'action'"):
        convert(root, tmp_path / "new", "v2.1")


@pytest.mark.parametrize("version", ["v2.1", "v3.0"])
def test_half_a_character_is_no_text(root: Path, tmp_path: Path, version: str) -> None:
    path = root / "meta/tasks.jsonl"
    path.write_text(path.read_text().replace("task 1", "task \\ud83d"))
    with pytest.raises(RecordingError, match=r"the metadata say .*task .ud83d.*, which is no text"):
        convert(root, tmp_path / "new", version)


@pytest.mark.filterwarnings("ignore::UserWarning")  # of Pillow, on tags
@pytest.mark.parametrize("kind", ["PNG", "TIFF", "JPEG"])
def test_a_damaged_picture_is_named_or_seen(stills: Path, kind: str) -> None:
    whole = coded(np.random.default_rng(1).integers(0, 255, (HEIGHT, WIDTH, 3), np.uint8), kind)
    chance = np.random.default_rng(2)
    damaged = []
    for _ in range(100):
        content = bytearray(whole)
        for place in chance.integers(0, min(len(whole), 200), 2):
            content[place] = chance.integers(0, 256)
        damaged.append({"bytes": bytes(content), "path": None})
    pictures = StoredImages("column", damaged, stills)
    said = []
    for number in range(len(pictures)):
        try:
            assert pictures[number].ndim == 3
        except RecordingError as error:
            said.append((number, str(error)))
    assert len(said) > 20
    assert [(number, error) for number, error in said if f"picture {number} " not in error] == []
