"""Checks of an episode: rows and pictures are read once, in step with each other, in constant memory."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path

import numpy as np

from runtime.core.errors import RecordingError
from runtime.datasets.reader import Dataset, open_dataset
from runtime.quality.block import EpisodeSource
from runtime.quality.datasets import DatasetSource
from runtime.quality.image_checks import ImageCheck
from runtime.quality.journals import JournalSource
from runtime.quality.motion_checks import MotionCheck
from runtime.quality.report import Flag, FlagCollector, Report
from runtime.quality.settings import QualitySettings
from runtime.quality.timing_checks import TimingCheck
from runtime.quality.value_checks import ValueCheck


def check_episode(folder: Path, settings: QualitySettings | None = None) -> Report:
    """Check the episode in one of our folders and return the report; damage is one of its flags.

    Raises RecordingError without a readable manifest.
    """
    return run_checks(JournalSource(folder), settings or QualitySettings())


def check_dataset_episode(
    dataset: Dataset | Path,
    index: int,
    settings: QualitySettings | None = None,
    *,
    state: str = "",
    robot: str = "",
) -> Report:
    """Check episode `index` of a LeRobot dataset and return the report.

    `state` names the column of measured joints, "" for the usual columns. `robot` is the robot that has these joints in
    this order; "" if only the dataset describes them. Raises RecordingError if the dataset has no such episode.
    """
    opened = open_dataset(dataset) if isinstance(dataset, Path) else dataset
    return run_checks(DatasetSource(opened, index, state, robot), settings or QualitySettings())


def run_checks(source: EpisodeSource, settings: QualitySettings) -> Report:
    """Run all checks on one episode from any source and return the report."""
    flags = FlagCollector(settings.most_flags)
    for kind, severity, sentence in source.remarks:
        flags.add(Flag(kind, severity, -1, -1, "", sentence))
    joints, unknown = source.joints()
    if unknown:
        flags.unchecked.append(unknown)
    times = TimingCheck(source, settings, flags)
    values = ValueCheck(source, joints, settings, flags)
    motion = MotionCheck(source, joints, settings, flags) if joints is not None else None
    cameras = {camera: ImageCheck(source, camera, settings, flags) for camera in source.cameras}
    rows, whole = 0, True
    with ExitStack() as stack:
        for camera in cameras.values():
            stack.callback(camera.release)
        try:
            for block in source.blocks():
                rows = block.first + block.rows
                times.add(block)
                values.add(block)
                moving = motion.add(block) if motion is not None else np.ones(block.rows, np.bool_)
                for name, camera in cameras.items():
                    camera.add(block.first, moving, block.repeated.get(name), block.lost.get(name))
        except RecordingError as error:
            whole = False
            flags.add(Flag("unreadable", "error", max(0, rows - 1), max(0, rows - 1), "", str(error)))
        for part in (times, values, motion):
            if part is not None:
                part.close()
        for camera in cameras.values():
            camera.close(rows, whole)
    _length(source, rows, settings, flags)
    figures = {"tracking_lag_s": motion.lag_s if motion else None, "largest_skew_s": times.largest_skew}
    return flags.report(source.name, rows, source.fps, figures)


def _length(source: EpisodeSource, rows: int, settings: QualitySettings, flags: FlagCollector) -> None:
    stated = source.schema.get("min_length_s")
    bound = float(stated) if isinstance(stated, int | float) and stated >= 0 else settings.min_length_s
    seconds = rows / source.fps
    if not rows:
        flags.add(Flag("too_short", "error", -1, -1, "", "nothing was recorded: it has no rows", 0.0, bound))
    elif seconds < bound:
        text = f"it is {seconds:.2f} s long, at least {bound:g} s are wanted"
        flags.add(Flag("too_short", "warning", 0, rows - 1, "", text, seconds, bound))
