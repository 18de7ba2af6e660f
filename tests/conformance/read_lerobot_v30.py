"""Reads a LeRobot v3.0 dataset by the description of the format alone, as a program that knows nothing of us.

python read_lerobot_v30.py DATASET prints one JSON object: per episode its length, task, the sum of every numeric
column and the mean brightness of every frame of every video; for the dataset its totals and every broken promise.
Without DATASET it answers each line of its input, which names one.
"""

import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import av
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

INDICES = {
    "timestamp": "float32",
    "frame_index": "int64",
    "episode_index": "int64",
    "index": "int64",
    "task_index": "int64",
}
TOLERANCE = 1e-4
FIGURES: dict[str, Callable[..., Any]] = {
    "min": np.nanmin,
    "max": np.nanmax,
    "mean": np.nanmean,
    "std": np.nanstd,
}
QUANTILES = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}


def every(folder):
    """All parquet files of a folder of chunks as one table, in order."""
    return pa.concat_tables([pq.ParquetFile(path).read() for path in sorted(folder.glob("*/*.parquet"))])


def numbers(column):
    column = column.combine_chunks()
    if pa.types.is_fixed_size_list(column.type) or pa.types.is_list(column.type):
        return np.array(column.flatten()).reshape(len(column), -1)
    return column.to_numpy(zero_copy_only=False)


class Reader:
    def __init__(self, root):
        self.root = root
        self.broken = []
        self.info = json.loads((root / "meta/info.json").read_text())
        self.features = self.info["features"]
        self.episodes = every(root / "meta/episodes").to_pylist()
        tasks = pq.read_table(root / "meta/tasks.parquet")
        (index,) = json.loads(tasks.schema.metadata[b"pandas"])["index_columns"]
        self.tasks = dict(zip(tasks["task_index"].to_pylist(), tasks[index].to_pylist(), strict=True))
        self.rows = every(root / "data")
        self.videos = [key for key, feature in self.features.items() if feature["dtype"] == "video"]
        self.stats = json.loads((root / "meta/stats.json").read_text())

    def expect(self, holds, sentence):
        if not holds:
            self.broken.append(sentence)

    def read(self):
        self.metadata()
        self.numbering()
        self.together()
        return {
            "version": self.info["codebase_version"],
            "fps": self.info["fps"],
            "total_episodes": self.info["total_episodes"],
            "total_frames": self.info["total_frames"],
            "features": list(self.features),
            "policy_inputs": [key for key in self.features if key.startswith("observation")],
            "policy_outputs": [key for key in self.features if key.startswith("action")],
            "episodes": [self.episode(position, row) for position, row in enumerate(self.episodes)],
            "broken": self.broken,
        }

    def metadata(self):
        info = self.info
        self.expect(info["codebase_version"] == "v3.0", "version")
        self.expect(len(self.episodes) == info["total_episodes"], "total_episodes")
        self.expect(self.rows.num_rows == info["total_frames"], "total_frames")
        self.expect(len(self.tasks) == info["total_tasks"], "total_tasks")
        self.expect(info["splits"] == {"train": f"0:{info['total_episodes']}"}, "splits")
        self.expect({"total_videos", "total_chunks"}.isdisjoint(info), "totals of v2.1")
        self.expect(info["data_files_size_in_mb"] > 0 < info["video_files_size_in_mb"], "sizes of files")
        for key, dtype in INDICES.items():
            feature = self.features.get(key, {})
            self.expect(feature.get("dtype") == dtype and feature.get("shape") == [1], f"feature {key}")
        stored = [key for key in self.features if key not in self.videos]
        self.expect(self.rows.column_names == stored, "columns")
        self.expect(not any("/" in key for key in self.features), "slash in a key")

    def numbering(self):
        self.expect(np.array_equal(numbers(self.rows["index"]), np.arange(self.rows.num_rows)), "index")
        listed = [row["episode_index"] for row in self.episodes]
        self.expect(listed == list(range(len(listed))), "position of an episode is its index")

    def together(self):
        """stats.json against the rows of all episodes; quantiles are means of those of the episodes."""
        for key, statistic in self.stats.items():
            if key in self.videos or self.features[key]["dtype"] == "image":
                self.expect(np.shape(statistic["mean"]) == (3, 1, 1), f"shape of {key}")
                continue
            values = numbers(self.rows[key]).astype(np.float64).reshape(self.rows.num_rows, -1)
            for name, figure in FIGURES.items():
                right = np.allclose(statistic[name], figure(values, axis=0), rtol=1e-4, atol=1e-5)
                self.expect(right, f"{name} of {key} in stats.json")

    def episode(self, position, row):
        first, end = row["dataset_from_index"], row["dataset_to_index"]
        rows = self.rows.slice(first, end - first)
        self.expect(end - first == row["length"] == rows.num_rows, f"{position}: length")
        path = self.place(self.info["data_path"], row, "data")
        own = pq.read_table(path, columns=["index"])["index"].to_pylist()
        self.expect(set(range(first, end)) <= set(own), f"{position}: rows are not in {path.name}")
        frames = np.arange(rows.num_rows)
        self.expect(np.array_equal(numbers(rows["frame_index"]), frames), f"{position}: frame_index")
        self.expect(set(rows["episode_index"].to_pylist()) == {position}, f"{position}: episode_index")
        stamps = numbers(rows["timestamp"])
        exact = (frames / self.info["fps"]).astype(np.float32)
        self.expect(np.array_equal(stamps, exact), f"{position}: timestamp")
        tasks = {self.tasks[number] for number in rows["task_index"].to_pylist()}
        self.expect(tasks <= set(row["tasks"]), f"{position}: tasks")
        columns = {
            key: numbers(rows[key])
            for key in rows.column_names
            if self.features[key]["dtype"] not in ("string", "image")
        }
        self.statistics(position, row, columns)
        return {
            "length": rows.num_rows,
            "tasks": sorted(tasks),
            "sums": {key: float(np.nansum(values.astype(np.float64))) for key, values in columns.items()},
            "brightness": {key: self.video(position, row, key) for key in self.videos},
        }

    def place(self, template, row, prefix, **fields):
        numbered = {name: row[f"{prefix}/{name}"] for name in ("chunk_index", "file_index")}
        return self.root / template.format(**numbered, **fields)

    def statistics(self, position, row, columns):
        for name in row:
            if not name.startswith("stats/") or row[name] is None:
                continue
            key, figure = name.removeprefix("stats/").rsplit("/", 1)
            if figure == "count":
                self.expect(len(row[name]) == 1, f"{position}: count of {key}")
            elif self.features[key]["dtype"] in ("video", "image"):
                self.expect(np.shape(row[name]) == (3, 1, 1), f"{position}: shape of {figure} of {key}")
            else:
                values = columns[key].astype(np.float64).reshape(len(columns[key]), -1)
                known = values[~np.isnan(values).any(axis=1)]
                right = (
                    np.quantile(known, QUANTILES[figure], axis=0)
                    if figure in QUANTILES
                    else FIGURES[figure](known, axis=0)
                )
                close = np.shape(row[name]) == right.shape and np.allclose(
                    row[name], right, rtol=1e-4, atol=1e-5
                )
                self.expect(close, f"{position}: {figure} of {key}")

    def video(self, position, row, key):
        path = self.place(self.info["video_path"], row, f"videos/{key}", video_key=key)
        start, end = (row[f"videos/{key}/{edge}_timestamp"] for edge in ("from", "to"))
        self.expect(
            abs(end - start - row["length"] / self.info["fps"]) < TOLERANCE, f"{position}: length of {key}"
        )
        found = {}
        with av.open(str(path)) as container:
            stream = container.streams.video[0]
            shape = [stream.height, stream.width, 3]
            self.expect(shape == self.features[key]["shape"], f"{position}: shape of {key}")
            for frame in container.decode(video=0):
                found[frame.time] = float(frame.to_ndarray(format="rgb24").mean())
        times = np.array(sorted(found))
        brightness = []
        for number in range(row["length"]):
            wanted = start + number / self.info["fps"]
            nearest = times[np.abs(times - wanted).argmin()]
            self.expect(abs(nearest - wanted) < TOLERANCE, f"{position}: frame {number} of {key}")
            brightness.append(found[nearest])
        return brightness


if __name__ == "__main__":
    for named in sys.argv[1:] or sys.stdin:
        print(json.dumps(Reader(Path(named.rstrip("\n"))).read()), flush=True)
