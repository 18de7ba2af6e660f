"""Reads a LeRobot v2.1 dataset by the description of the format alone, as a program that knows nothing of us.

python read_lerobot_v21.py DATASET prints one JSON object: per episode its length, the sum of every numeric
column, the mean brightness of every frame of every video, its task; for the dataset its totals and every
broken promise.
Without DATASET it answers each line of its input, which names one.
"""

import json
import sys
from itertools import accumulate
from pathlib import Path

import av
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

DEFAULTS = {
    "timestamp": "float32",
    "frame_index": "int64",
    "episode_index": "int64",
    "index": "int64",
    "task_index": "int64",
}
TOLERANCE = 1e-4


def lines(path):
    return [json.loads(line) for line in path.read_text().splitlines()]


def arrow_type(feature):
    base = {
        "float32": pa.float32(),
        "float64": pa.float64(),
        "int64": pa.int64(),
        "bool": pa.bool_(),
        "string": pa.string(),
        "image": pa.struct({"bytes": pa.binary(), "path": pa.string()}),
    }[feature["dtype"]]
    return (
        base
        if feature["shape"] == [1] or feature["dtype"] == "image"
        else pa.list_(pa.field("element", base), feature["shape"][0])
    )


def numbers(column):
    column = column.combine_chunks()
    if pa.types.is_fixed_size_list(column.type):
        return np.array(column.flatten()).reshape(len(column), -1)
    return column.to_numpy(zero_copy_only=False)


class Reader:
    def __init__(self, root):
        self.root = root
        self.broken = []
        self.info = json.loads((root / "meta/info.json").read_text())
        total = self.info["total_episodes"]
        self.episodes = [e for e in lines(root / "meta/episodes.jsonl") if e["episode_index"] < total]
        self.tasks = {t["task_index"]: t["task"] for t in lines(root / "meta/tasks.jsonl")}
        self.stats = {s["episode_index"]: s["stats"] for s in lines(root / "meta/episodes_stats.jsonl")}
        self.videos = [k for k, f in self.info["features"].items() if f["dtype"] == "video"]

    def expect(self, holds, sentence):
        if not holds:
            self.broken.append(sentence)

    def place(self, template, index, key=""):
        chunk = index // self.info["chunks_size"]
        return self.root / template.format(episode_chunk=chunk, episode_index=index, video_key=key)

    def read(self):
        self.metadata()
        first = [0, *accumulate(e["length"] for e in self.episodes)]
        episodes = [self.episode(e, start) for e, start in zip(self.episodes, first, strict=False)]
        return {
            "version": self.info["codebase_version"],
            "fps": self.info["fps"],
            "robot_type": self.info["robot_type"],
            "total_episodes": self.info["total_episodes"],
            "total_frames": self.info["total_frames"],
            "features": list(self.info["features"]),
            "policy_inputs": [k for k in self.info["features"] if k.startswith("observation")],
            "policy_outputs": [k for k in self.info["features"] if k.startswith("action")],
            "episodes": episodes,
            "broken": self.broken,
        }

    def metadata(self):
        info, listed = self.info, self.episodes
        self.expect(info["codebase_version"] == "v2.1", "version")
        self.expect([e["episode_index"] for e in listed] == list(range(info["total_episodes"])), "episodes")
        self.expect(sum(e["length"] for e in listed) == info["total_frames"], "total_frames")
        self.expect(len(self.tasks) == info["total_tasks"], "total_tasks")
        self.expect(len(listed) * len(self.videos) == info["total_videos"], "total_videos")
        self.expect(-(-len(listed) // info["chunks_size"]) == info["total_chunks"], "total_chunks")
        self.expect(info["splits"] == {"train": f"0:{len(listed)}"}, "splits")
        for key, dtype in DEFAULTS.items():
            feature = info["features"].get(key, {})
            self.expect(feature.get("dtype") == dtype and feature.get("shape") == [1], f"feature {key}")
        self.expect(not any("/" in key for key in info["features"]), "slash in a key")

    def episode(self, entry, first):
        index, length = entry["episode_index"], entry["length"]
        table = pq.ParquetFile(self.place(self.info["data_path"], index)).read()
        stored = {k: f for k, f in self.info["features"].items() if f["dtype"] != "video"}
        self.expect(table.column_names == list(stored), f"{index}: columns")
        for key, feature in stored.items():
            self.expect(table.schema.field(key).type == arrow_type(feature), f"{index}: type of {key}")
        self.hugging_face(index, table.schema, stored)
        self.indices(index, table, length, first)
        columns = {k: numbers(table[k]) for k, f in stored.items() if f["dtype"] not in ("string", "image")}
        self.statistics(index, columns)
        return {
            "length": table.num_rows,
            "tasks": sorted({self.tasks[t] for t in columns["task_index"].tolist()}),
            "sums": {k: float(np.nansum(v.astype(np.float64))) for k, v in columns.items()},
            "brightness": {k: self.video(index, k, length) for k in self.videos},
        }

    def hugging_face(self, index, schema, stored):
        declared = json.loads(schema.metadata[b"huggingface"])["info"]["features"]
        for key, feature in stored.items():
            value = {"dtype": feature["dtype"], "_type": "Value"}
            if feature["dtype"] == "image":
                value = {"_type": "Image"}
            elif feature["shape"] != [1]:
                value = {"feature": value, "length": feature["shape"][0], "_type": "Sequence"}
            self.expect(declared.get(key) == value, f"{index}: declared feature {key}")

    def indices(self, index, table, length, first):
        frames = np.arange(length)
        self.expect(table.num_rows == length, f"{index}: length")
        self.expect(np.array_equal(numbers(table["frame_index"]), frames), f"{index}: frame_index")
        self.expect(np.array_equal(numbers(table["index"]), frames + first), f"{index}: index")
        self.expect(set(table["episode_index"].to_pylist()) == {index}, f"{index}: episode_index")
        stamps = numbers(table["timestamp"])
        exact = (frames / self.info["fps"]).astype(np.float32)
        self.expect(stamps.dtype == np.float32 and np.array_equal(stamps, exact), f"{index}: timestamp")
        if length > 1:
            even = np.abs(np.diff(stamps) - 1 / self.info["fps"]).max() <= TOLERANCE
            self.expect(even, f"{index}: uneven timestamps")

    def statistics(self, index, columns):
        stats = self.stats[index]
        for key, statistic in stats.items():
            shapes = {name: np.shape(value) for name, value in statistic.items()}
            self.expect(shapes.pop("count", None) == (1,), f"{index}: count of {key}")
            if "image" in key:
                self.expect(set(shapes.values()) == {(3, 1, 1)}, f"{index}: shapes of {key}")
                continue
            values = columns[key].astype(np.float64).reshape(len(columns[key]), -1)
            self.expect(set(shapes.values()) == {(values.shape[1],)}, f"{index}: shapes of {key}")
            for name, figure in (
                ("min", np.nanmin),
                ("max", np.nanmax),
                ("mean", np.nanmean),
                ("std", np.nanstd),
            ):
                right = np.allclose(statistic[name], figure(values, axis=0), rtol=1e-4, atol=1e-6)
                self.expect(right, f"{index}: {name} of {key}")
        for key in (*self.videos, "observation.state", "action"):
            self.expect(key in stats, f"{index}: no statistics of {key}")

    def video(self, index, key, length):
        path = self.place(self.info["video_path"], index, key)
        data = path.read_bytes()
        self.expect(0 <= data.find(b"moov") < data.find(b"mdat"), f"{index}: {key} has its index at the end")
        with av.open(str(path)) as container:
            stream = container.streams.video[0]
            shape = [stream.height, stream.width, 3]
            self.expect(shape == self.info["features"][key]["shape"], f"{index}: shape of {key}")
            frames = [(f.time, float(f.to_ndarray(format="rgb24").mean())) for f in container.decode(video=0)]
        self.expect(len(frames) == length, f"{index}: {len(frames)} frames of {key}")
        off = max((abs(t - k / self.info["fps"]) for k, (t, _) in enumerate(frames)), default=0.0)
        self.expect(off < TOLERANCE, f"{index}: {key} is {off} s off")
        return [brightness for _, brightness in frames]


if __name__ == "__main__":
    for named in sys.argv[1:] or sys.stdin:
        print(json.dumps(Reader(Path(named.rstrip("\n"))).read()), flush=True)
