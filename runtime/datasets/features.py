"""Declaration of columns in info.json and their types in parquet, kept consistent in one place."""

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


LANGUAGE = "language"  # LeRobot 0.6: list of structs per row, with fields of the writer's choice; may be null
WORDS = ("string", "image", LANGUAGE)  # dtypes without numeric statistics


def scalar(dtype: str) -> Feature:
    """Return the feature of one value per row: float32, float64, int64, bool or string."""
    return {"dtype": dtype, "shape": [1], "names": None}


def vector(names: Sequence[str]) -> Feature:
    """Return the feature of one float32 vector per row, with named dimensions."""
    return {"dtype": "float32", "shape": [len(names)], "names": list(names)}


def video(height: int, width: int, fps: float, codec: str, pixels: str) -> Feature:
    """Return the feature of one RGB image per row, stored in an mp4 file."""
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
    """Return a rate without a fractional part as int, which other readers expect."""
    return int(fps) if float(fps).is_integer() else float(fps)


def stored_features(features: Mapping[str, Mapping[str, Any]]) -> dict[str, Mapping[str, Any]]:
    """Return the features with a parquet column: all except videos."""
    return {key: feature for key, feature in features.items() if feature["dtype"] != "video"}


def picture_size(feature: Mapping[str, Any]) -> tuple[int, int, int]:
    """Return declared height, width and channels, whatever the order in which they are declared.

    Raises:
        RecordingError: The shape does not have three axes.
    """
    shape, names = list(feature.get("shape") or ()), feature.get("names")
    if len(shape) != 3:
        raise RecordingError(f"pictures are declared of shape {shape}, expected height, width and channels")
    axes = [str(name).rstrip("s") for name in names] if isinstance(names, list) else []
    if {"height", "width"} <= set(axes) and len(axes) == 3:
        height, width = (int(shape[axes.index(name)]) for name in ("height", "width"))
        (channels,) = (int(n) for n, name in zip(shape, axes, strict=True) if name not in ("height", "width"))
        return height, width, channels
    first = shape[0] in (1, 3) and shape[2] not in (1, 3, 4)
    height, width, channels = (int(n) for n in (*shape[1:], shape[0])) if first else (int(n) for n in shape)
    return height, width, channels


def is_depth(feature: Mapping[str, Any]) -> bool:
    """Return True if the images measure distances, which LeRobot declares by a single channel or by `is_depth_map`."""
    info = {**(feature.get("info") or {}), **(feature.get("video_info") or {})}
    flagged = any(info.get(name) for name in ("is_depth_map", "video.is_depth_map"))
    return flagged or picture_size(feature)[2] == 1


def figure_shapes(feature: Mapping[str, Any]) -> tuple[tuple[int, ...], ...]:
    """Return the shapes that minimum, maximum, mean and standard deviation of a feature may have."""
    if feature["dtype"] in ("video", "image"):
        return ((3, 1, 1), (1, 1, 1)) if is_depth(feature) else ((3, 1, 1),)
    shape = tuple(feature["shape"]) or (1,)
    return tuple(dict.fromkeys((shape, (math.prod(shape),))))


def shape_problem(key: str, feature: Mapping[str, Any], found: tuple[int, ...]) -> str:
    """Return a sentence if rows of several axes, of shape `found`, differ from the declared shape, else ""."""
    declared = list(feature["shape"])
    if len(declared) < 2 or not found or list(found) == declared:
        return ""
    return f"{key!r} has rows of shape {list(found)}, declared {declared}"


def holds_nothing(feature: Mapping[str, Any]) -> bool:
    """Return True if the shape has an axis of length 0; no loader reads such a column."""
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
    """Return the parquet type of a declared feature. Raises: RecordingError if it has none."""
    import pyarrow as pa

    dtype, shape = feature["dtype"], list(feature["shape"])
    if dtype == "image":
        return pa.struct({"bytes": pa.binary(), "path": pa.string()})
    supported = (*NUMBERS, "bool", "string")
    if dtype not in supported or 0 in shape:
        raise RecordingError(
            f"feature {key!r} is {dtype!r} of shape {shape}, stored are image and {supported} of lengths above 0"
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
    """Return True if it is the type of a column with LeRobot's language annotations."""
    import pyarrow as pa

    rows = kind.value_type if pa.types.is_list(kind) or pa.types.is_large_list(kind) else None
    return (
        rows is not None
        and pa.types.is_struct(rows)
        and {"role", "content"} <= {field.name for field in rows}
    )


def arrow_schema(
    features: Mapping[str, Mapping[str, Any]], given: Mapping[str, pa.DataType] | None = None
) -> pa.Schema:
    """Return the schema of an episode's parquet file; its metadata declare the features to the package `datasets`.

    Language columns get the types in `given`.
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
    """Return the differences between the features of a dataset and of a new episode, one sentence each."""
    differences = [f"the dataset has no {key!r}" for key in new if key not in stated]
    differences += [f"the episode has no {key!r}" for key in stated if key not in new]
    for key in stated:
        if key not in new:
            continue
        differences += [
            f"{key!r} has {aspect} {stated[key].get(aspect)} in the dataset, {new[key].get(aspect)} here"
            for aspect in ("dtype", "shape", "names")
            if stated[key].get(aspect) != new[key].get(aspect)
        ]
    return differences
