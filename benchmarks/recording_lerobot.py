"""LeRobot's own writer: `PYTHON -m benchmarks.recording_lerobot FRAMES COUNT FOLDER MODE`; prints JSON.

Runs in an interpreter with LeRobot 0.4 and without our packages. MODE is `default`, with images as PNG files that
save_episode encodes, or `streaming`, with H.264 encoded during recording.
"""

from __future__ import annotations

import json
import os
import sys
from importlib.metadata import version
from pathlib import Path
from typing import Any

from benchmarks.recording_pace import CAMERAS, FPS, HEIGHT, JOINTS, WIDTH, Frames, feed_frames, finish, joints

MODES: dict[str, dict[str, Any]] = {
    "default": {"image_writer_threads": 4 * len(CAMERAS)},  # as in lerobot-record
    "streaming": {"streaming_encoding": True, "vcodec": "h264"},
}


def main(path: str, count: str, folder: str, mode: str) -> None:
    """Record one episode with LeRobot, and print the cost."""
    os.environ["HF_HUB_OFFLINE"] = "1"
    operators = _operators()
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    names = [f"joint_{number}" for number in range(JOINTS)]
    vector = {"dtype": "float32", "shape": (JOINTS,), "names": names}
    picture = {"dtype": "video", "shape": (HEIGHT, WIDTH, 3), "names": ["height", "width", "channels"]}
    features = {"observation.state": vector, "action": vector}
    features |= {f"observation.images.{camera}": picture for camera in CAMERAS}
    root = Path(folder) / "dataset"
    dataset = LeRobotDataset.create("eva/bench", FPS, features, root=root, robot_type="bench", **MODES[mode])

    def add(index: int, pictures: dict[str, Any]) -> None:
        images = {f"observation.images.{camera}": pixels for camera, pixels in pictures.items()}
        position = joints(index)
        dataset.add_frame({"observation.state": position, "action": position, "task": "wave", **images})

    def save() -> None:
        dataset.save_episode()
        dataset.finalize()

    written = finish(feed_frames(Frames(Path(path)), int(count), add), save, root)
    del operators
    print(json.dumps({**written.fields(), "version": version("lerobot")}))


def _operators() -> Any:
    """Declare operators that torchvision requires and that a torch without GPU support lacks.

    Returns the library of the declarations, which the caller must keep alive; None if they are declared already.
    """
    import torch

    library = torch.library.Library("torchvision", "DEF")
    try:
        library.define("nms(Tensor dets, Tensor scores, float iou_threshold) -> Tensor")
    except RuntimeError:  # it is declared already
        return None
    return library


if __name__ == "__main__":
    main(*sys.argv[1:])
