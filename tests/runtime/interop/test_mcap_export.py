"""An episode as MCAP: nothing of its streams is lost, and programs for ROS 2 read every message."""

import errno
import json
import os
from collections import defaultdict
from dataclasses import replace
from pathlib import Path
from typing import Any

import av
import numpy as np
import pyarrow as pa
import pytest

from runtime.core.errors import RecordingError
from runtime.interop import coded_pictures
from runtime.interop.mcap import main
from runtime.interop.mcap_export import McapSummary, export_mcap
from runtime.interop.ros2_messages import DEFINITIONS, encode, schema_name, schema_text, topic_part
from runtime.recording.base import Outcome
from runtime.recording.episode import EpisodeJournal
from runtime.recording.files import DiskFullError
from runtime.recording.labels import Label, append_label
from runtime.recording.reader import Episode, open_episode
from tests.runtime.interop.rebuilt import STREAMS, bits, messages, rebuilt
from tests.runtime.recording.samples import (
    CAMERAS,
    DIM,
    SETTINGS,
    STARTED,
    chunk,
    decoded,
    manifest,
    number_of,
    numbered,
    resealed,
    row,
    tick,
    unended,
)

pytest.importorskip("mcap_ros2.decoder", reason="mcap-ros2-support (extra dev) is not installed")

START = 1_700_000_000 * 10**9  # of `manifest` [ns]
FRAMES = 12
JOINTS = ["left_arm.joint0", "left_arm.joint1", "right_arm.joint0"]


def odd(bits: int) -> np.float32:
    """The float32 with these bits."""
    return np.array([bits], np.uint32).view(np.float32)[0]


def recorded(data: Path) -> Path:
    """A closed episode with what is odd in each column: nulls, denormals, lost times, repeats, lost chunks."""
    journal = EpisodeJournal(data / "episodes", SETTINGS)
    robot = manifest()["robot"] | {"joint_names": JOINTS}
    journal.begin(
        manifest(robot=robot, streams={"qvel": True, "effort": True, "eef": True, "eef_action": True})
    )
    assert journal.folder is not None
    folder = journal.folder
    for k in range(FRAMES):
        changes: dict[str, Any] = {"effort": np.full(DIM, 0.1 * k, np.float32)}
        if k == 3:
            changes |= {"qvel": None, "bench": '{"a": 1}', "intervention": True}
        if k == 4:
            changes |= {"captured": {"joints": STARTED + 4 / 30}, "stale": frozenset(CAMERAS[:1])}
        if k == 5:
            changes |= {"qpos": np.array([odd(1), -0.0, odd(0x7F7FFFFF)], np.float32)}
        pictures = {camera: None if k in (6, 7) else numbered(k + 1) for camera in CAMERAS}
        journal.append(row(k, pictures, **changes))
    for k in range(40):
        changes = {"smoothed": None, "chunk_ids": (), "weights": ()} if k < 4 else {}
        changes |= {"executed": None, "refused": True, "notes": ("a", "ä")} if k == 7 else {}
        changes |= {"woke": STARTED + k / 100 + 1 / 3} if k == 5 else {}
        journal.append(tick(k, **changes))
    known, lost = chunk(1, width=DIM), chunk(3, width=DIM)
    met = np.array([[0.1, np.nan]] * 4, np.float32)
    journal.append(replace(known, strategy="rtc", overlap=5, mistimed=2, ik_position_error=met))
    journal.append(replace(lost, arrival_step=-1, delay=-1, target_steps=known.target_steps * 0 - 1))
    journal.append(replace(chunk(4, width=8), space="eef", ik_flags=np.zeros((4, 2), np.uint8), eef="fk"))
    event = {"kind": "state", "text": "ä", "time": STARTED + 0.1, "step": 3, "id": "session.changed"}
    latched = {"data": {"state": "faulted", "state_is": {"latched": True}}, "arguments": {"reason": "e-stop"}}
    journal.append_event(event | latched)
    journal.append_event({"kind": "tuned_to", "text": "", "time": STARTED + 0.2, "data": {"task": "stop"}})
    journal.end(Outcome("finished", "done", 1.7e9, {"policy": {"answers": 2}}))
    append_label(data, folder.name, Label(1.8e9, "ann", "success", "good"))
    return folder


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return recorded(tmp_path_factory.mktemp("data"))


@pytest.fixture(scope="module")
def summary(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> McapSummary:
    return export_mcap(folder, tmp_path_factory.mktemp("out") / "episode.mcap")


def summary_of(path: Path) -> Any:
    from mcap.reader import make_reader

    with path.open("rb") as file:
        reader = make_reader(file)
        return reader.get_header(), reader.get_summary(), {m.name: m.metadata for m in reader.iter_metadata()}


def stamp_of(content: Any) -> int | None:
    header = getattr(content, "header", None)
    time = getattr(content, "timestamp", None) if header is None else header.stamp
    return None if time is None else time.sec * 10**9 + time.nanosec


@pytest.mark.parametrize(("name", "topic"), STREAMS.items())
def test_the_streams_are_rebuilt_from_messages_to_the_bit(
    folder: Path, summary: McapSummary, name: str, topic: str
) -> None:
    episode = open_episode(folder)
    found = rebuilt(name, episode.layout, [content for _, content in messages(summary.path)[f"/eva/{topic}"]])
    table: pa.Table = getattr(episode, name)
    assert table.num_rows > 0
    assert bits(found) == bits(table)


def test_times_are_unix_time_and_rise_within_each_topic(summary: McapSummary) -> None:
    for topic, found in messages(summary.path).items():
        stamps = [message.log_time for message, _ in found]
        assert stamps == sorted(stamps), topic
        assert all(message.publish_time == message.log_time for message, _ in found)
        assert {stamp_of(content) for _, content in found} <= {*stamps, None}
        if topic.startswith("/cameras"):
            assert len(set(stamps)) == len(stamps) == FRAMES
    states = messages(summary.path)["/left_arm/joint_states"]
    assert states[1][0].log_time == START + round((1 / 30 - 0.01) * 1e9)


def test_joints_are_by_group_with_the_names_of_the_robot(folder: Path, summary: McapSummary) -> None:
    found = messages(summary.path)
    rows = open_episode(folder).rows
    for group, columns, names in (
        ("left_arm", slice(0, 2), ["joint0", "joint1"]),
        ("right_arm", slice(2, 3), ["joint0"]),
    ):
        states = [content for _, content in found[f"/{group}/joint_states"]]
        assert [list(state.name) for state in states] == [names] * FRAMES
        for field, column in (("position", "qpos"), ("velocity", "qvel"), ("effort", "effort")):
            values = [None if not len(v := getattr(state, field)) else list(v) for state in states]
            assert values == [None if v is None else v[columns] for v in rows[column].to_pylist()]
        commands = [list(content.position) for _, content in found[f"/{group}/joint_commands"]]
        assert commands == [value[columns] for value in rows["action"].to_pylist()]
        assert len(found[f"/{group}/joint_executed"]) == 39  # nothing was sent in one tick
    message, _ = found["/left_arm/joint_executed"][0]
    assert message.log_time == START + 1_000_000


def test_a_planned_chunk_is_a_trajectory_without_dropped_rows(summary: McapSummary) -> None:
    ((message, content),) = messages(summary.path)["/left_arm/joint_trajectory"]
    assert message.log_time == START + 110_000_000  # step 11
    assert content.joint_names == ["joint0", "joint1"]
    assert [list(point.positions) for point in content.points] == [[3.0, 4.0], [6.0, 7.0], [9.0, 10.0]]
    assert [point.time_from_start.nanosec for point in content.points] == [0, 10_000_000, 20_000_000]
    assert summary.left_out == ["trajectories of 1 chunks that are not in the robot's joints"]


def test_events_estop_instruction_and_labels(folder: Path, summary: McapSummary) -> None:
    found = messages(summary.path)
    event = found["/eva/events"][0][1]
    assert (event.kind, event.text, event.id, event.step) == ("state", "ä", "session.changed", 3)
    assert json.loads(event.arguments) == {"reason": "e-stop"}
    assert json.loads(event.data)["state"] == "faulted"
    assert event.time == STARTED + 0.1
    pressed = [(message.log_time, content.data) for message, content in found["/eva/estop"]]
    assert pressed == [(START, False), (START + 100_000_000, True)]
    assert [content.data for _, content in found["/eva/instruction"]] == ["stack the blocks", "stop"]
    ((message, label),) = found["/eva/labels"]
    assert (label.time, label.by, label.result, label.note, label.discarded) == (
        1.8e9,
        "ann",
        "success",
        "good",
        False,
    )
    assert message.log_time < START + 10**9


def test_the_file_says_what_readers_of_ros_2_ask_for(folder: Path, summary: McapSummary) -> None:
    header, index, metadata = summary_of(summary.path)
    assert header.profile == "ros2"
    assert header.library.startswith("evaweb ")
    assert {schema.encoding for schema in index.schemas.values()} == {"ros2msg"}
    assert {channel.message_encoding for channel in index.channels.values()} == {"cdr"}
    assert (
        index.statistics.message_count == summary.messages == sum(map(len, messages(summary.path).values()))
    )
    assert {part.compression for part in index.chunk_indexes} == {"zstd"}
    assert json.loads(metadata["eva.manifest"]["json"]) == open_episode(folder).manifest
    assert json.loads(metadata["eva.outcome"]["json"]) == open_episode(folder).outcome
    assert summary.bytes == summary.path.stat().st_size
    assert summary.coded_again == {}
    assert summary.moved == {"/eva/raw": 4}  # a chunk that was lost is recorded after a later one


@pytest.mark.parametrize("pictures", ["video", "image-h264", "jpeg"])
def test_rosbags_reads_every_message(folder: Path, tmp_path: Path, pictures: Any) -> None:
    highlevel = pytest.importorskip("rosbags.highlevel", reason="rosbags (extra dev) is not installed")
    from rosbags.typesys import Stores, get_typestore

    made = export_mcap(folder, tmp_path / "a.mcap", pictures)
    store = get_typestore(Stores.ROS2_JAZZY)
    counts: dict[str, int] = defaultdict(int)
    with highlevel.AnyReader([made.path], default_typestore=store) as reader:
        for connection, _, data in reader.messages():
            content = reader.deserialize(data, connection.msgtype)
            assert reader.typestore.serialize_cdr(content, connection.msgtype) == data
            counts[connection.topic] += 1
    assert counts == {topic: count for topic, count in made.topics.items() if count}


def pictures_of(path: Path, topic: str) -> list[np.ndarray]:
    """The pictures of a topic, decoded packet by packet."""
    coder = av.CodecContext.create("h264", "r")
    packets = [bytes(content.data) for _, content in messages(path)[topic]]
    frames = [frame for data in packets for frame in coder.decode(av.Packet(data))]
    return [frame.to_ndarray(format="rgb24") for frame in [*frames, *coder.decode(None)]]


@pytest.mark.parametrize(("pictures", "last"), [("video", "video"), ("image-h264", "compressed")])
def test_packets_are_those_of_the_recording(folder: Path, tmp_path: Path, pictures: Any, last: str) -> None:
    made = export_mcap(folder, tmp_path / "a.mcap", pictures)
    for camera, name in zip(CAMERAS, ("front", "wrist"), strict=True):
        topic = f"/cameras/{name}/{last}"
        expected = decoded(folder / f"{camera}.mp4")
        found = pictures_of(made.path, topic)
        assert len(found) == len(expected) == FRAMES
        assert all(np.array_equal(one, other) for one, other in zip(found, expected, strict=True))
        for _, content in messages(made.path)[topic]:
            kinds = coded_pictures.nal_types(bytes(content.data))
            assert content.format == "h264"
            assert bytes(content.data).startswith(b"\0\0\0\1")
            assert 5 not in kinds or {7, 8} <= set(kinds)


def test_jpegs_show_the_rows(folder: Path, tmp_path: Path) -> None:
    import simplejpeg

    made = export_mcap(folder, tmp_path / "a.mcap", "jpeg")
    assert set(made.coded_again) == set(CAMERAS)
    found = [content for _, content in messages(made.path)["/cameras/front/compressed"]]
    numbers = [number_of(simplejpeg.decode_jpeg(bytes(content.data))) for content in found]
    assert numbers == [1, 2, 3, 4, 5, 6, 6, 6, 9, 10, 11, 12]
    assert {content.format for content in found} == {"jpeg"}
    assert {content.header.frame_id for content in found} == {CAMERAS[0]}


@pytest.mark.parametrize(
    ("codec", "reason"), [("libx264", "it has B frames"), ("mpeg4", "its codec is mpeg4")]
)
def test_other_videos_are_coded_again_and_the_summary_says_so(
    tmp_path: Path, codec: str, reason: str
) -> None:
    folder = recorded(tmp_path)
    with av.open(str(folder / f"{CAMERAS[0]}.mp4"), "w") as container:
        stream = container.add_stream(codec, rate=30)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        stream.options = {"bf": "2"} if codec == "libx264" else {}
        for k in range(FRAMES):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(numbered(k + 1), format="rgb24")))
        container.mux(stream.encode(None))
    resealed(folder)
    made = export_mcap(folder, tmp_path / "a.mcap")
    assert made.coded_again == {CAMERAS[0]: reason}
    found = pictures_of(made.path, "/cameras/front/video")
    assert [number_of(picture) for picture in found] == list(range(1, FRAMES + 1))


def test_a_lost_camera_ends_where_its_video_does(tmp_path: Path) -> None:
    folder = recorded(tmp_path)
    resealed(folder, lost_cameras={CAMERAS[1]: {"row": 5, "reason": "it died"}})
    made = export_mcap(folder, tmp_path / "a.mcap")
    assert (made.topics["/cameras/front/video"], made.topics["/cameras/wrist/video"]) == (FRAMES, 5)


@pytest.mark.parametrize("rows", [0, 1])
def test_an_episode_in_which_nothing_happened_is_a_whole_file(tmp_path: Path, rows: int) -> None:
    journal = EpisodeJournal(tmp_path / "data", SETTINGS)  # a folder whose labels nobody knows
    robot = manifest()["robot"] | {"joint_names": ["a", "b.c", "d"]}
    journal.begin(manifest(robot=robot, control_rate=None))
    folder = journal.folder
    assert folder is not None
    for k in range(rows):
        journal.append(row(k))
    journal.end(Outcome("interrupted", "nothing", 1.7e9))
    made = export_mcap(folder, tmp_path / "a.mcap")
    found = messages(made.path)
    assert {len(found[topic]) for topic in ("/robot/joint_states", "/eva/rows", "/cameras/front/video")} == {
        rows
    }
    assert [list(content.name) for _, content in found["/robot/joint_states"]] == [["a", "b.c", "d"]] * rows
    assert [content.data for _, content in found["/eva/estop"]] == [False]
    assert made.topics["/eva/labels"] == made.topics["/eva/raw"] == 0


# --- faults -----------------------------------------------------------------------------------------------------------


def left(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_every_fault_has_its_sentence_and_leaves_nothing(folder: Path, tmp_path: Path, capsys: Any) -> None:
    target = tmp_path / "out" / "a.mcap"
    assert main([str(folder), "--to", str(target)]) == 1
    assert "is no folder to write a.mcap to" in capsys.readouterr().err
    target.parent.mkdir()
    assert main([str(tmp_path / "none"), "--to", str(target)]) == 1
    assert "is no folder of an episode" in capsys.readouterr().err
    opened = recorded(tmp_path / "data")
    unended(opened)
    assert main([str(opened), "--to", str(target)]) == 1
    assert "has no outcome.json" in capsys.readouterr().err
    assert left(target.parent) == []
    assert main([str(folder), "--to", str(target)]) == 0
    assert "/eva/executed: 40" in capsys.readouterr().out
    written = target.read_bytes()
    assert main([str(folder), "--to", str(target)]) == 1
    assert "exists; an export overwrites nothing" in capsys.readouterr().err
    assert (left(target.parent), target.read_bytes()) == (["a.mcap"], written)


def test_a_full_disk_leaves_nothing(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(descriptor: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(DiskFullError, match="disk full while writing"):
        export_mcap(folder, tmp_path / "a.mcap")
    assert left(tmp_path) == []


def test_a_disk_that_fills_midway_leaves_nothing(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from mcap.writer import Writer

    def full(writer: Writer, *given: Any, **named: Any) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(Writer, "add_metadata", full)
    with pytest.raises(DiskFullError, match="disk full while writing"):
        export_mcap(folder, tmp_path / "a.mcap")
    assert left(tmp_path) == []


def test_a_file_that_appears_meanwhile_stays(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    target = tmp_path / "a.mcap"

    def other(episode: Episode, *rest: Any) -> Any:
        target.write_bytes(b"mine")
        return real(episode, *rest)

    from runtime.interop import mcap_export

    real = mcap_export.episode_topics
    monkeypatch.setattr(mcap_export, "episode_topics", other)
    with pytest.raises(RecordingError, match="exists"):
        export_mcap(folder, target)
    assert (left(tmp_path), target.read_bytes()) == (["a.mcap"], b"mine")


def test_the_draft_of_a_killed_export_is_reused(folder: Path, tmp_path: Path, summary: McapSummary) -> None:
    (tmp_path / ".a.mcap.draft").write_bytes(b"half" * 1000)
    made = export_mcap(folder, tmp_path / "a.mcap")
    assert left(tmp_path) == ["a.mcap"]
    assert made.path.read_bytes() == summary.path.read_bytes()


def test_a_damaged_recording_is_not_exported(tmp_path: Path) -> None:
    folder = recorded(tmp_path)
    raw = bytearray((folder / "raw.arrow").read_bytes())
    raw[-100] ^= 1
    (folder / "raw.arrow").write_bytes(raw)
    with pytest.raises(RecordingError):
        export_mcap(folder, tmp_path / "a.mcap")
    assert not (tmp_path / "a.mcap").exists()


def test_an_export_that_is_cancelled_leaves_nothing(folder: Path, tmp_path: Path) -> None:
    def cancel(progress: str) -> None:
        raise RuntimeError(progress)

    with pytest.raises(RuntimeError, match="0 messages written"):
        export_mcap(folder, tmp_path / "a.mcap", report=cancel)
    assert list(tmp_path.glob("*.mcap*")) + list(tmp_path.glob(".*")) == []


@pytest.mark.parametrize("wall", [None, "now", -1.0, 2.0**31, float("nan")])
def test_a_manifest_without_the_wall_clock_is_refused(tmp_path: Path, wall: Any) -> None:
    folder = recorded(tmp_path)
    path = folder / "manifest.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"started_wall": wall}))
    resealed(folder)
    with pytest.raises(RecordingError, match="started_wall"):
        export_mcap(folder, tmp_path / "a.mcap")


# --- messages ---------------------------------------------------------------------------------------------------------


def test_a_joint_state_has_the_bytes_that_others_write() -> None:
    state = {
        "header": {"stamp": {"sec": 1780000000, "nanosec": 0}, "frame_id": "arm"},
        "name": ["j1", "gripper"],
    }
    state |= {"position": [0.5, 0.04], "velocity": (), "effort": ()}
    assert encode("sensor_msgs/JointState", state).hex() == (
        "0001000000a5186a000000000400000061726d0002000000030000006a31000008000000677269707065720002000000"
        "00000000000000000000e03f7b14ae47e17aa43f0000000000000000"
    )


@pytest.mark.parametrize("kind", DEFINITIONS)
def test_known_definitions_are_those_of_ros(kind: str) -> None:
    typesys = pytest.importorskip("rosbags.typesys", reason="rosbags (extra dev) is not installed")
    store = typesys.get_typestore(typesys.Stores.ROS2_JAZZY)
    ours = typesys.get_types_from_msg(schema_text(kind), schema_name(kind))
    for name, fields in ours.items():
        if name in store.fielddefs:
            assert fields[1] == store.fielddefs[name][1]
        else:
            assert name.startswith(("evaweb_msgs/", "foxglove_msgs/"))


@pytest.mark.parametrize(
    ("name", "part"), [("cam.high", "cam_high"), ("2nd", "_2nd"), ("é", "unnamed"), ("a__b", "a__b")]
)
def test_topics_have_names_that_ros_allows(name: str, part: str) -> None:
    assert topic_part(name) == part
