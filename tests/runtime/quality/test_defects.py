"""Episodes that are good but for one thing: that one is flagged where it is, and nothing else."""

import json
import shutil
import tracemalloc

import numpy as np
import pytest

from runtime.core.errors import RecordingError
from runtime.quality.inspection import check_episode
from runtime.quality.settings import QualitySettings, read_settings
from tests.runtime.quality import built
from tests.runtime.quality.built import FPS, FRAMES, at, late, record, shown
from tests.runtime.recording.samples import unsealed


@pytest.fixture(scope="module")
def good(tmp_path_factory):
    return record(tmp_path_factory.mktemp("good"))


def found(folder, settings=None):
    """kind, severity, first, last, stream of each flag but remarks."""
    report = check_episode(folder, settings)
    return [
        (flag.kind, flag.severity, flag.first, flag.last, flag.stream)
        for flag in report.flags
        if flag.severity != "info"
    ]


def test_a_good_episode_is_clean(good):
    report = check_episode(good)
    assert report.flags == ()
    assert report.clean
    assert report.frames == FRAMES
    assert report.figures["tracking_lag_s"] == pytest.approx(built.LAG / FPS)
    assert report.figures["largest_skew_s"] == pytest.approx(0.018)
    assert any("limits are not checked" in sentence for sentence in report.unchecked)


def nan(dim):
    def spoil(vector):
        vector = vector.copy()
        vector[dim] = np.nan
        return vector

    return spoil


def add(dim, amount):
    def spoil(vector):
        vector = vector.copy()
        vector[dim] += amount
        return vector

    return spoil


def black(index):
    return np.zeros((built.HEIGHT, built.WIDTH, 3), np.uint8)


def grey(index):
    return np.full((built.HEIGHT, built.WIDTH, 3), 128, np.uint8)


DEFECTS = {
    "a clock that goes back": (
        at(range(40, 41), tick_time=lambda time: time - 0.1),
        {("time_order", "error", 40, 40, "tick_time"), ("gap", "warning", 41, 41, "tick_time")},
    ),
    "a gap": (
        at(range(50, FRAMES), tick_time=lambda time: time + 0.1),
        {("gap", "warning", 50, 50, "tick_time")},
    ),
    "skew": (late({"cam_wrist": 0.1}, range(10)), {("skew", "warning", 0, 9, "")}),
    "a stale picture": (
        late({"cam_high": 0.7}, range(10)),
        {("skew", "warning", 0, 9, ""), ("stale", "warning", 0, 9, "cam_high")},
    ),
    "a stream captured backwards": (
        late({"joints": 0.045}, range(30, 31)),
        {("time_order", "error", 30, 30, "capture_time.joints")},
    ),
    "a state that is not finite": (at(range(10, 13), qpos=nan(1)), {("not_finite", "error", 10, 12, "qpos")}),
    "a pose that is not finite": (at(range(10, 12), eef=nan(0)), {("not_finite", "warning", 10, 11, "eef")}),
    "a quaternion of no length": (at(range(5, 8), eef=add(3, -0.5)), {("quaternion", "error", 5, 7, "eef")}),
    "a jump of a joint": (
        at(range(44, 45), qpos=add(0, 0.6)),
        {("jump", "warning", 44, 45, "qpos")},
    ),
    "a jump of an end effector": (
        at(range(44, FRAMES), eef=add(0, 0.2)),
        {("jump", "warning", 44, 44, "eef")},
    ),
    "a joint that does not follow": (
        at(range(FRAMES), action=add(1, 0.3)),
        {("tracking", "warning", 0, FRAMES - 16, "action")},
    ),
    "black pictures": (shown(range(30, 33), black), {("black", "warning", 30, 32, "cam_high")}),
    "a camera that stays black": (shown(range(30, FRAMES), black), {("black", "error", 30, 89, "cam_high")}),
    "pictures of nothing": (shown(range(30, 33), grey), {("uniform", "warning", 30, 32, "cam_high")}),
    "a camera that freezes": (
        shown(range(30, 75), lambda index: built.picture(30)),
        {("frozen", "warning", 30, 75, "cam_high")},
    ),
    "a camera without new pictures": (
        shown(range(30, 60), lambda index: None),
        {("frozen", "error", 30, 59, "cam_high"), ("duplicate", "warning", 30, 59, "cam_high")},
    ),
}


@pytest.mark.some(4)
@pytest.mark.parametrize("name", DEFECTS)
def test_one_defect_is_flagged_where_it_is_and_nothing_else(tmp_path, name):
    spoil, expected = DEFECTS[name]
    assert set(found(record(tmp_path, spoil))) == expected


def test_a_drawn_camera_that_nothing_moves_before_is_not_frozen(tmp_path):
    drawn = {"configuration": {"transport": {"simulated": True}}}
    idle = shown(range(30, 75), lambda index: built.picture(30))
    assert found(record(tmp_path, idle, **drawn)) == []
    silent = record(tmp_path, shown(range(30, 60), lambda index: None), **drawn)
    assert ("frozen", "error", 30, 59, "cam_high") in found(silent)


def test_a_camera_of_half_the_rate_is_flagged_once(tmp_path):
    twice = shown(range(FRAMES), lambda index: built.picture(index - index % 2))
    flags = check_episode(record(tmp_path, twice)).flags
    assert [(flag.kind, flag.severity, flag.stream) for flag in flags] == [
        ("duplicate", "warning", "cam_high")
    ]
    assert 0.3 < flags[0].value <= 0.5


def test_who_stands_at_the_start_and_the_end_is_flagged(tmp_path):
    def rest(index, row):
        moment = min(max(index, 45), 90)
        row["qpos"], row["action"] = built.wanted(moment - built.LAG), built.wanted(moment)

    flags = check_episode(record(tmp_path, rest, frames=180)).flags
    kinds = {flag.kind: flag for flag in flags if flag.kind.startswith("idle")}
    assert kinds["idle_head"].first == 0
    assert kinds["idle_head"].value == pytest.approx(45 / FPS, abs=0.1)
    assert kinds["idle_tail"].last == 179
    assert kinds["idle_tail"].value == pytest.approx(90 / FPS, abs=0.3)


def test_a_robot_that_never_moves_is_an_error(tmp_path):
    still = record(tmp_path, lambda index, row: row.update(qpos=built.wanted(0), action=built.wanted(0)))
    assert ("idle", "error", 0, FRAMES - 1, "qpos") in found(still)


def test_one_picture_proves_nothing_where_the_robot_stands(tmp_path):
    def rest(index, row):
        row.update(qpos=built.wanted(0), action=built.wanted(0))
        row["pictures"] = {camera: built.picture(0) for camera in built.CAMERAS}

    assert {kind for kind, *_ in found(record(tmp_path, rest))} == {"idle"}


def test_an_arm_at_its_limit_is_flagged_only_while_its_group_moves(tmp_path):
    import robots

    robot = robots.load_robot("ur5e")
    names = list(robot.joint_names)
    described = {"name": "ur5e", "joint_names": names, "dim": robot.dim, "eef_dim": 8, "eef_names": ["p"] * 8}

    def push(index, row):
        stirring = min(index, 100) / FPS
        row["qpos"] = np.array(
            robot.poses["home"] if "home" in robot.poses else next(iter(robot.poses.values()))
        )
        row["qpos"][0] += 0.3 * stirring
        row["action"] = row["qpos"].copy()
        row["action"][2] = robot.upper[2] if index >= 10 else row["action"][2]
        row["qvel"] = np.zeros(robot.dim)
        row["qpos"], row["action"] = row["qpos"].astype(np.float32), row["action"].astype(np.float32)

    report = check_episode(
        record(tmp_path, push, robot=described, configuration={"robot": "ur5e"}, frames=120)
    )
    assert report.unchecked == ()
    saturated = [flag for flag in report.flags if flag.kind == "saturation"]
    assert [flag.stream for flag in saturated] == ["action"]
    assert names[2] in saturated[0].text
    assert saturated[0].first == 10
    assert saturated[0].last <= 100 + 6


def test_a_joint_that_rests_at_its_limit_from_the_start_is_where_it_belongs(tmp_path):
    resting = built.record_of(tmp_path, "agilex_piper")  # at home two joints of each arm are at a limit
    report = check_episode(resting)
    assert report.unchecked == ()
    assert report.flags == ()


def test_too_short_and_empty_episodes_say_so(tmp_path):
    assert ("too_short", "warning", 0, 9, "") in found(record(tmp_path, frames=10))
    empty = found(record(tmp_path, frames=0))
    assert ("too_short", "error", -1, -1, "") in empty


def test_the_bounds_of_a_collection_go_before_the_usual_ones(tmp_path):
    schema = {"max_skew_s": 0.01, "min_length_s": 5.0}
    kinds = {kind for kind, *_ in found(record(tmp_path, collection=schema))}
    assert kinds == {"skew", "too_short"}


def test_missing_pictures_rows_and_videos_are_errors(good, tmp_path):
    cut = tmp_path / good.name
    shutil.copytree(good, cut)
    (cut / "cam_high.mp4").unlink()
    assert [flag.text for flag in check_episode(cut).flags if flag.kind == "damaged"] == [
        "cam_high.mp4 is absent"
    ]
    unsealed(cut)
    assert found(cut) == [("video", "error", -1, -1, "cam_high")]

    unsealed(cut, frames=FRAMES + 5)
    kinds = {kind for kind, *_ in found(cut)}
    assert kinds == {"video", "unreadable"}


def test_a_video_shorter_than_the_table_is_an_error(good, tmp_path):
    short = record(tmp_path, frames=FRAMES - 20)
    mixed = tmp_path / "mixed" / good.name
    shutil.copytree(good, mixed)
    shutil.copy(short / "cam_high.mp4", mixed / "cam_high.mp4")
    unsealed(mixed)
    assert found(mixed) == [("video_length", "error", FRAMES - 20, FRAMES - 1, "cam_high")]


def test_a_longer_video_is_only_a_remark(good, tmp_path):
    short = record(tmp_path, frames=FRAMES - 20)
    shutil.copy(good / "cam_high.mp4", short / "cam_high.mp4")
    unsealed(short)
    report = check_episode(short)
    assert [(flag.kind, flag.severity) for flag in report.flags] == [("video_length", "info")]
    assert report.clean


def test_a_damaged_video_is_an_error_from_its_frame_on(good, tmp_path):
    damaged = tmp_path / good.name
    shutil.copytree(good, damaged)
    video = damaged / "cam_high.mp4"
    content = bytearray(video.read_bytes())
    half = len(content) // 2
    content[half : half + 4000] = bytes(4000)
    video.write_bytes(content)
    kinds = {kind for kind, _, _, _, stream in found(damaged) if stream == "cam_high"}
    assert kinds & {"undecodable", "video_length"}


def test_pictures_of_another_size_than_declared_are_errors(good, tmp_path):
    folder = tmp_path / good.name
    shutil.copytree(good, folder)
    told = json.loads((folder / "manifest.json").read_text())
    told["cameras"]["cam_high"] = {"width": 64, "height": 48}
    (folder / "manifest.json").write_text(json.dumps(told))
    unsealed(folder)
    assert found(folder) == [("dimensions", "error", 0, 0, "cam_high")]


def test_vectors_of_another_width_than_declared_cannot_be_read(good, tmp_path):
    folder = tmp_path / good.name
    shutil.copytree(good, folder)
    told = json.loads((folder / "manifest.json").read_text())
    told["robot"]["dim"] = 3
    (folder / "manifest.json").write_text(json.dumps(told))
    assert "unreadable" in {kind for kind, *_ in found(folder)}


def test_an_unfinished_episode_is_judged_as_far_as_it_goes(good, tmp_path):
    folder = tmp_path / good.name
    shutil.copytree(good, folder)
    (folder / "outcome.json").unlink()
    assert found(folder) == [("unfinished", "error", -1, -1, "")]
    assert check_episode(folder).frames == FRAMES


def test_a_failed_recording_is_an_error_and_an_interrupted_run_a_remark(tmp_path):
    assert found(record(tmp_path, status="failed")) == [("recording_failed", "error", -1, -1, "")]
    assert check_episode(record(tmp_path, status="interrupted")).clean


def test_a_folder_without_a_manifest_is_no_episode(tmp_path):
    with pytest.raises(RecordingError, match=r"manifest\.json"):
        check_episode(tmp_path)


@pytest.mark.exhaustive
def test_memory_does_not_grow_with_the_episode(tmp_path):
    plain = {"cam_high": {"width": built.WIDTH, "height": built.HEIGHT}}
    peaks = []
    for frames in (60, 300):
        folder = record(tmp_path, frames=frames, cameras=plain, capture_streams=["joints", "cam_high"])
        check_episode(folder)  # imports and caches are not the episode's
        tracemalloc.start()
        check_episode(folder)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < peaks[0] + 200_000


def test_settings_are_read_whole_or_refused_by_name(tmp_path):
    path = tmp_path / "quality.toml"
    path.write_text("max_skew_s = 0.2\n")
    assert read_settings(path) == QualitySettings(max_skew_s=0.2)
    path.write_text("max_skwe_s = 0.2\n")
    with pytest.raises(RecordingError, match="max_skwe_s"):
        read_settings(path)
    with pytest.raises(RecordingError, match="there is no file"):
        read_settings(tmp_path / "absent.toml")
