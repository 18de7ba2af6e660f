"""Tables of an episode from the messages of its MCAP file alone, read by a program that is not ours."""

from __future__ import annotations

from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from runtime.recording.layout import Layout
from runtime.recording.reader import Episode
from runtime.recording.tables import SCHEMAS

STREAMS = {"raw": "raw", "smoothed": "smoothed", "ticks": "executed", "rows": "rows"}
"""Topics below /eva by table."""


def messages(path: Path) -> dict[str, list[tuple[Any, Any]]]:
    """Each message of a file with its decoded content, by topic, as they lie in the file."""
    from mcap.reader import make_reader
    from mcap_ros2.decoder import DecoderFactory

    found = defaultdict(list)
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        for _, channel, message, content in reader.iter_decoded_messages(log_time_order=False):
            found[channel.topic].append((message, content))
    return found


def rebuilt(name: str, layout: Layout, contents: list[Any]) -> pa.Table:
    """A table of the episode from the messages of its topic alone."""
    schema = SCHEMAS[name](layout)
    columns: dict[str, list[Any]] = {field.name: [] for field in schema}
    for content in sorted(contents, key=lambda content: content.row):
        for column, values in columns.items():
            group, _, stream = column.partition(".")
            if column in content.absent:
                values.append(None)
            elif group == "capture_time":
                values.append(content.capture_times[content.capture_streams.index(stream)])
            elif stream:
                values.append(getattr(content, group)[content.cameras.index(stream)])
            else:
                values.append(getattr(content, column))
    return pa.table(columns, schema=schema)


def bits(table: pa.Table) -> dict[str, Any]:
    """The columns of a table with every float as the bits that it has; NaN is one pattern only."""

    def plain(value: Any, kind: Any) -> Any:
        if value is None or isinstance(value, str):
            return value
        if isinstance(value, list):
            return [plain(item, kind.value_type) for item in value]
        return np.array(value, kind.to_pandas_dtype()).tobytes()

    return {f.name: [plain(value, f.type) for value in table[f.name].to_pylist()] for f in table.schema}


def differing_tables(path: Path, episode: Episode) -> list[str]:
    """The tables that differ in any bit from what their messages in the file say."""
    found = messages(path)
    return [
        name
        for name, topic in STREAMS.items()
        if bits(rebuilt(name, episode.layout, [content for _, content in found[f"/eva/{topic}"]]))
        != bits(getattr(episode, name))
    ]
