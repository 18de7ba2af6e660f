"""Declaration of a column in info.json and its storage in parquet, so that both always say the same."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from runtime.core.errors import RecordingError

if TYPE_CHECKING:
    import pyarrow as pa

Feature = dict[str, Any]
Features = dict[str, Feature]

INDEX_COLUMNS = {
    "timestamp": "float32",
    "frame_index": "int64",
    "episode_index": "int64",
    "index": "int64",
    "task_index": "int64",
}


LANGUAGE = "language"  # of LeRobot 0.6: a list of structs per row, of the writer's own fields, may be null
WORDS = ("string", "image", LANGUAGE)  # of which there are no statistics of numbers


def scalar(dtype: str) -> Feature:
    """One value per row: float32, float64, int64, bool or string."""
    return {"dtype": dtype, "shape": [1], "names": None}


def vector(names: Sequence[str]) -> Feature:
    """One float32 vector per row, its entries named."""
    return {"dtype": "float32", "shape": [len(names)], "names": list(names)}


def video(height: int, width: int, fps: float, codec: str, pixels: str) -> Feature:
    """One RGB picture per row, stored in an mp4 file beside the rows."""
    return {
        "dtype": "video",
        "shape": [height, width, 3],
        "names": ["height", "width", "channels"],
        "info": {
            "video.height": height,
            "video.width": width,
            "video.codec": codec,
            "video.pix_fmt": pixels,
            "video.is_depth_map": False,
            "video.fps": whole_rate(fps),
            "video.channels": 3,
            "has_audio": False,
        },
    }


def whole_rate(fps: float) -> int | float:
    """A whole rate as int, as other readers expect it."""
    return int(fps) if float(fps).is_integer() else float(fps)


def stored_features(features: Mapping[str, Mapping[str, Any]]) -> dict[str, Mapping[str, Any]]:
    """The features that have a parquet column: all but the videos."""
    return {key: feature for key, feature in features.items() if feature["dtype"] != "video"}


def picture_size(feature: Mapping[str, Any]) -> tuple[int, int, int]:
    """Declared height, width and channels, whichever order they have; RecordingError where they are not three."""
    shape, names = list(feature.get("shape") or ()), feature.get("names")
    if len(shape) != 3:
        raise RecordingError(f"pictures are declared of shape {shape}, expected height, width and channels")
    said = [str(name).rstrip("s") for name in names] if isinstance(names, list) else []
    if {"height", "width"} <= set(said) and len(said) == 3:
        height, width = (int(shape[said.index(name)]) for name in ("height", "width"))
        (channels,) = (int(n) for n, name in zip(shape, said, strict=True) if name not in ("height", "width"))
        return height, width, channels
    first = shape[0] in (1, 3) and shape[2] not in (1, 3, 4)
    height, width, channels = (int(n) for n in (*shape[1:], shape[0])) if first else (int(n) for n in shape)
    return height, width, channels


def is_depth(feature: Mapping[str, Any]) -> bool:
    """True of pictures that measure distances: LeRobot says so by one channel, or `is_depth_map`."""
    told = {**(feature.get("info") or {}), **(feature.get("video_info") or {})}
    flagged = any(told.get(name) for name in ("is_depth_map", "video.is_depth_map"))
    return flagged or picture_size(feature)[2] == 1


def figure_shapes(feature: Mapping[str, Any]) -> tuple[tuple[int, ...], ...]:
    """Shapes that a feature's minimum, maximum, mean and deviation may have."""
    if feature["dtype"] in ("video", "image"):
        return ((3, 1, 1), (1, 1, 1)) if is_depth(feature) else ((3, 1, 1),)
    shape = tuple(feature["shape"]) or (1,)
    return tuple(dict.fromkeys((shape, (math.prod(shape),))))


def shape_problem(key: str, feature: Mapping[str, Any], found: tuple[int, ...]) -> str:
    """Sentence on rows of several axes that are not as long as declared, "" where they are."""
    declared = list(feature["shape"])
    if len(declared) < 2 or not found or list(found) == declared:
        return ""
    return f"{key!r} has rows of shape {list(found)}, declared {declared}"


def holds_nothing(feature: Mapping[str, Any]) -> bool:
    """True of a shape with an axis of length 0: no loader reads such a column."""
    return 0 in list(feature["shape"])


NUMBERS = (
    "float16",
    "float32",
    "float64",
    "int8",
    "int16",
    "int32",
    "int64",
    "uint8",
    "uint16",
    "uint32",
    "uint64",
)


def arrow_type(key: str, feature: Mapping[str, Any]) -> pa.DataType:
    """The parquet type of one declared feature; raises RecordingError for one that has none."""
    import pyarrow as pa

    dtype, shape = feature["dtype"], list(feature["shape"])
    if dtype == "image":
        return pa.struct({"bytes": pa.binary(), "path": pa.string()})
    known = (*NUMBERS, "bool", "string")
    if dtype not in known or 0 in shape:
        raise RecordingError(
            f"feature {key!r} is {dtype!r} of shape {shape}, stored are image and {known} of lengths above 0"
        )
    kind: pa.DataType = pa.type_for_alias(dtype)
    if shape in ([], [1]):
        return kind
    if len(shape) == 1:
        return pa.list_(kind, shape[0])
    for _ in shape:
        kind = pa.list_(kind)
    return kind


def is_language(kind: pa.DataType) -> bool:
    """True of the type that a column of LeRobot's language annotations has."""
    import pyarrow as pa

    rows = kind.value_type if pa.types.is_list(kind) or pa.types.is_large_list(kind) else None
    return rows is not None and pa.types.is_struct(rows) and {"role", "content"} <= {one.name for one in rows}


def arrow_schema(
    features: Mapping[str, Mapping[str, Any]], given: Mapping[str, pa.DataType] | None = None
) -> pa.Schema:
    """The schema of an episode's parquet file, with metadata from which `datasets` knows the features.

    Columns of language have the types that are `given`.
    """
    import pyarrow as pa

    columns = stored_features(features)
    worded = {key: (given or {})[key] for key, feature in columns.items() if feature["dtype"] == LANGUAGE}
    declared = {key: _hugging_face(feature) for key, feature in columns.items() if key not in worded}
    metadata = {"huggingface": json.dumps({"info": {"features": declared}})}
    return pa.schema(
        [
            pa.field(key, worded[key] if key in worded else arrow_type(key, feature))
            for key, feature in columns.items()
        ],
        metadata=metadata,
    )


def _hugging_face(feature: Mapping[str, Any]) -> dict[str, Any]:
    dtype, shape = feature["dtype"], list(feature["shape"])
    if dtype == "image":
        return {"_type": "Image"}
    if len(shape) > 1:
        return {"shape": shape, "dtype": dtype, "_type": f"Array{len(shape)}D"}
    value = {"dtype": dtype, "_type": "Value"}
    return value if shape in ([], [1]) else {"feature": value, "length": shape[0], "_type": "Sequence"}


def feature_differences(
    stated: Mapping[str, Mapping[str, Any]], new: Mapping[str, Mapping[str, Any]]
) -> list[str]:
    """Differences between the features of a dataset and those of a new episode, one sentence each."""
    found = [f"the dataset has no {key!r}" for key in new if key not in stated]
    found += [f"the episode has no {key!r}" for key in stated if key not in new]
    for key in stated:
        if key not in new:
            continue
        found += [
            f"{key!r} has {aspect} {stated[key].get(aspect)} in the dataset, {new[key].get(aspect)} here"
            for aspect in ("dtype", "shape", "names")
            if stated[key].get(aspect) != new[key].get(aspect)
        ]
    return found
