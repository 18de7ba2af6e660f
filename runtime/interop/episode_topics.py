"""Topics of an exported episode: what each has, as encoded messages in the order of their stamps."""

from __future__ import annotations

import itertools
import json
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np
import pyarrow as pa

from runtime.core.errors import RecordingError
from runtime.interop import coded_pictures
from runtime.interop.episode_times import EpisodeTimes, Ordered, Seconds, Stamps, seconds
from runtime.interop.ros2_messages import encode, to_header, to_time, topic_part
from runtime.recording.labels import read_labels
from runtime.recording.reader import Episode

Pictures = Literal["video", "image-h264", "jpeg"]
_ONE_GROUP = "robot"  # name of the group if joints do not name theirs
_CAMERA_PREFIX = "observation.images."
_CAMERA_FLAGS = ("repeated", "lost", "stale")
_CAPTURE = "capture_time."


class Message(NamedTuple):
    """Encoded message with its stamp in Unix time [ns]."""

    stamp: int
    payload: bytes


@dataclass(frozen=True, slots=True)
class Topic:
    """One topic: its message type without "msg/", its messages, and how many stamps had to be moved to rise."""

    name: str
    kind: str
    messages: Iterable[Message]
    moved: int = 0


@dataclass(frozen=True, slots=True)
class EpisodeTopics:
    """Topics of an episode, the cameras that were coded again and why, and what no topic could be made of."""

    topics: Sequence[Topic]
    coded_again: Mapping[str, str]
    left_out: Sequence[str]


def episode_topics(episode: Episode, pictures: Pictures) -> EpisodeTopics:
    """Return the topics of a closed episode. Nothing is encoded before the messages are read.

    Raises RecordingError if the manifest lacks something or a video cannot be used; so does reading the messages.
    """
    times = EpisodeTimes(episode)
    topics = [*_joint_topics(episode, times)]
    trajectories, left_out = _trajectory_topics(episode, times)
    topics += trajectories
    topics += _stream_topics(episode, times)
    topics += _event_topics(episode, times)
    cameras, coded_again = _camera_topics(episode, times, pictures)
    return EpisodeTopics([*topics, *cameras], coded_again, left_out)


# --- joints -----------------------------------------------------------------------------------------------------------


class _Group(NamedTuple):
    topic: str
    names: Sequence[str]
    columns: Sequence[int]


def _groups(episode: Episode) -> list[_Group]:
    """Return the groups of joints, from names such as "left_arm.joint0"."""
    robot = episode.manifest["robot"]
    names = robot.get("joint_names") if isinstance(robot, Mapping) else None
    if not isinstance(names, list) or len(names) != episode.layout.dim:
        raise RecordingError(f"manifest: robot.joint_names is {names!r}, must be {episode.layout.dim} names")
    parts = [str(name).partition(".") for name in names]
    if not all(group and joint for group, _, joint in parts):
        return [_Group(_ONE_GROUP, [str(name) for name in names], range(len(names)))]
    columns: dict[str, list[int]] = {}
    for column, (group, _, _) in enumerate(parts):
        columns.setdefault(group, []).append(column)
    topics = _distinct(columns)
    return [
        _Group(topics[group], [parts[column][2] for column in chosen], chosen)
        for group, chosen in columns.items()
    ]


def _joint_topics(episode: Episode, times: EpisodeTimes) -> Iterator[Topic]:
    rows, ticks = episode.rows, episode.ticks
    tick_time = seconds(rows["tick_time"])
    column = f"{_CAPTURE}joints"
    captured = seconds(rows[column]) if column in rows.column_names else tick_time
    measured = times.ordered(captured, tick_time)
    commanded = times.ordered(tick_time)
    executed = times.ordered(seconds(ticks["sent"]), seconds(ticks["planned"]))
    columns = {name: _values(rows, name) for name in ("qpos", "action")}
    columns |= {name: _values(rows, name) for name in ("qvel", "effort") if name in episode.layout.streams}
    done = _values(ticks, "executed")
    none: Sequence[Any] = [None] * rows.num_rows
    for group in _groups(episode):
        state = (columns["qpos"], columns.get("qvel", none), columns.get("effort", none))
        yield _joint_states(f"/{group.topic}/joint_states", group, measured, *state)
        yield _joint_states(f"/{group.topic}/joint_commands", group, commanded, columns["action"])
        yield _joint_states(f"/{group.topic}/joint_executed", group, executed, done)


def _joint_states(
    topic: str,
    group: _Group,
    times: Ordered,
    position: Sequence[Any],
    velocity: Sequence[Any] | None = None,
    effort: Sequence[Any] | None = None,
) -> Topic:
    """Return a topic of JointState; rows without a position have no message."""
    chosen = list(group.columns)

    def part(values: Sequence[Any] | None, row: int) -> Any:
        vector = None if values is None else values[row]
        return () if vector is None else vector[chosen].astype(np.float64)

    def messages() -> Iterator[Message]:
        for row, stamp in enumerate(times.stamps.tolist()):
            if position[row] is None:
                continue
            values: dict[str, Any] = {"header": to_header(stamp), "name": group.names}
            values["position"] = part(position, row)
            values |= {"velocity": part(velocity, row), "effort": part(effort, row)}
            yield Message(stamp, encode("sensor_msgs/JointState", values))

    return Topic(topic, "sensor_msgs/JointState", messages(), times.moved)


# --- chunks -----------------------------------------------------------------------------------------------------------


class _Chunk(NamedTuple):
    """Chunk of joints on the timeline: time of its arrival, and time and action of each planned row."""

    arrival: float
    times: Seconds
    actions: Sequence[Any]


def _trajectory_topics(episode: Episode, times: EpisodeTimes) -> tuple[list[Topic], list[str]]:
    """Return the planned rows of every chunk that is in joints, and a sentence about those that are not."""
    groups = _groups(episode)
    chunks, others = _chunks(episode, times)
    arrivals = times.ordered(np.array([chunk.arrival for chunk in chunks], np.float64))
    topics = [_trajectories(group, chunks, arrivals) for group in groups] if chunks else []
    return topics, [f"trajectories of {others} chunks that are not in the robot's joints"] if others else []


def _chunks(episode: Episode, times: EpisodeTimes) -> tuple[list[_Chunk], int]:
    """Return the chunks in the robot's joints that arrived, and the number of those in another space or width."""
    raw = episode.raw
    ids, arrivals, targets = (
        np.asarray(raw[name].to_numpy(), np.int64) for name in ("chunk_id", "arrival_step", "target_step")
    )
    spaces, actions = raw["space"].to_pylist(), _values(raw, "action")
    bounds = [0, *(np.flatnonzero(np.diff(ids)) + 1).tolist(), len(ids)] if len(ids) else []
    chunks, others = [], 0
    for first, end in itertools.pairwise(bounds):
        rows = [row for row in range(first, end) if targets[row] >= 0]
        if arrivals[first] < 0 or not rows:
            continue
        if spaces[first] != "joint" or any(len(actions[row]) != episode.layout.dim for row in rows):
            others += 1
            continue
        arrival = float(times.at_steps(arrivals[first : first + 1])[0])
        chunks.append(_Chunk(arrival, times.at_steps(targets[rows]), [actions[row] for row in rows]))
    return chunks, others


def _trajectories(group: _Group, chunks: Sequence[_Chunk], arrivals: Ordered) -> Topic:
    chosen, kind = list(group.columns), "trajectory_msgs/JointTrajectory"

    def messages() -> Iterator[Message]:
        for chunk, stamp in zip(chunks, arrivals.stamps.tolist(), strict=True):
            points = [
                {"positions": action[chosen].astype(np.float64), "velocities": (), "accelerations": ()}
                | {"effort": (), "time_from_start": to_time(round((time - chunk.arrival) * 1e9))}
                for time, action in zip(chunk.times.tolist(), chunk.actions, strict=True)
            ]
            values = {"header": to_header(stamp), "joint_names": group.names, "points": points}
            yield Message(stamp, encode(kind, values))

    return Topic(f"/{group.topic}/joint_trajectory", kind, messages(), arrivals.moved)


# --- streams ----------------------------------------------------------------------------------------------------------


def _stream_topics(episode: Episode, times: EpisodeTimes) -> Iterator[Topic]:
    """Return the topics with all columns of the tables.

    Rows of raw and smoothed actions have no times of their own: their messages have the times of their steps.
    """
    ticks, raw = episode.ticks, episode.raw
    arrival, observed = (
        np.asarray(raw[name].to_numpy(), np.int64) for name in ("arrival_step", "observation_step")
    )
    smoothed = np.asarray(episode.smoothed["step"].to_numpy(), np.int64)
    for name, kind, table, ordered in (
        ("raw", "RawAction", raw, times.ordered(times.at_steps(np.where(arrival < 0, observed, arrival)))),
        ("smoothed", "SmoothedAction", episode.smoothed, times.ordered(times.at_steps(smoothed))),
        ("executed", "ExecutedTick", ticks, times.ordered(seconds(ticks["sent"]), seconds(ticks["planned"]))),
    ):
        yield _table_topic(f"/eva/{name}", f"evaweb_msgs/{kind}", table, ordered)
    yield _rows_topic(episode, times)


def _table_topic(topic: str, kind: str, table: Any, times: Ordered) -> Topic:
    columns = {field.name: (_values(table, field.name), _empty(field.type)) for field in table.schema}

    def messages() -> Iterator[Message]:
        for row, stamp in enumerate(times.stamps.tolist()):
            values: dict[str, Any] = {"header": to_header(stamp), "row": row}
            absent = []
            for name, (column, empty) in columns.items():
                value = column[row]
                if value is None:
                    absent.append(name)
                values[name] = empty if value is None else value
            yield Message(stamp, encode(kind, values | {"absent": absent}))

    return Topic(topic, kind, messages(), times.moved)


def _rows_topic(episode: Episode, times: EpisodeTimes) -> Topic:
    """Return the topic of rows.arrow, whose columns by stream and by camera become sequences."""
    rows, cameras, streams = episode.rows, list(episode.layout.cameras), list(episode.layout.capture_streams)
    sets = {"capture_times": [f"{_CAPTURE}{stream}" for stream in streams]}
    sets |= {flag: [f"{flag}.{camera}" for camera in cameras] for flag in _CAMERA_FLAGS}
    single = [name for name in rows.column_names if not any(name in names for names in sets.values())]
    columns = {name: _values(rows, name) for name in rows.column_names}
    empty = {field.name: _empty(field.type) for field in rows.schema}
    unrecorded = {name: () for name in ("qvel", "effort", "eef", "eef_action") if name not in columns}
    ordered = times.ordered(seconds(rows["tick_time"]))
    kind = "evaweb_msgs/Row"

    def value(name: str, row: int) -> Any:
        found = columns[name][row]
        return empty[name] if found is None else found

    def messages() -> Iterator[Message]:
        for row, stamp in enumerate(ordered.stamps.tolist()):
            values = {name: value(name, row) for name in single}
            values |= {part: [value(name, row) for name in names] for part, names in sets.items()}
            values |= {"header": to_header(stamp), "row": row, "capture_streams": streams, "cameras": cameras}
            absent = [name for name, column in columns.items() if column[row] is None]
            yield Message(stamp, encode(kind, values | unrecorded | {"absent": absent}))

    return Topic("/eva/rows", kind, messages(), ordered.moved)


def _values(table: Any, name: str) -> Sequence[Any]:
    """Return the values of a column by row: vectors of numbers as arrays, and None where it is null.

    Raises RecordingError for a vector with a null in it, which no message can have.
    """
    column = table[name].combine_chunks()
    if not (pa.types.is_list(column.type) or pa.types.is_fixed_size_list(column.type)):
        return list(column.to_pylist())
    if column.flatten().null_count:
        raise RecordingError(f"column {name} has a null within a row, which cannot be exported")
    if not pa.types.is_primitive(column.type.value_type):
        return list(column.to_pylist())
    values = column.values.to_numpy(zero_copy_only=False)
    if pa.types.is_fixed_size_list(column.type):
        width = column.type.list_size
        starts = (np.arange(len(column) + 1) + column.offset) * width
    else:
        starts = column.offsets.to_numpy()
    valid = column.is_valid().to_numpy(zero_copy_only=False)
    return [values[starts[row] : starts[row + 1]] if valid[row] else None for row in range(len(column))]


def _empty(kind: Any) -> Any:
    """Return the value that a message has in place of null."""
    if pa.types.is_list(kind) or pa.types.is_fixed_size_list(kind):
        return ()
    if pa.types.is_string(kind):
        return ""
    if pa.types.is_boolean(kind):
        return False
    return math.nan if pa.types.is_floating(kind) else 0


# --- events -----------------------------------------------------------------------------------------------------------


def _event_topics(episode: Episode, times: EpisodeTimes) -> Iterator[Topic]:
    events = episode.events
    started = episode.layout.started
    since = np.array([_number(event.get("time")) - started for event in events], np.float64)
    ordered = times.ordered(since)
    yield Topic("/eva/events", "evaweb_msgs/Event", _events(events, ordered.stamps), ordered.moved)
    pressed: list[tuple[int, object]] = [(times.start, False)]
    said: list[tuple[int, object]] = [(times.start, str(episode.manifest.get("task") or ""))]
    for event, stamp in zip(events, np.maximum(ordered.stamps, times.start).tolist(), strict=True):
        data = event.get("data")
        if not isinstance(data, Mapping):
            continue
        meaning, task = data.get("state_is"), data.get("task")
        if event.get("kind") == "state" and isinstance(meaning, Mapping):
            pressed.append((stamp, meaning.get("latched") is True))
        if event.get("kind") == "tuned_to" and isinstance(task, str):
            said.append((stamp, task))
    yield Topic("/eva/estop", "std_msgs/Bool", _changes("std_msgs/Bool", pressed))
    yield Topic("/eva/instruction", "std_msgs/String", _changes("std_msgs/String", said))
    yield Topic("/eva/labels", "evaweb_msgs/Label", _labels(episode, times))


def _events(events: Sequence[Mapping[str, Any]], stamps: Stamps) -> Iterator[Message]:
    for event, stamp in zip(events, stamps.tolist(), strict=True):
        step = event.get("step")
        values: dict[str, Any] = {name: _text(str(event.get(name) or "")) for name in ("kind", "text", "id")}
        values |= {name: _json(event.get(name) or {}) for name in ("arguments", "data")}
        values |= {"step": step if isinstance(step, int) else -1, "time": _number(event.get("time"))}
        values["header"] = to_header(stamp)
        yield Message(stamp, encode("evaweb_msgs/Event", values))


def _changes(kind: str, values: Sequence[tuple[int, object]]) -> Iterator[Message]:
    """Yield the first value, and each that differs from the one before."""
    before: object = None
    for stamp, value in values:
        if value != before:
            text = _text(value) if isinstance(value, str) else value
            yield Message(stamp, encode(kind, {"data": text}))
        before = value


def _labels(episode: Episode, times: EpisodeTimes) -> Iterator[Message]:
    """Yield people's labels, at the end of the episode: days later a viewer's time line would have days of nothing."""
    if episode.path.absolute().parent.name != "episodes":
        return
    last = [seconds(episode.ticks["planned"]), seconds(episode.rows["tick_time"])]
    end = times.ordered(np.array([max((float(part[-1]) for part in last if len(part)), default=0.0)]))
    stamp = int(end.stamps[0])
    for label in read_labels(episode.path.absolute().parents[1], episode.layout.uuid):
        texts = {"by": label.by, "result": label.result or "", "note": label.note}
        values: dict[str, Any] = {name: _text(text) for name, text in texts.items()}
        values |= {"header": to_header(stamp), "time": label.time, "discarded": label.discarded}
        yield Message(stamp, encode("evaweb_msgs/Label", values))


def _number(value: object) -> float:
    return float(value) if isinstance(value, (int, float)) else math.nan


def _text(text: str) -> str:
    """Return `text` without halves of surrogate pairs, which UTF-8 cannot have."""
    return text.encode(errors="replace").decode()


def _json(value: object) -> str:
    return json.dumps(value)


# --- cameras ----------------------------------------------------------------------------------------------------------


def _camera_topics(
    episode: Episode, times: EpisodeTimes, pictures: Pictures
) -> tuple[list[Topic], dict[str, str]]:
    topics, again = [], {}
    names = _distinct([camera.removeprefix(_CAMERA_PREFIX) for camera in episode.layout.cameras])
    tick_time = seconds(episode.rows["tick_time"])
    for (camera, video), name in zip(episode.videos.items(), names.values(), strict=True):
        frames, column = episode.frame_count(camera), f"{_CAPTURE}{camera}"
        captured = seconds(episode.rows[column]) if column in episode.rows.column_names else tick_time
        # A picture that is repeated has the capture time of the first: the next nanosecond keeps their order.
        ordered = times.ordered(captured[:frames], tick_time[:frames], apart=True)
        reason = "" if frames == 0 else coded_pictures.why_not_copied(video, frames)
        if pictures == "jpeg":
            reason = "pictures as JPEG were asked for"
            coded = coded_pictures.jpegs(video, frames) if frames else iter(())
        elif reason:
            coded = coded_pictures.coded_again(video, frames, episode.layout.fps)
        else:
            coded = coded_pictures.copied_packets(video, frames)
        if reason:
            again[camera] = reason
        make = _video if pictures == "video" else _images("jpeg" if pictures == "jpeg" else "h264")
        kind = "foxglove_msgs/CompressedVideo" if pictures == "video" else "sensor_msgs/CompressedImage"
        topic = f"/cameras/{name}/{'video' if pictures == 'video' else 'compressed'}"
        topics.append(Topic(topic, kind, make(camera, coded, ordered.stamps), ordered.moved))
    return topics, again


def _video(camera: str, coded: Iterator[bytes], stamps: Stamps) -> Iterator[Message]:
    for stamp, data in zip(stamps.tolist(), coded, strict=True):
        values = {"timestamp": to_time(stamp), "frame_id": camera, "data": data, "format": "h264"}
        yield Message(stamp, encode("foxglove_msgs/CompressedVideo", values))


def _images(form: str) -> Callable[[str, Iterator[bytes], Stamps], Iterator[Message]]:
    def messages(camera: str, coded: Iterator[bytes], stamps: Stamps) -> Iterator[Message]:
        for stamp, data in zip(stamps.tolist(), coded, strict=True):
            values = {"header": to_header(stamp, camera), "format": form, "data": data}
            yield Message(stamp, encode("sensor_msgs/CompressedImage", values))

    return messages


def _distinct(names: Iterable[str]) -> dict[str, str]:
    """Return the part of a topic's name for each of the names; no two are equal."""
    found: dict[str, str] = {}
    for name in names:
        part = base = topic_part(name)
        number = 1
        while part in found.values():
            number += 1
            part = f"{base}_{number}"
        found[name] = part
    return found
