"""Bags of others become episodes: which message each row has, what is refused, and that nothing is half written."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import simplejpeg

from runtime.core.errors import RecordingError
from runtime.datasets.consistency import check
from runtime.datasets.reader import open_dataset
from runtime.interop.bag import main
from runtime.interop.bag_import import import_bags
from runtime.interop.bag_mapping import BagMapping, mapped_robot, propose_mapping, read_mapping, to_toml
from runtime.interop.bag_reader import Bag
from runtime.interop.mcap_export import export_mcap
from runtime.recording.base import Outcome
from runtime.recording.episode import EpisodeJournal
from tests.runtime.recording import samples

rosbag2 = pytest.importorskip("rosbags.rosbag2", reason="rosbags (extra dev) is not installed")
rosbag1 = pytest.importorskip("rosbags.rosbag1")
typesys = pytest.importorskip("rosbags.typesys")

START = 1_700_000_000 * 10**9  # [ns]
MS = 10**6
ARM = "ur5e"
JOINTS = ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3", "gripper")
SIZE = (48, 64)
CAMERA = "/cam/image/compressed"
Message = tuple[str, str, int, Any]  # topic, type, time [ns], content


class Types:
    """Makers of messages of one version of ROS."""

    def __init__(self, store: Any, one: bool = False) -> None:
        self.store = typesys.get_typestore(store)
        self._one = one

    def make(self, kind: str, **fields: Any) -> Any:
        return self.store.types[kind](**fields)

    def header(self, stamp: int) -> Any:
        time = self.make("builtin_interfaces/msg/Time", sec=stamp // 10**9, nanosec=stamp % 10**9)
        number = {"seq": 0} if self._one else {}
        return self.make("std_msgs/msg/Header", stamp=time, frame_id="", **number)

    def joints(self, stamp: int, names: Sequence[str], position: Sequence[float], **more: Any) -> Any:
        given = {"velocity": [], "effort": []} | more
        return self.make(
            "sensor_msgs/msg/JointState",
            header=self.header(stamp),
            name=list(names),
            position=np.array(position, np.float64),
            **{key: np.array(values, np.float64) for key, values in given.items()},
        )

    def jpeg(self, stamp: int, grey: int, size: tuple[int, int] = SIZE) -> Any:
        data = simplejpeg.encode_jpeg(np.full((*size, 3), grey, np.uint8), quality=95)
        return self.make(
            "sensor_msgs/msg/CompressedImage",
            header=self.header(stamp),
            format="rgb8; jpeg compressed bgr8",
            data=np.frombuffer(data, np.uint8),
        )

    def raw(self, stamp: int, grey: int, encoding: str = "bgr8") -> Any:
        height, width = SIZE
        picture = np.zeros((height, width, 3), np.uint8)
        picture[..., 0] = grey
        return self.make(
            "sensor_msgs/msg/Image",
            header=self.header(stamp),
            height=height,
            width=width,
            encoding=encoding,
            is_bigendian=0,
            step=3 * width,
            data=picture.reshape(-1),
        )


TWO = Types(typesys.Stores.ROS2_JAZZY)
ONE = Types(typesys.Stores.ROS1_NOETIC, one=True)


def written(path: Path, messages: Sequence[Message], types: Types = TWO) -> Path:
    """A bag with these messages, in the order of their times of logging."""
    ordered = sorted(messages, key=lambda message: message[2])
    if path.suffix == ".bag":
        with rosbag1.Writer(path) as writer:
            connections: dict[str, Any] = {}
            for topic, kind, logged, content in ordered:
                if topic not in connections:
                    connections[topic] = writer.add_connection(topic, kind, typestore=types.store)
                writer.write(connections[topic], logged, types.store.serialize_ros1(content, kind))
        return path
    storage = rosbag2.StoragePlugin.MCAP if "mcap" in path.name else rosbag2.StoragePlugin.SQLITE3
    with rosbag2.Writer(path, version=9, storage_plugin=storage) as writer:
        connections = {}
        for topic, kind, logged, content in ordered:
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=types.store)
            writer.write(connections[topic], logged, types.store.serialize_cdr(content, kind))
    return path


def recorded(
    types: Types = TWO, seconds: float = 1.0, state_hz: int = 100, pictures_hz: int = 10, late: int = 0
) -> list[Message]:
    """State and commands that count up, and pictures that do; each is logged `late` [ns] after its stamp."""
    messages: list[Message] = []
    for tick in range(round(seconds * state_hz) + 1):
        stamp = START + tick * 10**9 // state_hz
        joints = types.joints(
            stamp, JOINTS[::-1], [tick + place / 10 for place in range(7)][::-1], velocity=[tick] * 7
        )
        command = types.joints(stamp, JOINTS, [-tick] * 7)
        messages.append(("/ur5e/joint_states", "sensor_msgs/msg/JointState", stamp + late, joints))
        messages.append(("/leader/joint_states", "sensor_msgs/msg/JointState", stamp + late, command))
    for frame in range(round(seconds * pictures_hz) + 1):
        stamp = START + frame * 10**9 // pictures_hz
        messages.append(
            (
                "/cam/image/compressed",
                "sensor_msgs/msg/CompressedImage",
                stamp + late,
                types.jpeg(stamp, 20 * frame),
            )
        )
    text = types.make("std_msgs/msg/String", data="stack the cups")
    messages.append(("/instruction", "std_msgs/msg/String", START, text))
    return messages


def mapping(**changes: Any) -> BagMapping:
    robot_joints = joint_names()
    named = dict(zip(robot_joints, JOINTS, strict=True))
    tree: dict[str, Any] = {
        "robot": ARM,
        "fps": 25.0,
        "task_topic": "/instruction",
        "state": [{"topic": "/ur5e/joint_states", "joints": named}],
        "action": [{"topic": "/leader/joint_states", "joints": named}],
        "cameras": {"cam_high": "/cam/image/compressed"},
    }
    return BagMapping.model_validate(
        {key: value for key, value in (tree | changes).items() if value is not None}
    )


def named(camera: str = "cam_high") -> list[Message]:
    """The same, with topics and joints called as the robot's description calls them."""
    old = dict(zip(JOINTS, (joint.rpartition(".")[2] for joint in joint_names()), strict=True))
    messages = [
        (topic.replace("/cam/image", f"/{camera}/image").replace("/leader", "/ur5e/leader"), *rest)
        for topic, *rest in recorded()
    ]
    for topic, _, _, content in messages:
        if topic.endswith("joint_states"):
            content.name = [old[name] for name in content.name]
    return messages


def joint_names() -> tuple[str, ...]:
    import robots

    return tuple(robots.load_robot(ARM).joint_names)


def rows_of(dataset: Path, index: int = 0) -> tuple[np.ndarray[Any, Any], np.ndarray[Any, Any]]:
    table = open_dataset(dataset).table(index)
    columns = (np.array(table.column(name).to_pylist()) for name in ("observation.state", "action"))
    state, action = columns
    return state, action


def greys(dataset: Path) -> list[int]:
    from runtime.datasets.mapping import ColumnMapping

    opened = open_dataset(dataset)
    names = ColumnMapping(
        state="observation.state", action="action", videos={"cam_high": "observation.images.cam_high"}
    )
    episode = opened.episode(0, names)
    with episode.pictures("cam_high") as pictures:
        return [round(float(pictures[row].mean()) / 20) for row in range(episode.length)]


@pytest.mark.parametrize(
    ("name", "types"),
    [("mcap-folder", TWO), ("sqlite", TWO), ("one.bag", ONE)],
    ids=["mcap", "sqlite", "ros1"],
)
def test_each_row_has_the_newest_message_that_is_not_later(tmp_path: Path, name: str, types: Types) -> None:
    bag = written(tmp_path / name, recorded(types, late=3 * MS), types)
    (result,) = import_bags([bag], mapping(), tmp_path / "cups")
    assert (result.index, result.rows, result.problem, result.remarks) == (0, 26, "", ())
    assert check(tmp_path / "cups") == []
    state, action = rows_of(tmp_path / "cups")
    ticks = 4 * np.arange(26)  # of 100 Hz, at 25 Hz
    np.testing.assert_allclose(state[:, :7], ticks[:, None] + np.arange(7) / 10, rtol=1e-6)
    np.testing.assert_array_equal(action[:, 0], -ticks)
    assert greys(tmp_path / "cups") == [row * 40 // 100 for row in range(26)]
    assert dict(open_dataset(tmp_path / "cups").tasks) == {0: "stack the cups"}


def test_stamps_of_the_log_are_used_where_they_are_asked_for(tmp_path: Path) -> None:
    messages = [
        (topic, kind, logged + (35 * MS if "leader" in topic else 0), content)
        for topic, kind, logged, content in recorded()
    ]
    bag = written(tmp_path / "mcap", messages)
    import_bags([bag], mapping(stamps="log", cameras={}), tmp_path / "cups")
    _, action = rows_of(tmp_path / "cups")
    assert action[0, 0] == 0  # the grid begins with the first command that was logged
    assert action[1, 0] == -4
    state, _ = rows_of(tmp_path / "cups")
    assert state[0, 0] == pytest.approx(3.0)


def test_without_commands_the_action_is_the_next_state(tmp_path: Path) -> None:
    bag = written(tmp_path / "mcap", recorded())
    (result,) = import_bags([bag], mapping(action=[], cameras={}), tmp_path / "cups")
    assert result.rows == 25
    state, action = rows_of(tmp_path / "cups")
    np.testing.assert_array_equal(action[:-1], state[1:])
    assert action[-1, 0] == pytest.approx(100.0)


def test_gaps_are_said_and_their_pictures_flagged(tmp_path: Path) -> None:
    hole = range(START + 300 * MS, START + 800 * MS)
    messages = [one for one in recorded() if not ("cam" in one[0] and one[2] in hole)]
    (result,) = import_bags([written(tmp_path / "mcap", messages)], mapping(), tmp_path / "cups")
    (remark,) = result.remarks
    assert remark.startswith("/cam/image/compressed: ")
    assert "older than 0.25 s, the oldest of 0.56 s in row 19" in remark


def test_a_bag_is_imported_once_and_bad_ones_leave_nothing(tmp_path: Path) -> None:
    good, other = (
        written(tmp_path / "mcap-1", recorded()),
        written(tmp_path / "mcap-2", recorded(seconds=0.8)),
    )
    torn = tmp_path / "torn.mcap"
    torn.write_bytes(next(good.glob("*.mcap")).read_bytes()[:5000])
    short = written(tmp_path / "mcap-3", recorded(seconds=0.03))
    reports: list[str] = []
    results = import_bags([good, torn, short, other, good], mapping(), tmp_path / "cups", reports.append)
    assert [result.index for result in results] == [0, -1, -1, 1, 0]
    assert f"{torn} cannot be read as a bag" in results[1].problem
    assert "allowed: 2 rows or more" in results[2].problem
    assert len(open_dataset(tmp_path / "cups").episodes) == 2
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "cups",
        "mcap-1",
        "mcap-2",
        "mcap-3",
        "torn.mcap",
    ]
    assert any(report.startswith("bag 4 of 5: row 0 of ") for report in reports)


@pytest.mark.parametrize(
    ("changes", "problem"),
    [
        ({"cameras": {"cam_high": "/cam/other"}}, "has no topic /cam/other; it has "),
        (
            {"cameras": {"cam_high": "/instruction"}},
            "/instruction has std_msgs/msg/String, which are no pictures",
        ),
        ({"task_topic": "/ur5e/joint_states"}, "which are no text"),
        ({"fps": 1000.0, "max_age_s": 0.1}, ""),
    ],
)
def test_topics_that_do_not_fit_are_named(tmp_path: Path, changes: dict[str, Any], problem: str) -> None:
    bag = written(tmp_path / "mcap", recorded(seconds=0.4))
    (result,) = import_bags([bag], mapping(**changes), tmp_path / "cups")
    assert problem in result.problem
    assert bool(result.problem) is bool(problem)


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        (lambda message: setattr(message, "name", ["a"] * 7), "a message has no elbow, "),
        (lambda message: setattr(message, "position", np.zeros(0)), "a message has no positions"),
    ],
)
def test_a_message_without_its_joints_is_named(
    tmp_path: Path, change: Callable[[Any], None], problem: str
) -> None:
    messages = recorded(seconds=0.4)
    change(next(content for topic, _, _, content in messages[10:] if "ur5e" in topic))
    (result,) = import_bags([written(tmp_path / "mcap", messages)], mapping(), tmp_path / "cups")
    assert f"/ur5e/joint_states: {problem}" in result.problem
    assert not (tmp_path / "cups").exists()


def test_raw_pictures_are_turned_to_rgb_and_others_named(tmp_path: Path) -> None:
    for encoding, problem in (("bgr8", ""), ("yuv422", "/cam/raw: encoding 'yuv422'; allowed: rgb8, ")):
        messages = recorded(seconds=0.4)
        for frame in range(9):
            stamp = START + frame * 50 * MS
            messages.append(("/cam/raw", "sensor_msgs/msg/Image", stamp, TWO.raw(stamp, 200, encoding)))
        bag = written(tmp_path / f"mcap-{encoding}", messages)
        (result,) = import_bags([bag], mapping(cameras={"cam_high": "/cam/raw"}), tmp_path / encoding)
        assert problem in result.problem
    names = open_dataset(tmp_path / "bgr8").features
    assert names["observation.images.cam_high"]["shape"][:2] == list(SIZE)
    assert greys(tmp_path / "bgr8")[0] == round(200 / 3 / 20)


def test_a_picture_of_another_size_is_named(tmp_path: Path) -> None:
    messages = recorded(seconds=0.4)
    stamp = START + 250 * MS
    messages.append(
        ("/cam/image/compressed", "sensor_msgs/msg/CompressedImage", stamp, TWO.jpeg(stamp, 9, (24, 32)))
    )
    (result,) = import_bags([written(tmp_path / "mcap", messages)], mapping(), tmp_path / "cups")
    assert "/cam/image/compressed: a picture of 32 x 24, the first is of 64 x 48" in result.problem


@pytest.mark.parametrize(
    ("changes", "problem"),
    [
        ({"robot": "nobody"}, "robot = 'nobody'"),
        ({"cameras": {"cam_high": "/a", "cam_low": "/a"}}, "/a is given for two cameras"),
    ],
)
def test_a_mapping_that_fits_no_robot_is_refused(changes: dict[str, Any], problem: str) -> None:
    with pytest.raises(RecordingError, match=problem):
        mapped_robot(mapping(**changes))


def test_joints_without_a_source_strange_or_twice_are_named() -> None:
    whole = mapping().state[0]
    first, *others = whole.joints
    for joints, problem in (
        ({joint: whole.joints[joint] for joint in others}, f"{first} has no source"),
        ({**whole.joints, "tail": "tail"}, "tail is no joint of the robot"),
    ):
        source = whole.model_copy(update={"joints": joints})
        with pytest.raises(RecordingError, match=problem):
            mapped_robot(mapping().model_copy(update={"state": [source]}))
    with pytest.raises(RecordingError, match=r"state: .* has two sources"):
        mapped_robot(mapping().model_copy(update={"state": [whole, whole]}))


def test_a_mapping_is_proposed_from_names_and_can_be_read_again(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    robot, messages = mapped_robot(mapping()), named()
    bag = written(tmp_path / "mcap", messages)
    with Bag(bag) as opened:
        proposed, missing = propose_mapping(opened, robot)
    assert [source.topic for source in proposed.state] == ["/ur5e/joint_states"]
    assert [source.topic for source in proposed.action] == ["/ur5e/leader/joint_states"]
    assert proposed.cameras["cam_high"] == "/cam_high/image/compressed"
    assert all(sentence.startswith("cameras: no topic is named after ") for sentence in missing)
    file = tmp_path / "mapping.toml"
    file.write_text(to_toml(proposed))
    assert read_mapping(file) == proposed
    assert main(["propose", str(bag), "--robot", ARM]) == 0
    assert capsys.readouterr().out == to_toml(proposed)
    assert main(["import", str(bag), "--mapping", str(file), "--to", str(tmp_path / "cups")]) == 0
    assert f"imported: {bag} is episode 0, 31 rows" in capsys.readouterr().out
    assert main(["import", str(file), "--mapping", str(file), "--to", str(tmp_path / "cups")]) == 1
    file.write_text('robot = "ur5e"\nstate = []\nfsp = 3\n')
    with pytest.raises(RecordingError, match=r"mapping\.toml: fsp = 3: unknown key \(did you mean fps\?\)"):
        read_mapping(file)


@pytest.mark.parametrize("pictures", ["video", "image-h264", "jpeg"])
def test_what_we_export_can_be_imported_again_row_by_row(tmp_path: Path, pictures: Any) -> None:
    robot = mapped_robot(mapping())
    cameras = [camera.key for camera in robot.cameras]
    facts = {
        "name": ARM,
        "joint_names": list(robot.joint_names),
        "eef_names": [],
        "dim": robot.dim,
        "eef_dim": 0,
    }
    told = samples.manifest(
        robot=facts,
        cameras={camera: {"width": samples.WIDTH, "height": samples.HEIGHT} for camera in cameras},
        streams={"qvel": True, "effort": False},
        capture_streams=["joints", *cameras],
        control_rate=30.0,
    )
    journal = EpisodeJournal(tmp_path / "episodes", samples.SETTINGS, patient=True)
    journal.begin(told)
    for index in range(40):
        at = samples.STARTED + index / 30
        vector = np.full(robot.dim, index, np.float32)
        journal.append(
            samples.row(
                index,
                {camera: samples.numbered(index + 1) for camera in cameras},
                qpos=vector,
                action=-vector,
                qvel=vector / 2,
                eef=None,
                eef_action=None,
                captured={"joints": at - 0.004, **dict.fromkeys(cameras, at - 0.02)},
            )
        )
    journal.end(Outcome("finished", "over", 1.7e9 + 2))
    exported = export_mcap(tmp_path / "episodes" / told["uuid"], tmp_path / "a.mcap", pictures)
    with Bag(exported.path) as bag:
        proposed, missing = propose_mapping(bag, robot)
    assert missing == []
    assert [source.topic.rpartition("/")[2] for source in (*proposed.state, *proposed.action)] == [
        "joint_states",
        "joint_commands",
    ]
    assert proposed.task_topic == "/eva/instruction"
    (result,) = import_bags([exported.path], proposed, tmp_path / "cups")
    assert (result.problem, result.remarks) == ("", ())
    state, action = rows_of(tmp_path / "cups")
    np.testing.assert_array_equal(state[:, 0], np.arange(result.rows))
    np.testing.assert_array_equal(action, -state)
    assert result.rows == 39  # no picture is later than the last row's
    assert dict(open_dataset(tmp_path / "cups").tasks) == {0: "stack the blocks"}
    video = next((tmp_path / "cups" / "videos").rglob("*.mp4"))
    assert samples.numbers(video) == list(range(1, result.rows + 1))
