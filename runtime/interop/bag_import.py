"""Import of bags as episodes of a LeRobot dataset.

Rows lie on a grid of constant rate. Each has the newest message of every topic that is not later than the row (as
during a recording, where nothing later is known); nothing is interpolated. The grid begins when every topic has had a
message, and ends with the topic that ends first.
"""

from __future__ import annotations

import json
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from uuid import NAMESPACE_URL, uuid5

import numpy as np
from numpy.typing import NDArray

from robots import Robot
from runtime.core.errors import RecordingError, RuntimeFault
from runtime.core.types import Float32, Float64, UInt8
from runtime.datasets.consistency import check
from runtime.datasets.layout import INFO
from runtime.datasets.publishing import publish
from runtime.interop.bag_mapping import BagMapping, TopicSource, mapped_robot
from runtime.interop.bag_messages import FIELDS, NUMBERS, PICTURES, TEXT, PictureDecoder
from runtime.interop.bag_reader import Bag, bag_size, file_digest
from runtime.ipc.messages import ExecutedTick
from runtime.recording.base import IMPORTED, Outcome, Row
from runtime.recording.episode import EpisodeJournal
from runtime.recording.settings import RecordingSettings

Stamps = NDArray[np.int64]
Report = Callable[[str], None]
_LEAST_ROWS = 2
_ROUNDING = 1000  # [ns] Unix times in seconds as float64 are no more exact than a quarter of this


@dataclass(frozen=True, slots=True)
class ImportedBag:
    """Result for one bag: index of its episode and number of rows, or `problem`; `remarks` are sentences on gaps."""

    path: Path
    index: int = -1
    rows: int = 0
    problem: str = ""
    remarks: Sequence[str] = ()


def import_bags(
    paths: Sequence[Path],
    mapping: BagMapping,
    dataset: Path,
    report: Report = lambda progress: None,
    reserve: int = 0,
) -> list[ImportedBag]:
    """Add every bag as an episode to the dataset, which is created if it does not exist.

    A bag that cannot be imported is named with the reason, and leaves nothing; the others are imported. A bag that was
    imported before with the same mapping is written again at its index. At the end, the dataset is compared with its
    own metadata. A bag is refused if fewer than `reserve` bytes of the disk would stay free should its episode be as
    large as the bag.

    Raises:
        RecordingError: The mapping does not fit its robot, or the dataset is damaged.
    """
    robot = mapped_robot(mapping)
    results = []
    for number, path in enumerate(paths, start=1):

        def report_bag(words: str, number: int = number) -> None:
            report(f"bag {number} of {len(paths)}: {words}")

        try:
            _require_room(path, dataset.parent, reserve)
            results.append(_import_bag(path, mapping, robot, dataset, report_bag))
        except RuntimeFault as error:
            results.append(ImportedBag(path, problem=str(error)))
    if (dataset / INFO).exists():
        report("the dataset is checked")
        if problems := check(dataset):
            raise RecordingError(f"{dataset} is not whole: {problems[0]} ({len(problems)} problems)")
    return results


def _require_room(path: Path, folder: Path, reserve: int) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    try:
        size, free = bag_size(path), shutil.disk_usage(folder).free
    except OSError as error:
        raise RecordingError(f"{path}: {error}") from error
    if reserve and size + reserve > free:
        raise RecordingError(
            f"{path} has {size / 1e6:.0f} MB, and {free / 1e6:.0f} MB are free, of which {reserve / 1e6:.0f} MB "
            "stay free"
        )


def _import_bag(path: Path, mapping: BagMapping, robot: Robot, dataset: Path, report: Report) -> ImportedBag:
    digest = file_digest(path)
    identity = json.dumps([digest, mapping.model_dump()], sort_keys=True)
    scratch = Path(tempfile.mkdtemp(prefix=f".{dataset.name}.bag-", dir=dataset.parent))
    try:
        with Bag(path) as bag:
            episode = _BagEpisode(bag, mapping, robot, report)
            manifest = episode.manifest(str(uuid5(NAMESPACE_URL, identity)), digest)
            episode.write(scratch / "episodes", manifest)
        placed = publish(scratch / "episodes" / manifest["uuid"], dataset, success=mapping.success)
        return ImportedBag(path, placed.episode_index, len(episode.grid), remarks=tuple(episode.gaps()))
    finally:
        shutil.rmtree(scratch, ignore_errors=True)


@dataclass(frozen=True, slots=True, eq=False)
class _Stream:
    """Samples of a topic: their stamps [N, ns], sorted, and the joints' values [N, joints] of each of FIELDS."""

    stamps: Stamps
    fields: Mapping[str, Float64]

    def newest(self, grid: Stamps) -> Stamps:
        """Return for each time of the grid the index of the newest sample that is not later."""
        return _newest(self.stamps, grid)


def _newest(stamps: Stamps, grid: Stamps) -> Stamps:
    """Return for each time of the grid the index of the newest of the sorted stamps that is not later."""
    return np.searchsorted(stamps, grid + _ROUNDING, side="right") - 1


class _BagEpisode:
    """Episode made from one bag: its numbers in memory, its pictures read again while it is written."""

    def __init__(self, bag: Bag, mapping: BagMapping, robot: Robot, report: Report) -> None:
        self._bag, self._mapping, self._robot, self._report = bag, mapping, robot, report
        self._require_topics()
        self._stamps: dict[str, list[int]] = {topic: [] for topic in mapping.topics}
        self._values: dict[str, list[Mapping[str, Float64]]] = {topic: [] for topic in mapping.topics}
        self.task = mapping.task
        self._read()
        self._state = [self._stream(source) for source in mapping.state]
        self._action = [self._stream(source) for source in mapping.action]
        self._pictures = {
            camera: np.array(self._stamps[topic], np.int64) for camera, topic in mapping.cameras.items()
        }
        self.grid = self._make_grid()
        self._held = {camera: self._newest(stamps) for camera, stamps in self._pictures.items()}
        self._sizes = {camera: self._first_size(camera) for camera in mapping.cameras}

    def _require_topics(self) -> None:
        roles = [
            *(
                (source.topic, tuple(NUMBERS), "numbers")
                for source in (*self._mapping.state, *self._mapping.action)
            ),
            *((topic, PICTURES, "pictures") for topic in self._mapping.cameras.values()),
            *([(self._mapping.task_topic, (TEXT,), "text")] if self._mapping.task_topic else []),
        ]
        for topic, kinds, what in roles:
            kind = self._bag.kinds.get(topic)
            if kind is None:
                raise RecordingError(
                    f"{self._bag.path} has no topic {topic}; it has {', '.join(self._bag.kinds) or 'none'}"
                )
            if kind not in kinds:
                raise RecordingError(f"{topic} has {kind}, which are no {what}; allowed: {', '.join(kinds)}")

    def _read(self) -> None:
        """Read the numbers of all topics, and the stamps of pictures."""
        names = {
            source.topic: {name for one in self._sources(source.topic) for name in one.joints.values()}
            for source in (*self._mapping.state, *self._mapping.action)
        }
        for count, sample in enumerate(self._bag.samples(self._mapping.topics, self._mapping.stamps)):
            if count % 1000 == 0:
                self._report(f"{count} messages read")
            if sample.topic in names:
                numbers = NUMBERS[self._bag.kinds[sample.topic]](sample.message)
                if not numbers.names:
                    continue
                if absent := names[sample.topic] - set(numbers.names):
                    raise RecordingError(
                        f"{sample.topic}: a message has no {', '.join(sorted(absent))}; it has "
                        f"{', '.join(numbers.names)}"
                    )
                places = {name: place for place, name in enumerate(numbers.names)}
                order = [places[name] for name in sorted(names[sample.topic])]
                self._values[sample.topic].append(
                    {field: values[order] for field, values in numbers.values.items()}
                )
            elif sample.topic == self._mapping.task_topic:
                self.task = self.task or str(sample.message.data).strip()
            self._stamps[sample.topic].append(sample.stamp)
        for topic in self._mapping.topics:
            if topic != self._mapping.task_topic and not self._stamps[topic]:
                raise RecordingError(f"{topic} has no message with content")

    def _sources(self, topic: str) -> Iterator[TopicSource]:
        return (source for source in (*self._mapping.state, *self._mapping.action) if source.topic == topic)

    def _stream(self, source: TopicSource) -> _Stream:
        stamps = np.array(self._stamps[source.topic], np.int64)
        order = np.argsort(stamps, kind="stable")
        known = sorted({name for one in self._sources(source.topic) for name in one.joints.values()})
        columns = [known.index(name) for name in source.joints.values()]
        samples = self._values[source.topic]
        fields = {
            field: np.array([sample[field] for sample in samples])[order][:, columns]
            for field in FIELDS
            if all(field in sample for sample in samples)
        }
        if "position" not in fields:
            raise RecordingError(f"{source.topic}: a message has no positions")
        return _Stream(stamps[order], fields)

    def _make_grid(self) -> Stamps:
        """Return the times of the rows [ns]."""
        stamps = [
            *(stream.stamps for stream in (*self._state, *self._action)),
            *(np.sort(times) for times in self._pictures.values()),
        ]
        start, end = max(int(times[0]) for times in stamps), min(int(times[-1]) for times in stamps)
        count = int((end - start + _ROUNDING) * self._mapping.fps // 10**9) + 1 if end >= start else 0
        if not self._mapping.action:
            count -= 1  # the action of a row is the state of the next
        if count < _LEAST_ROWS:
            raise RecordingError(
                f"all topics together last {max(0, end - start) / 1e9:.2f} s, which are {max(0, count)} rows at "
                f"{self._mapping.fps:g} Hz; allowed: {_LEAST_ROWS} rows or more"
            )
        return start + np.round(np.arange(count) * (1e9 / self._mapping.fps)).astype(np.int64)

    def gaps(self) -> Iterator[str]:
        """Yield a sentence for each topic whose newest message is too old in some row."""
        named = [
            *zip((*self._mapping.state, *self._mapping.action), (*self._state, *self._action), strict=True)
        ]
        ages = {source.topic: self.grid - stream.stamps[stream.newest(self.grid)] for source, stream in named}
        for camera, stamps in self._pictures.items():
            ages[self._mapping.cameras[camera]] = self.grid - stamps[self._held[camera]]
        for topic, age in ages.items():
            old = np.flatnonzero(age > self._mapping.max_age_s * 1e9)
            if len(old):
                yield (
                    f"{topic}: {len(old)} of {len(age)} rows have a message older than {self._mapping.max_age_s:g} s, "
                    f"the oldest of {age.max() / 1e9:.2f} s in row {int(age.argmax())}"
                )

    # --- writing ---------------------------------------------------------------------------------------------

    def manifest(self, uuid: str, digest: str) -> dict[str, Any]:
        """Return the manifest of the episode; the sizes of its cameras are those of their first pictures."""
        robot, fps = self._robot, self._mapping.fps
        settings = RecordingSettings(min_free_bytes=0)
        sizes = settings.sizes(self._sizes)
        fields = set.intersection(*(set(stream.fields) for stream in self._state))
        return {
            "format": 1,
            "uuid": uuid,
            "station": IMPORTED,
            "kind": self._mapping.kind,
            "mode": "observe",
            "task": self.task,
            "robot": {
                "name": robot.name,
                "joint_names": list(robot.joint_names),
                "eef_names": [],
                "dim": robot.dim,
                "eef_dim": 0,
            },
            "fps": fps,
            "control_rate": fps,
            "cameras": {
                camera: {"width": width, "height": height} for camera, (height, width) in sizes.items()
            },
            "streams": {"qvel": "velocity" in fields, "effort": "effort" in fields},
            "capture_streams": ["joints", *self._mapping.cameras],
            "started_wall": int(self.grid[0]) / 1e9,
            "started_monotonic": 0.0,
            "configuration": {},
            "bag": {"file": self._bag.path.name, "sha256": digest, "mapping": self._mapping.model_dump()},
        }

    def _first_size(self, camera: str) -> tuple[int, int]:
        topic = self._mapping.cameras[camera]
        decoder, kind = PictureDecoder(topic), self._bag.kinds[topic]
        for number, sample in enumerate(self._bag.samples([topic], self._mapping.stamps)):
            for _, picture in decoder.add(number, kind, sample.message, wanted=True):
                return picture.shape[0], picture.shape[1]
        for _, picture in decoder.flush():
            return picture.shape[0], picture.shape[1]
        raise RecordingError(f"{topic}: none of its messages is a picture")

    def write(self, root: Path, manifest: Mapping[str, Any]) -> None:
        """Record the episode in `root`. Raises: RecordingError; what was written is then to be removed."""
        journal = EpisodeJournal(root, RecordingSettings(min_free_bytes=0), patient=True)
        journal.begin(manifest)
        try:
            qpos, fields = self._joints(self._state)
            action = (
                self._joints(self._action)[0] if self._action else np.vstack([qpos[1:], self._last_state()])
            )
            for row, pictures in enumerate(self._pictures_by_row()):
                if row % 100 == 0:
                    self._report(f"row {row} of {len(self.grid)}")
                journal.append(self._row(row, qpos, action, fields, pictures))
                at = row / self._mapping.fps
                journal.append(ExecutedTick(row, 0, at, at, row + 1, "unknown", qpos[row], None, action[row]))
        except BaseException as error:
            journal.end(Outcome("failed", f"the import failed: {error}", time.time()))
            raise
        reason = "; ".join([f"imported from {self._bag.path.name}", *self.gaps()])
        journal.end(Outcome("finished", reason, int(self.grid[-1]) / 1e9))
        if losses := journal.pop_lost_cameras():
            raise RecordingError(f"{self._bag.path}: {'; '.join(loss.text for loss in losses)}")

    def _joints(
        self, streams: Sequence[_Stream], grid: Stamps | None = None
    ) -> tuple[Float32, dict[str, Float32]]:
        """Return positions [N, D] and the other fields that all streams have, in the robot's order of joints."""
        grid = self.grid if grid is None else grid
        sources = self._mapping.state if streams is self._state else self._mapping.action
        fields = set.intersection(*(set(stream.fields) for stream in streams))
        held = {
            field: np.zeros((len(grid), self._robot.dim), np.float32) for field in FIELDS if field in fields
        }
        for source, stream in zip(sources, streams, strict=True):
            dims = [self._robot.joint_names.index(joint) for joint in source.joints]
            for field, values in held.items():
                values[:, dims] = stream.fields[field][stream.newest(grid)]
        return held.pop("position"), held

    def _last_state(self) -> Float32:
        """Return the state one period after the last row [1, D]."""
        after = self.grid[-1:] + round(1e9 / self._mapping.fps)
        return self._joints(self._state, after)[0]

    def _row(
        self,
        row: int,
        qpos: Float32,
        action: Float32,
        fields: Mapping[str, Float32],
        pictures: Mapping[str, UInt8 | None],
    ) -> Row:
        start, now = int(self.grid[0]), int(self.grid[row])
        oldest = min(int(stream.stamps[stream.newest(self.grid[row : row + 1])[0]]) for stream in self._state)
        captured = {"joints": (oldest - start) / 1e9}
        stale = set()
        for camera, places in self._held.items():
            stamp = int(self._pictures[camera][places[row]])
            captured[camera] = (stamp - start) / 1e9
            if now - stamp > self._mapping.max_age_s * 1e9:
                stale.add(camera)
        return Row(
            index=row,
            step=row,
            tick_time=row / self._mapping.fps,
            sequence=row + 1,
            qpos=qpos[row],
            action=action[row],
            captured=captured,
            pictures=pictures,
            control_source="unknown",
            qvel=fields["velocity"][row] if "velocity" in fields else None,
            effort=fields["effort"][row] if "effort" in fields else None,
            stale=frozenset(stale),
        )

    def _require_size(self, camera: str, picture: UInt8) -> None:
        size = picture.shape[:2]
        if size != self._sizes[camera]:
            (height, width), (first_height, first_width) = size, self._sizes[camera]
            raise RecordingError(
                f"{self._mapping.cameras[camera]}: a picture of {width} x {height}, the first is of {first_width} x "
                f"{first_height}"
            )

    def _newest(self, stamps: Stamps) -> Stamps:
        """Return for each row the number of the newest of some messages, which need not be in order of their stamps."""
        order = np.argsort(stamps, kind="stable")
        return np.asarray(order[_newest(stamps[order], self.grid)], np.int64)

    def _pictures_by_row(self) -> Iterator[dict[str, UInt8 | None]]:
        """Yield the pictures of each row; None for a camera whose picture is that of the row before.

        Only pictures between the row that waits for one and the newest message are in memory.
        """
        held, rows = self._held, len(self.grid)
        if not held:
            yield from ({} for _ in range(rows))
            return
        cameras = {topic: camera for camera, topic in self._mapping.cameras.items()}
        decoders = {camera: PictureDecoder(topic) for topic, camera in cameras.items()}
        wanted = {camera: set(map(int, places)) for camera, places in held.items()}
        numbers = dict.fromkeys(held, 0)
        ready: dict[str, dict[int, UInt8]] = {camera: {} for camera in held}
        row = 0

        def complete() -> Iterator[dict[str, UInt8 | None]]:
            nonlocal row
            while row < rows and all(int(places[row]) in ready[camera] for camera, places in held.items()):
                yield {
                    camera: None
                    if row and places[row] == places[row - 1]
                    else ready[camera][int(places[row])]
                    for camera, places in held.items()
                }
                row += 1
                for camera, places in held.items():
                    if row < rows and places[row] != places[row - 1]:
                        ready[camera].pop(int(places[row - 1]), None)

        for sample in self._bag.samples(list(cameras), self._mapping.stamps):
            camera = cameras[sample.topic]
            number, numbers[camera] = numbers[camera], numbers[camera] + 1
            kind = self._bag.kinds[sample.topic]
            for of, picture in decoders[camera].add(number, kind, sample.message, number in wanted[camera]):
                self._require_size(camera, picture)
                if of in wanted[camera]:
                    ready[camera][of] = picture
            yield from complete()
        for camera, decoder in decoders.items():
            ready[camera] |= {of: picture for of, picture in decoder.flush() if of in wanted[camera]}
        yield from complete()
        if row < rows:
            raise RecordingError(f"{self._bag.path}: the pictures end before row {row} of {rows}")
