"""One MCAP file per episode, which programs for ROS 2 read: profile "ros2", every channel `ros2msg` and `cdr`."""

from __future__ import annotations

import heapq
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

from mcap.writer import CompressionType, Writer

from runtime.core.durable_files import creating_durably
from runtime.core.errors import RecordingError
from runtime.interop.episode_topics import EpisodeTopics, Message, Pictures, Topic, episode_topics
from runtime.interop.ros2_messages import schema_name, schema_text
from runtime.link.release import version
from runtime.recording.files import disk_error, to_json
from runtime.recording.reader import Episode, open_episode
from runtime.recording.scrub import require_intact

_REPORT_EVERY = 1000  # messages
FORMAT = 1  # of topics and own messages, in the metadata record "eva.export"
PICTURES: tuple[Pictures, ...] = ("video", "image-h264", "jpeg")


@dataclass(frozen=True, slots=True)
class McapSummary:
    """What a file has: number of messages by topic, its size, and what is not as it was recorded.

    `coded_again` gives the reason by camera. `moved` gives the number of stamps by topic that were earlier than the one
    before, and were moved to it. `left_out` has a sentence for everything that has no topic.
    """

    path: Path
    topics: Mapping[str, int]
    bytes: int
    coded_again: Mapping[str, str]
    moved: Mapping[str, int]
    left_out: Sequence[str]

    @property
    def messages(self) -> int:
        """Number of messages in all topics."""
        return sum(self.topics.values())


def export_mcap(
    folder: Path,
    target: Path,
    pictures: Pictures = "video",
    report: Callable[[str], None] = lambda progress: None,
) -> McapSummary:
    """Write the closed episode in `folder` to the new file `target`, completely or not at all.

    `report` is called with the progress after every thousand messages; an exception from it ends the export.

    Raises:
        RecordingError: There is no episode, it is open or damaged, `target` exists, or the disk refuses the file.
    """
    episode = _closed_episode(folder)
    if not target.parent.is_dir():
        raise RecordingError(f"{target.parent} is no folder to write {target.name} to")
    if target.exists():
        raise _exists(target)
    made = episode_topics(episode, pictures)
    try:
        with creating_durably(target) as file:
            counts = _write(file, episode, made, pictures, report)
            size = file.tell()
    except FileExistsError as error:
        raise _exists(target) from error
    except OSError as error:
        raise disk_error("writing", target, error) from error
    moved = {topic.name: topic.moved for topic in made.topics if topic.moved}
    return McapSummary(target, counts, size, made.coded_again, moved, made.left_out)


def _closed_episode(folder: Path) -> Episode:
    if not folder.is_dir():
        raise RecordingError(f"{folder} is no folder of an episode")
    episode = open_episode(folder)
    if episode.outcome is None:
        raise RecordingError(f"{folder} has no outcome.json: it is being recorded, or wants repair")
    require_intact(folder)
    return episode


def _exists(target: Path) -> RecordingError:
    return RecordingError(f"{target} exists; an export overwrites nothing")


def _write(
    file: IO[bytes],
    episode: Episode,
    made: EpisodeTopics,
    pictures: Pictures,
    report: Callable[[str], None],
) -> dict[str, int]:
    """Write the whole file; return the number of messages by topic."""
    writer: Any = Writer(file, compression=CompressionType.ZSTD)
    writer.start(profile="ros2", library=f"evaweb {version()}")
    schemas = {
        kind: writer.register_schema(schema_name(kind), "ros2msg", schema_text(kind).encode())
        for kind in dict.fromkeys(topic.kind for topic in made.topics)
    }
    channels = [writer.register_channel(topic.name, "cdr", schemas[topic.kind]) for topic in made.topics]
    counts: Counter[str] = Counter({topic.name: 0 for topic in made.topics})
    for number, (message, place) in enumerate(_merged(made.topics)):
        if number % _REPORT_EVERY == 0:
            report(f"{number} messages written")
        name = made.topics[place].name
        writer.add_message(
            channels[place], message.stamp, message.payload, publish_time=message.stamp, sequence=counts[name]
        )
        counts[name] += 1
    for record, content in _metadata(episode, made, pictures).items():
        writer.add_metadata(record, content)
    writer.finish()
    return dict(counts)


def _merged(topics: Sequence[Topic]) -> Iterator[tuple[Message, int]]:
    """Yield the messages of all topics, each with the place of its topic, in the order of their stamps."""

    def placed(topic: Topic, place: int) -> Iterator[tuple[Message, int]]:
        return ((message, place) for message in topic.messages)

    parts = [placed(topic, place) for place, topic in enumerate(topics)]
    return heapq.merge(*parts, key=lambda one: one[0].stamp)


def _metadata(episode: Episode, made: EpisodeTopics, pictures: Pictures) -> dict[str, dict[str, str]]:
    """Return the metadata records: manifest and outcome as JSON, and what was done to the pictures."""
    outcome = episode.outcome or {}
    return {
        "eva.manifest": {"json": to_json(episode.manifest, "the manifest").decode()},
        "eva.outcome": {"json": to_json(outcome, "the outcome").decode()},
        "eva.export": {
            "format": str(FORMAT),
            "episode": episode.layout.uuid,
            "pictures": pictures,
            "coded_again": to_json(made.coded_again, "the export").decode(),
            "left_out": to_json({"sentences": made.left_out}, "the export").decode(),
        },
    }
