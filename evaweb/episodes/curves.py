"""Curves of an episode on the clock of its videos: measured, raw, smoothed and executed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from evaweb.core.binary_frames import Stream, encode
from evaweb.core.errors import NotFound
from evaweb.episodes.bench import milestones_reached
from evaweb.episodes.chunks import chunk_arrays
from evaweb.episodes.manifest_robot import drawn_robot_for, robot_of_manifest
from runtime.recording.reader import Episode, open_episode
from runtime.recording.summary import HELD

Array = NDArray[Any]


# Events that reveal nothing about the policy.
_OPEN_MARKS = ("command", "estopped", "released", "truth")
_JUDGED = ("truth",)  # hidden until the operator has scored


def curve_message(
    folder: Path,
    *,
    covered: bool = False,
    unscored: bool = False,
    milestones: Sequence[tuple[float, str]] = (),
) -> bytes:
    """Return one message of evaweb.core.binary_frames with the curves of a recording.

    Times are seconds of the video, in which row k is at k / fps. Vectors are stored joint by joint (one row per joint).
    The streams are:

    * ticks, at the control rate: time f8 [M]; measured, smoothed and executed f4 [D, M] (NaN if nothing was planned or
      sent); safety u1 [M] (1 changed, 2 refused); chunk i4 [M], the one with the largest weight (-1 no chunk, 0 the
      held target); makers i4 [M + 1]: tick k consists of the entries makers[k] to makers[k + 1] of stream makers.
    * makers: chunk i4 [W], weight f4 [W].
    * raw, if the policy answers in joints: time f8 [R], values f4 [D, R], chunk i4 [R].
    * chunks: see evaweb.episodes.chunks.

    Args:
        folder: Folder of the recording.
        covered: Omit all data that reveal the policy, as if its answers had not been recorded.
        unscored: Omit the data of the ground truth that reveal the outcome.
        milestones: (time of the run [s], text) as scored; if empty, those of the ground truth are marked.

    Raises:
        RecordingError: Names the absent or damaged file.
    """
    return curve_streams(
        open_episode(folder, videos=False), covered=covered, unscored=unscored, milestones=milestones
    )


def curve_streams(
    episode: Episode,
    *,
    covered: bool = False,
    unscored: bool = False,
    milestones: Sequence[tuple[float, str]] = (),
) -> bytes:
    """Return the message that `curve_message` describes, for an episode that is opened already.

    The other arguments are those of `curve_message`.
    """
    start = _start(episode)
    if covered:
        episode = _redacted(episode)
    contributions, makers = _contribution_ranges(episode)
    streams = {
        "ticks": _ticks(episode, start, contributions),
        "makers": makers,
        "raw": _raw(episode, start),
        "chunks": chunk_arrays(episode, lambda steps: _times_of(episode, steps) - start),
    }
    names = robot_of_manifest(episode.manifest).get("joint_names")
    holds = hold_spans(episode.rows.column("control_source").to_pylist(), episode.layout.fps)
    return encode(
        streams,
        joints=names if isinstance(names, list) else [f"joint {k}" for k in range(episode.layout.dim)],
        **_numbers(episode),
        frames=episode.frames,
        fps=episode.layout.fps,
        period=_period(episode),
        held=holds,
        marks=[
            *_marks(episode, start, _JUDGED if unscored else ()),
            *_interventions(episode),
            *_milestones(episode, unscored, [(_played(at, holds), label) for at, label in milestones]),
        ],
    )


def _redacted(episode: Episode) -> Episode:
    """Return the episode without the policy's answers, the plans made from them, and revealing events."""
    events = tuple(
        {**event, "text": str(event.get("text", "")).partition(",")[0]}
        for event in episode.events
        if event.get("kind") in _OPEN_MARKS
    )
    chunk = episode.ticks.schema.get_field_index("chunk_id")
    nobody = pa.array(np.full(episode.ticks.num_rows, -1), episode.ticks.schema.field(chunk).type)
    ticks = episode.ticks.set_column(chunk, episode.ticks.schema.field(chunk), nobody)
    return replace(
        episode,
        raw=episode.raw.slice(0, 0),
        smoothed=episode.smoothed.slice(0, 0),
        ticks=ticks,
        events=events,
    )


def _numbers(episode: Episode) -> dict[str, Any]:
    """Return the units of the joints (`units`) and the indices of the gripper joints (`grippers`).

    If the robot's description has changed since the recording, each unit is "" and no joint counts as a gripper.
    """
    try:
        drawn = drawn_robot_for(episode.manifest)
    except NotFound:
        return {"units": [""] * episode.layout.dim, "grippers": []}
    return {"units": list(drawn.units), "grippers": list(drawn.robot.gripper_dims)}


def _start(episode: Episode) -> float:
    """Return the start of the videos on the clock of the tables [s]."""
    for table, name in ((episode.ticks, "planned"), (episode.rows, "tick_time")):
        if table.num_rows:
            return float(table.column(name)[0].as_py())
    return 0.0


def vectors(table: Any, name: str, width: int) -> Array:
    """Return a column of vectors joint by joint: float32 [W, N], NaN if null."""
    column = table.column(name).combine_chunks()
    values = np.full((table.num_rows, width), np.nan, np.float32)
    valid = np.asarray(column.is_valid().to_numpy(zero_copy_only=False), bool)
    values[valid] = column.flatten().to_numpy(zero_copy_only=False).reshape(-1, width)
    return np.ascontiguousarray(values.T)


def _requested_rows(episode: Episode) -> tuple[Array, Array]:
    """Return the index of the tick of each row of the smoothed stream, and whether that tick was recorded."""
    steps = episode.ticks.column("step").to_numpy()
    requested = episode.smoothed.column("step").to_numpy()
    places = np.searchsorted(steps, requested)
    recorded = places < len(steps)
    recorded[recorded] = steps[places[recorded]] == requested[recorded]
    return places, recorded


def _contribution_ranges(episode: Episode) -> tuple[Array, Stream]:
    """Return the boundaries of each tick's contributions (int32 [M + 1]), and all contributions in order."""
    places, recorded = _requested_rows(episode)
    table = episode.smoothed.filter(recorded)
    chunk_ids, weights = (table.column(name).combine_chunks() for name in ("chunk_ids", "weights"))
    counts = np.zeros(episode.ticks.num_rows, np.int64)
    counts[places[recorded]] = chunk_ids.value_lengths().to_numpy(zero_copy_only=False)
    arrays = {
        "chunk": chunk_ids.flatten().to_numpy(zero_copy_only=False).astype(np.int32),
        "weight": weights.flatten().to_numpy(zero_copy_only=False).astype(np.float32),
    }
    return np.concatenate([[0], np.cumsum(counts)]).astype(np.int32), Stream(arrays=arrays)


def _ticks(episode: Episode, start: float, contributions: Array) -> Stream:
    ticks, dim = episode.ticks, episode.layout.dim
    smoothed = np.full((dim, ticks.num_rows), np.nan, np.float32)
    places, recorded = _requested_rows(episode)
    smoothed[:, places[recorded]] = vectors(episode.smoothed, "smoothed", dim)[:, recorded]
    changed = np.asarray([bool(changes) for changes in ticks.column("changes").to_pylist()], np.uint8)
    refused = ticks.column("refused").to_numpy(zero_copy_only=False).astype(np.uint8)
    return Stream(
        arrays={
            "time": ticks.column("planned").to_numpy() - start,
            "measured": vectors(ticks, "qpos", dim),
            "smoothed": smoothed,
            "executed": vectors(ticks, "executed", dim),
            "safety": np.maximum(changed, 2 * refused).astype(np.uint8),
            "chunk": ticks.column("chunk_id").to_numpy().astype(np.int32),
            "makers": contributions,
        }
    )


def _raw(episode: Episode, start: float) -> Stream:
    """Return the raw actions of the policy by step.

    Rows that were dropped, and chunks that are not in joint space, are omitted. Times are counted from `start` [s].
    """
    raw, dim = episode.raw, episode.layout.dim
    spaces = sorted(set(raw.column("space").to_pylist()))
    lengths = raw.column("action").combine_chunks().value_lengths().to_numpy(zero_copy_only=False)
    joints = np.asarray([space == "joint" for space in raw.column("space").to_pylist()], bool)
    used = (raw.column("target_step").to_numpy() >= 0) & joints & (lengths == dim)
    table = raw.filter(used)
    values = table.column("action").combine_chunks().flatten().to_numpy(zero_copy_only=False)
    time = _times_of(episode, table.column("target_step").to_numpy()) - start
    return Stream(
        json={"spaces": spaces, "rows": raw.num_rows},
        arrays={
            "time": time,
            "values": np.ascontiguousarray(values.reshape(-1, dim).T.astype(np.float32)),
            "chunk": table.column("chunk_id").to_numpy().astype(np.int32),
        },
    )


def _times_of(episode: Episode, steps: Array) -> Array:
    """Return the time of each control step on the clock of the tables.

    Steps outside the recording are extrapolated by the control rate.
    """
    ticks = episode.ticks
    if not ticks.num_rows:
        return np.zeros(len(steps))
    recorded, planned = ticks.column("step").to_numpy(), ticks.column("planned").to_numpy()
    period = _period(episode)
    beyond = np.clip(steps - recorded[-1], 0, None) * period - np.clip(recorded[0] - steps, 0, None) * period
    times: Array = np.interp(steps, recorded, planned) + beyond
    return times


def _period(episode: Episode) -> float:
    """Return the period of the control loop [s]."""
    rate = episode.manifest.get("control_rate")
    return 1.0 / rate if isinstance(rate, int | float) and rate > 0 else 1.0 / episode.layout.fps


def hold_spans(sources: Sequence[str], fps: float) -> list[list[float]]:
    """Return the spans [s] during which the robot was not asked to move."""
    return _spans([source in HELD for source in sources], fps)


def _spans(flags: Sequence[bool], fps: float) -> list[list[float]]:
    edges = np.flatnonzero(np.diff(np.concatenate([[0], np.asarray(flags, np.int8), [0]])))
    return [
        [float(first) / fps, float(end) / fps] for first, end in zip(edges[::2], edges[1::2], strict=True)
    ]


def _interventions(episode: Episode) -> list[dict[str, Any]]:
    """Return marks of the spans in which a person intervened; [] if a person drove the robot throughout."""
    if "intervention" not in episode.rows.column_names:
        return []
    spans = _spans(
        [bool(flag) for flag in episode.rows.column("intervention").to_pylist()], episode.layout.fps
    )
    whole = episode.rows.num_rows / episode.layout.fps
    return [
        {"time": begin, "kind": "intervention", "text": f"a person intervenes for {end - begin:.1f} s"}
        for begin, end in spans
        if end - begin < whole
    ]


def _marks(episode: Episode, start: float, without: Sequence[str]) -> list[dict[str, Any]]:
    """Return the events except kinds `without`; events without a time are omitted."""
    marks = []
    for event in episode.events:
        time = event.get("time")
        if event.get("kind") in without:
            continue
        if isinstance(time, int | float) and not isinstance(time, bool):
            at = max(0.0, float(time) - episode.layout.started - start)
            marks.append({"time": at, "kind": str(event.get("kind", "")), "text": str(event.get("text", ""))})
    return marks


def _played(at: float, holds: Sequence[Sequence[float]]) -> float:
    """Return the video time at run time `at` [s]: the run's clock stops while the robot is held."""
    for begin, end in holds:
        if begin <= at:
            at += end - begin
    return at


def _milestones(
    episode: Episode, unscored: bool, scored: Sequence[tuple[float, str]]
) -> list[dict[str, Any]]:
    """Return marks of the milestones, at the times at which they were reached.

    Marks of the scored milestones are returned if there are any. Otherwise the marks come from the ground truth of a
    simulated bench; there are none if these must stay hidden (`unscored`).
    """
    labelled = list(scored)
    if not labelled and not unscored:
        fps = episode.layout.fps
        labelled = [(row / fps, name.replace("_", " ")) for name, row in milestones_reached(episode)]
    return [{"time": time, "kind": "milestone", "text": f"reached: {label}"} for time, label in labelled]
