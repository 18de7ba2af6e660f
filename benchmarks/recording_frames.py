"""Images for benchmarks.recording_pace: three cameras of the simulated bench with a moving arm."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.lib.format import open_memmap

from benchmarks.recording_pace import CAMERAS, FPS, HEIGHT, WIDTH
from robots import load_robot
from runtime.simulation.bench.numbered_frames import Scene

COUNT = 90


def write(path: Path, count: int = COUNT) -> Path:
    """Write `count` frames to `path`, uint8 [count, cameras, H, W, 3], RGB."""
    robot = load_robot("agilex_piper")
    scene, home = Scene(robot, HEIGHT, WIDTH), robot.poses["home"]
    pictures = open_memmap(path, "w+", np.uint8, (count, len(CAMERAS), HEIGHT, WIDTH, 3))
    for index in range(count):
        pose = np.clip(home + 0.5 * np.sin(index / FPS + np.arange(robot.dim)), robot.lower, robot.upper)
        drawn = scene.draw(index, index / FPS, pose)
        for number, camera in enumerate(CAMERAS):
            pictures[index, number] = drawn[camera][..., ::-1]
    pictures.flush()
    return path
