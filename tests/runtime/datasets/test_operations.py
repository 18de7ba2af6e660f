from __future__ import annotations

import functools
import json
import multiprocessing
import os
import runpy
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import av
import numpy as np
import pyarrow.parquet as pq
import pytest

from runtime.core.errors import RecordingError
from runtime.datasets import operations, staging
from runtime.datasets.consistency import check
from runtime.datasets.operations import convert, delete, merge, repair, split
from runtime.datasets.publishing import publish
from runtime.datasets.reader import open_dataset
from runtime.datasets.sidecars import attach_sidecar, sidecar_paths
from tests.runtime.datasets.foreign import Plan, column, shown, write
from tests.runtime.datasets.small import record, seen

CONFORMANCE = Path(__file__).parents[2] / "conformance"


@functools.cache
def _program(version: str) -> dict[str, Any]:
    return runpy.run_path(str(CONFORMANCE / f"read_lerobot_{version.replace('.', '')}.py"))


def stranger(dataset: Path) -> dict[str, Any]:
    """What a program that knows only the format reads."""
    version = json.loads((dataset / "meta/info.json").read_text())["codebase_version"]
    report: dict[str, Any] = json.loads(json.dumps(_program(version)["Reader"](dataset).read()))
    return report


def same(one: dict[str, Any], other: dict[str, Any]) -> bool:
    """Whether two datasets hold the same, in whatever version."""
    names = ("fps", "total_episodes", "total_frames", "features", "episodes")
    return all(one[name] == other[name] for name in names)


def coded(path: Path) -> list[bytes]:
    with av.open(str(path)) as container:
        return [bytes(packet) for packet in container.demux(video=0) if packet.size]


def statistics(dataset: Path) -> dict[int, Any]:
    lines = (dataset / "meta/episodes_stats.jsonl").read_text().splitlines()
    return {line["episode_index"]: line["stats"] for line in map(json.loads, lines)}


def shows(dataset: Path, position: int, index: int, length: int) -> bool:
    """Whether episode `position` is episode `index` of the foreign program, in rows and pictures."""
    episode = open_dataset(dataset).episode(position)
    assert episode.action is not None
    rows = np.array_equal(episode.qpos, column(index, "observation.state", length)) and np.array_equal(
        episode.action, column(index, "action", length)
    )
    pictures = []
    for camera in episode.cameras:
        with episode.pictures(camera) as sequence:
            pictures.append([seen(sequence[k]) for k in range(length)])
    return rows and pictures == [[shown(index, k) for k in range(length)]] * len(pictures)


# --- the other version -------------------------------------------------------------------------------------

SOURCES = {
    "v2.0": Plan("v2.0"),
    "v2.1": Plan("v2.1"),
    "v3.0": Plan(),
    "v3.0, short groups": Plan(gop=3, b_frames=2),
    "v3.0, fractional rate": Plan(fps=30000 / 1001),
    "v3.0, images": Plan(videos=("cam_high",), images=("cam_wrist",)),
    "v2.1, images": Plan("v2.1", videos=("cam_high",), images=("cam_wrist",)),
    "v3.0, no cameras": Plan(videos=()),
}


@pytest.mark.some(2)
@pytest.mark.parametrize("version", ["v2.1", "v3.0"])
@pytest.mark.parametrize("plan", SOURCES.values(), ids=list(SOURCES))
def test_what_others_wrote_is_the_same_in_every_version(tmp_path: Path, plan: Plan, version: str) -> None:
    write(tmp_path / "set", plan)
    made = convert(tmp_path / "set", tmp_path / "new", version)
    assert (made.version, made.episodes, made.frames) == (version, 3, sum(plan.lengths))
    assert (made.encoded, made.left_out) == ((), ())
    assert check(tmp_path / "new") == []
    assert open_dataset(tmp_path / "new").version == version
    for index, length in enumerate(plan.lengths):
        assert shows(tmp_path / "new", index, index, length)
    report = stranger(tmp_path / "new")
    assert report["broken"] == []
    assert [episode["tasks"] for episode in report["episodes"]] == [["task 0"], ["task 1"], ["task 0"]]


def test_there_and_back_nothing_has_changed(tmp_path: Path) -> None:
    for seed, (frames, task) in enumerate(((6, "stack"), (8, "sort"), (5, "stack"))):
        publish(
            record(tmp_path / "episodes", frames=frames, seed=seed, task=task),
            tmp_path / "set",
            success=seed != 1,
        )
    convert(tmp_path / "set", tmp_path / "there", "v3.0")
    convert(tmp_path / "there", tmp_path / "back", "v2.1")
    one, there, back = (stranger(tmp_path / name) for name in ("set", "there", "back"))
    assert one["broken"] == there["broken"] == back["broken"] == []
    assert same(one, there)
    assert same(one, back)
    assert statistics(tmp_path / "set") == statistics(tmp_path / "back")
    kept = [
        (tmp_path / name / "meta/eva_episodes.jsonl").read_text().splitlines() for name in ("set", "back")
    ]
    assert [json.loads(line) | {"copied_from": "there"} for line in kept[0]] == list(map(json.loads, kept[1]))
    for name in ("data/chunk-000/episode_000001.parquet", "meta/tasks.jsonl"):
        assert (tmp_path / "set" / name).read_bytes() == (tmp_path / "back" / name).read_bytes()
    first, again = (json.loads((tmp_path / name / "meta/info.json").read_text()) for name in ("set", "back"))
    assert first == again
    video = "videos/chunk-000/observation.images.cam_high/episode_000002.mp4"
    assert (tmp_path / "set" / video).read_bytes() == (tmp_path / "back" / video).read_bytes()


@pytest.mark.exhaustive
def test_the_sample_episode_goes_to_v30_and_back_with_equal_values(tmp_path: Path) -> None:
    given = os.environ.get("EVA_SAMPLE_EPISODE")
    if not given:
        pytest.skip("EVA_SAMPLE_EPISODE does not name a LeRobot v2.1 dataset to try")
    sample = Path(given)
    there = convert(sample, tmp_path / "there", "v3.0")
    assert (there.episodes, there.encoded, there.left_out) == (1, (), ())
    convert(tmp_path / "there", tmp_path / "back", "v2.1")
    assert check(tmp_path / "there") == check(tmp_path / "back") == []
    assert stranger(tmp_path / "there")["broken"] == []
    name = "data/chunk-000/episode_000000.parquet"
    one, other = (pq.read_table(root / name) for root in (sample, tmp_path / "back"))
    assert one.column_names == other.column_names
    for key in one.column_names:
        assert one[key].to_pylist() == other[key].to_pylist(), key
    for key in (f"observation.images.cam_{name}" for name in ("high", "left_wrist", "right_wrist")):
        video = f"videos/chunk-000/{key}/episode_000000.mp4"
        assert coded(sample / video) == coded(tmp_path / "back" / video)
    for name in ("meta/tasks.jsonl", "meta/episodes.jsonl"):
        lines = [(root / name).read_text().splitlines() for root in (sample, tmp_path / "back")]
        assert [json.loads(line) for line in lines[0]] == [json.loads(line) for line in lines[1]]
    before, after = statistics(sample)[0], statistics(tmp_path / "back")[0]
    for key, statistic in before.items():
        assert {figure: after[key][figure] for figure in statistic} == statistic, key


def test_features_of_others_get_the_names_that_training_code_looks_for(tmp_path: Path) -> None:
    write(tmp_path / "set", Plan("v2.1"))
    rename = {
        "observation.eef": "eef_state",
        "action_eef": "eef_action",
        "observation.images.cam_high": "observation.images.top",
    }
    convert(tmp_path / "set", tmp_path / "new", "v3.0", rename=rename)
    report = stranger(tmp_path / "new")
    assert report["broken"] == []
    assert report["policy_inputs"] == [
        "observation.state",
        "observation.images.top",
        "observation.images.cam_wrist",
    ]
    assert report["policy_outputs"] == ["action"]
    assert check(tmp_path / "new") == []
    assert shows(tmp_path / "new", 1, 1, 5)


@pytest.mark.parametrize(
    ("rename", "named"),
    [
        ({"absent": "new"}, "no feature 'absent' to rename, there are"),
        ({"action": "observation.state"}, "two features would have the same name"),
        ({"action": "a/b"}, "empty or has a slash"),
        ({"action": ""}, "empty or has a slash"),
        ({"index": "number"}, "are fixed"),
        ({"action": "index"}, "are fixed"),
    ],
)
def test_names_that_will_not_do_are_refused(tmp_path: Path, rename: dict[str, str], named: str) -> None:
    write(tmp_path / "set", Plan("v2.1"))
    with pytest.raises(RecordingError, match=named):
        convert(tmp_path / "set", tmp_path / "new", "v3.0", rename=rename)
    assert not (tmp_path / "new").exists()


def test_pictures_that_cannot_be_copied_are_coded_again_only_when_asked(tmp_path: Path) -> None:
    plan = Plan(key_frames=False)
    write(tmp_path / "set", plan)
    with pytest.raises(RecordingError, match=r"pictures of others lie between.*--reencode"):
        convert(tmp_path / "set", tmp_path / "new", "v2.1")
    assert [path.name for path in tmp_path.iterdir()] == ["set"]
    made = convert(tmp_path / "set", tmp_path / "new", "v2.1", reencode=True)
    assert len(made.encoded) == 6  # the others lie between, too: B-frames look ahead
    assert "observation.images.cam_high of episode 1" in made.encoded[2]
    assert check(tmp_path / "new") == []
    assert all(shows(tmp_path / "new", index, index, length) for index, length in enumerate(plan.lengths))


def test_what_goes_along_and_what_does_not_is_told(tmp_path: Path) -> None:
    write(tmp_path / "set", Plan("v2.1"))
    info = tmp_path / "set/meta/info.json"
    info.write_text(json.dumps(json.loads(info.read_text()) | {"license": "mit"}))
    (tmp_path / "set/README.md").write_text("ours")
    (tmp_path / "set/notes").mkdir()
    made = convert(tmp_path / "set", tmp_path / "new", "v3.0")
    assert (tmp_path / "new/README.md").read_text() == "ours"
    assert json.loads((tmp_path / "new/meta/info.json").read_text())["license"] == "mit"
    assert made.left_out == (str(tmp_path / "set/notes"),)


def test_a_column_that_is_declared_nowhere_is_told(tmp_path: Path) -> None:
    write(tmp_path / "set", Plan("v2.1", lengths=(4,)))
    path = tmp_path / "set/data/chunk-000/episode_000000.parquet"
    table = pq.read_table(path)
    pq.write_table(table.append_column("secret", table["index"]), path)
    made = convert(tmp_path / "set", tmp_path / "new", "v3.0")
    assert made.left_out == ("column 'secret': it is declared nowhere",)


def test_a_target_that_holds_something_is_refused(tmp_path: Path) -> None:
    write(tmp_path / "set", Plan("v2.1"))
    (tmp_path / "new").mkdir()
    (tmp_path / "new/thesis.tex").write_text("precious")
    with pytest.raises(RecordingError, match="is there already and not empty"):
        convert(tmp_path / "set", tmp_path / "new", "v3.0")
    with pytest.raises(RecordingError, match="written are"):
        convert(tmp_path / "set", tmp_path / "other", "v2.0")


# --- episodes to and fro -----------------------------------------------------------------------------------


@pytest.mark.some(1)
@pytest.mark.parametrize("version", ["v2.1", "v3.0"])
def test_datasets_of_any_version_are_merged_in_order(tmp_path: Path, version: str) -> None:
    plans = [Plan("v2.1", lengths=(7, 5)), Plan(lengths=(4, 6, 3))]
    for number, plan in enumerate(plans):
        write(tmp_path / f"set{number}", plan)
    made = merge([tmp_path / "set0", tmp_path / "set1"], tmp_path / "new", version)
    assert (made.episodes, made.frames) == (5, 25)
    wanted = [(0, 7), (1, 5), (0, 4), (1, 6), (2, 3)]
    assert all(shows(tmp_path / "new", k, index, length) for k, (index, length) in enumerate(wanted))
    assert check(tmp_path / "new") == []
    assert stranger(tmp_path / "new")["broken"] == []


def test_tasks_of_merged_datasets_are_numbered_once(tmp_path: Path) -> None:
    for name, tasks in (("one", ("stack", "sort")), ("two", ("wipe", "stack"))):
        for seed, task in enumerate(tasks):
            publish(record(tmp_path / "episodes", frames=4, seed=seed, task=task), tmp_path / name)
    merge([tmp_path / "one", tmp_path / "two"], tmp_path / "new")
    assert open_dataset(tmp_path / "new").tasks == {0: "stack", 1: "sort", 2: "wipe"}
    tasks = [open_dataset(tmp_path / "new").episode(k).task for k in range(4)]
    assert tasks == ["stack", "sort", "wipe", "stack"]
    assert check(tmp_path / "new") == []


@pytest.mark.parametrize(
    ("other", "named"),
    [
        (Plan("v2.1", fps=20.0), "fps is 10.0, there 20.0"),
        (Plan("v2.1", videos=("cam_high",)), "the episode has no 'observation.images.cam_wrist'"),
    ],
)
def test_what_does_not_belong_together_is_refused(tmp_path: Path, other: Plan, named: str) -> None:
    write(tmp_path / "one", Plan("v2.1"))
    write(tmp_path / "two", other)
    with pytest.raises(RecordingError, match=f"do not belong together: .*{named}"):
        merge([tmp_path / "one", tmp_path / "two"], tmp_path / "new")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["one", "two"]


def test_the_same_episode_twice_is_refused(tmp_path: Path) -> None:
    episode = record(tmp_path / "episodes", frames=4)
    publish(episode, tmp_path / "one")
    publish(episode, tmp_path / "two")
    with pytest.raises(RecordingError, match=f"there twice: .*{episode.name}"):
        merge([tmp_path / "one", tmp_path / "two"], tmp_path / "new")


def test_a_dataset_is_split_into_parts(tmp_path: Path) -> None:
    plan = Plan(lengths=(7, 5, 9, 4))
    write(tmp_path / "set", plan)
    parts = {tmp_path / "out/train": [3, 0, 1], tmp_path / "out/test": [2]}
    done = split(tmp_path / "set", parts)
    assert [(one.dataset.name, one.version, one.episodes) for one in done] == [
        ("train", "v3.0", 3),
        ("test", "v3.0", 1),
    ]
    assert all(
        shows(tmp_path / "out/train", k, index, plan.lengths[index]) for k, index in enumerate((3, 0, 1))
    )
    assert shows(tmp_path / "out/test", 0, 2, 9)
    assert check(tmp_path / "out/train") == check(tmp_path / "out/test") == []


@pytest.mark.parametrize(("indices", "named"), [([0, 0], "named twice"), ([7], "no episode 7")])
def test_a_split_of_what_is_not_there_writes_nothing(tmp_path: Path, indices: list[int], named: str) -> None:
    write(tmp_path / "set", Plan())
    with pytest.raises(RecordingError, match=named):
        split(tmp_path / "set", {tmp_path / "a": [0], tmp_path / "b": indices})
    assert [path.name for path in tmp_path.iterdir()] == ["set"]


@pytest.fixture(scope="module", params=["v2.1", "v3.0"])
def made(tmp_path_factory: pytest.TempPathFactory, request: pytest.FixtureRequest) -> Path:
    folder = tmp_path_factory.mktemp("made")
    for seed, frames in enumerate((6, 8, 5)):
        publish(record(folder / "episodes", frames=frames, seed=seed), folder / "set", version=request.param)
    return folder


@pytest.fixture
def ours(tmp_path: Path, made: Path) -> Path:
    """A dataset of three episodes of our own, with side files."""
    shutil.copytree(made, tmp_path, dirs_exist_ok=True)
    return tmp_path / "set"


def uuids(dataset: Path) -> list[str]:
    return [
        json.loads(line)["uuid"] for line in (dataset / "meta/eva_episodes.jsonl").read_text().splitlines()
    ]


@pytest.mark.some(1)
def test_deleted_episodes_are_gone_and_later_ones_move_up(ours: Path) -> None:
    names, before = uuids(ours), stranger(ours)
    made = delete(ours, [1])
    assert (made.dataset, made.episodes, made.frames) == (ours, 2, 11)
    assert uuids(ours) == [names[0], names[2]]
    assert check(ours) == []
    after = stranger(ours)
    assert after["broken"] == []
    for old, new in ((0, 0), (2, 1)):
        one, other = before["episodes"][old], after["episodes"][new]
        for key in ("observation.state", "action", "timestamp", "frame_index"):
            assert one["sums"][key] == other["sums"][key]
        assert one["brightness"] == other["brightness"]
    assert sidecar_paths(ours, names[1]) == {}
    assert "streams" in sidecar_paths(ours, names[2])
    assert sorted(path.name for path in ours.parent.iterdir()) == ["episodes", "set"]


def _renumber(root: Path, numbers: tuple[int, ...]) -> None:
    """Give the episodes of a dataset these indices, as another program may have."""
    for path in (*root.glob("meta/episodes/*/*.parquet"), *root.glob("data/*/*.parquet")):
        table = pq.read_table(path)
        place = table.column_names.index("episode_index")
        given = [numbers[index] for index in table["episode_index"].to_pylist()]
        pq.write_table(table.set_column(place, table.schema.field(place), [given]), path)
    for path in sorted(
        root.rglob("episode_*.*"), reverse=True
    ):  # of v2.x: the last first, they are in the way
        number = numbers[int(path.stem.removeprefix("episode_"))]
        path.rename(path.with_stem(f"episode_{number:06d}"))
    for path in root.glob("meta/episodes*.jsonl"):
        lines = [json.loads(line) for line in path.read_text().splitlines()]
        renumbered = [line | {"episode_index": numbers[line["episode_index"]]} for line in lines]
        path.write_text("".join(json.dumps(line) + "\n" for line in renumbered))


@pytest.mark.some(1)
@pytest.mark.parametrize("version", ["v2.1", "v3.0"])
@pytest.mark.parametrize("numbers", [(0, 1, 5), (1, 2, 3)])
def test_episodes_whose_indices_have_gaps_are_all_kept(
    tmp_path: Path, numbers: tuple[int, ...], version: str
) -> None:
    theirs = tmp_path / "theirs"
    write(theirs, Plan(version=version, lengths=(3, 4, 5)))
    _renumber(theirs, numbers)
    for written in ("v2.1", "v3.0"):
        made = convert(theirs, tmp_path / written, written, reencode=True)
        assert (made.episodes, made.frames, check(made.dataset)) == (3, 12, [])
    done = delete(theirs, [numbers[0]], reencode=True)
    assert (done.episodes, done.frames) == (2, 9)
    assert [(listed.index, listed.length) for listed in open_dataset(theirs).episodes] == [(0, 4), (1, 5)]
    assert check(theirs) == []


@pytest.mark.some(1)
def test_after_a_deletion_publishing_goes_on(ours: Path, tmp_path: Path) -> None:
    version = open_dataset(ours).version
    delete(ours, [0])
    done = publish(record(tmp_path / "episodes", frames=4, seed=9), ours)
    assert (done.episode_index, open_dataset(ours).version) == (2, version)
    assert check(ours) == []
    assert stranger(ours)["broken"] == []


@pytest.mark.parametrize(
    ("indices", "named"),
    [([0, 1, 2], "would have no episode"), ([5], "no episode 5"), ([], "no episodes of")],
)
def test_a_deletion_that_cannot_be_leaves_everything(ours: Path, indices: list[int], named: str) -> None:
    before = {path: path.read_bytes() for path in ours.rglob("*") if path.is_file()}
    with pytest.raises(RecordingError, match=named):
        delete(ours, indices)
    assert {path: path.read_bytes() for path in ours.rglob("*") if path.is_file()} == before


# --- crashes -----------------------------------------------------------------------------------------------


def _die_in(name: str, dataset: Path) -> None:
    """Delete episode 0 in a process that dies, as by a power cut, before or after the exchange."""
    real = staging._exchange

    def exchange(one: Path, other: Path) -> None:
        if name == "after":
            real(one, other)
        os._exit(9)

    staging._exchange = exchange
    delete(dataset, [0])


@pytest.mark.some(2)
@pytest.mark.parametrize(("moment", "left"), [("before", 3), ("after", 2)])
def test_a_crash_while_deleting_leaves_the_old_or_the_new_dataset(ours: Path, moment: str, left: int) -> None:
    process = multiprocessing.get_context("spawn").Process(target=_die_in, args=(moment, ours))
    process.start()
    process.join()
    assert process.exitcode == 9
    assert check(ours) == []
    assert len(open_dataset(ours).episodes) == left
    assert len(list(ours.parent.glob(".set.draft-*"))) == 1
    assert repair(ours) == []
    assert list(ours.parent.glob(".set.draft-*")) == []
    assert len(open_dataset(ours).episodes) == left


def test_a_draft_that_somebody_still_works_on_stays(ours: Path) -> None:
    with staging.Draft(ours.parent / "new", False) as draft:
        assert staging.remove_drafts(ours.parent / "new") == []
        assert draft.folder.exists()
    assert not draft.folder.exists()


def _publish(episode: Path, dataset: Path) -> None:
    publish(episode, dataset)


@pytest.mark.some(1)
@pytest.mark.slow
def test_who_waits_for_a_dataset_that_is_exchanged_publishes_into_the_new_one(
    ours: Path, tmp_path: Path
) -> None:
    episode = record(tmp_path / "episodes", frames=4, seed=9)
    process = multiprocessing.get_context("spawn").Process(target=_publish, args=(episode, ours))
    real = staging._exchange

    def exchange(one: Path, other: Path) -> None:
        process.start()  # it waits for the lock of the folder that is about to go
        process.join(3)
        real(one, other)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(staging, "_exchange", exchange)
        delete(ours, [0])
    process.join()
    assert process.exitcode == 0
    assert [entry.length for entry in open_dataset(ours).episodes] == [8, 5, 4]
    assert check(ours) == []


# --- side files --------------------------------------------------------------------------------------------


def lines(path: Path, *content: dict[str, Any]) -> Path:
    path.write_text("".join(json.dumps(line) + "\n" for line in content))
    return path


def test_streams_annotations_and_reviews_travel_with_the_dataset(tmp_path: Path) -> None:
    given = {
        "annotations": lines(tmp_path / "a.jsonl", {"from": 0, "to": 3, "label": "reach"}),
        "reviews": lines(tmp_path / "r.jsonl", {"verdict": "pass", "by": "ann"}),
    }
    episodes = [record(tmp_path / "episodes", frames=4, seed=n) for n in range(2)]
    publish(episodes[0], tmp_path / "one", sides=given)
    publish(episodes[1], tmp_path / "two", version="v3.0")
    merge([tmp_path / "one", tmp_path / "two"], tmp_path / "both", "v3.0")
    first, second = (sidecar_paths(tmp_path / "both", episode.name) for episode in episodes)
    assert sorted(first) == ["annotations", "reviews", "streams"]
    assert sorted(second) == ["streams"]
    assert first["annotations"].read_bytes() == given["annotations"].read_bytes()
    streams = pq.read_table(first["streams"])
    assert {"raw", "smoothed", "executed"} >= set(streams["stream"].to_pylist())
    assert stranger(tmp_path / "both")["broken"] == []
    assert check(tmp_path / "both") == []


def test_a_side_file_is_attached_to_a_published_episode(ours: Path, tmp_path: Path) -> None:
    name = uuids(ours)[1]
    for verdict in ("pass", "fail"):
        attach_sidecar(ours, name, "reviews", lines(tmp_path / "r.jsonl", {"verdict": verdict}))
    assert json.loads(sidecar_paths(ours, name)["reviews"].read_text()) == {"verdict": "fail"}
    attach_sidecar(ours, name, "reviews", None)
    assert sorted(sidecar_paths(ours, name)) == ["streams"]
    assert check(ours) == []


Attached = Callable[[Path, Path], object]
REFUSED: list[tuple[Attached, str]] = [
    (lambda d, p: attach_sidecar(d, "00000000-0000-0000-0000-000000000000", "reviews", p), "has no episode"),
    (lambda d, p: attach_sidecar(d, "../../etc", "reviews", p), "is no uuid"),
    (lambda d, p: attach_sidecar(d, uuids(d)[0], "thoughts", p), "no kind of side file"),
    (lambda d, p: attach_sidecar(d, uuids(d)[0], "streams", p), "cannot be attached"),
    (lambda d, p: attach_sidecar(d, uuids(d)[0], "reviews", p / "absent"), "there is no file"),
]


@pytest.mark.parametrize(("asked", "named"), REFUSED, ids=[named for _, named in REFUSED])
def test_what_cannot_be_attached_is_named(tmp_path: Path, asked: Attached, named: str) -> None:
    publish(record(tmp_path / "episodes", frames=4), tmp_path / "set")
    with pytest.raises(RecordingError, match=named):
        asked(tmp_path / "set", lines(tmp_path / "r.jsonl", {}))


def test_a_torn_side_file_is_refused(tmp_path: Path) -> None:
    (tmp_path / "r.jsonl").write_text('{"verdict": "pa')
    with pytest.raises(RecordingError, match=r"r\.jsonl, line 1 is no JSON"):
        publish(
            record(tmp_path / "episodes", frames=4), tmp_path / "set", sides={"reviews": tmp_path / "r.jsonl"}
        )
    assert not (tmp_path / "set").exists()


def test_a_side_file_of_nobody_is_found_by_the_check(ours: Path) -> None:
    shutil.copy(
        sidecar_paths(ours, uuids(ours)[0])["streams"],
        ours / "eva/streams/00000000-0000-0000-0000-000000000000.parquet",
    )
    assert any("is of an episode that is not in the dataset" in problem for problem in check(ours))


def test_a_source_that_nobody_may_write_to_is_read_all_the_same(tmp_path: Path) -> None:
    write(tmp_path / "set", Plan("v2.1"))
    before = sorted(tmp_path.joinpath("set").rglob("*"))
    operations.convert(tmp_path / "set", tmp_path / "new", "v3.0")
    assert sorted(tmp_path.joinpath("set").rglob("*")) == before


# --- what those who keep an index of datasets go by -------------------------------------------------------------


def told_of(dataset: Path) -> list[tuple[int, str | None]]:
    lines = (dataset / "meta/eva_episodes.jsonl").read_text().splitlines()
    return [(line["episode_index"], line.get("copied_from")) for line in map(json.loads, lines)]


def test_copies_say_that_they_are_copies_and_what_is_left_of_a_dataset_does_not(tmp_path: Path) -> None:
    for seed in range(3):
        publish(record(tmp_path / "episodes", frames=6, seed=seed), tmp_path / "home")
    assert told_of(tmp_path / "home") == [(0, None), (1, None), (2, None)]
    convert(tmp_path / "home", tmp_path / "copy", "v3.0")
    split(tmp_path / "copy", {tmp_path / "half": [2]})
    assert told_of(tmp_path / "copy") == [(0, "home"), (1, "home"), (2, "home")]
    assert told_of(tmp_path / "half") == [(0, "copy")]
    delete(tmp_path / "home", [1])
    assert told_of(tmp_path / "home") == [(0, None), (1, None)]


def test_what_is_published_into_a_copy_is_no_copy(tmp_path: Path) -> None:
    first = record(tmp_path / "episodes", frames=6)
    publish(first, tmp_path / "home")
    convert(tmp_path / "home", tmp_path / "copy", "v2.1")
    publish(first, tmp_path / "copy")
    assert told_of(tmp_path / "copy") == [(0, None)]


def test_nothing_is_deleted_from_a_dataset_that_has_changed(tmp_path: Path) -> None:
    dataset = tmp_path / "cups"
    write(dataset, Plan("v2.1", lengths=(4, 5, 6), videos=()))
    seen_then = operations.fingerprint(dataset)
    assert delete(dataset, [1], known=seen_then).episodes == 2
    with pytest.raises(RecordingError, match="nothing was deleted"):
        delete(dataset, [1], known=seen_then)  # the same order once more would take another episode
    assert open_dataset(dataset).info["total_episodes"] == 2


def test_every_episode_is_told_of(tmp_path: Path) -> None:
    dataset = tmp_path / "cups"
    write(dataset, Plan("v2.1", lengths=(4, 5), videos=()))
    told: list[str] = []
    convert(dataset, tmp_path / "new", "v3.0", tell=told.append)
    split(dataset, {tmp_path / "one": [1]}, tell=told.append)
    assert told == ["episode 1 of 2", "episode 2 of 2", "one: episode 1 of 1"]


@pytest.mark.parametrize("version", ["v2.1", "v3.0"])
def test_deleting_an_episode_leaves_what_it_does_not_know(tmp_path: Path, version: str) -> None:
    root = tmp_path / "set"
    write(root, Plan(version, videos=("cam_high",)))
    others = {
        ".git/HEAD": "ref",
        ".gitattributes": "lfs",
        "calibration/left/cam.yaml": "k",
        "meta/own/notes.json": "{}",
        "videos/chunk-000/depth_raw/episode_000001.npy": "x",
        "data/notes.txt": "n",
        "README.md": "read",
    }
    for name, content in others.items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(content)
    (root / "latest").symlink_to("data")
    assert delete(root, [1]).left_out == ()
    assert {name: (root / name).read_text() for name in others} == others
    assert os.readlink(root / "latest") == "data"
    assert shows(root, 1, 2, 9)
    assert len(list((root / "videos").rglob("*.mp4"))) == 2
