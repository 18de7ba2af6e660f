"""Loads a dataset with LeRobot's own loader and prints what it gives, for a test that compares.

python load_with_lerobot.py DATASET [STEP] prints one JSON object: LeRobot's version and that of its datasets, and of
every STEP-th row its episode, task, state, action and the mean brightness of each picture. It is run by an
interpreter that has lerobot.
"""

import json
import os
import sys
from importlib.metadata import version
from pathlib import Path

os.environ["HF_HUB_OFFLINE"] = "1"

import torch


def operators():
    """Declare the operator of torchvision that a torch built for processors alone lacks."""
    library = torch.library.Library("torchvision", "DEF")
    try:
        library.define("nms(Tensor dets, Tensor scores, float iou_threshold) -> Tensor")
    except RuntimeError:
        return None
    return library


def main(root, step):
    kept = operators()
    from lerobot.datasets.lerobot_dataset import CODEBASE_VERSION, LeRobotDataset

    dataset = LeRobotDataset("local/set", root=root, video_backend="pyav")
    cameras = list(dataset.meta.camera_keys)
    rows = []
    for number in range(0, len(dataset), step):
        item = dataset[number]
        rows.append(
            {
                "episode": int(item["episode_index"]),
                "task": item["task"],
                "state": item["observation.state"].double().tolist() if "observation.state" in item else None,
                "action": item["action"].double().tolist(),
                "brightness": {key: float(item[key].double().mean()) * 255 for key in cameras},
            }
        )
    stats = {
        key: {name: value.tolist() for name, value in one.items()} for key, one in dataset.meta.stats.items()
    }
    del kept
    return {
        "lerobot": version("lerobot"),
        "reads": str(CODEBASE_VERSION),
        "rows": rows,
        "length": len(dataset),
        "episodes": dataset.num_episodes,
        "fps": dataset.fps,
        "stats": {key: stats[key] for key in ("action", *cameras) if key in stats},
    }


if __name__ == "__main__":
    json.dump(main(Path(sys.argv[1]), int(sys.argv[2]) if len(sys.argv) > 2 else 1), sys.stdout)
