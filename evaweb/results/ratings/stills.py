"""Images of a trial for an automatic judge: few, small, with anonymous cameras and without metadata."""

from __future__ import annotations

from evaweb.episodes.models import Episode
from evaweb.episodes.preview import jpeg_of
from evaweb.episodes.videos import video_file
from evaweb.results.judges.base import StillImage
from runtime.datasets.video_frames import VideoFrames

CAMERAS = 4  # first cameras of the recording
OF_EACH = 8  # images per camera, evenly spaced, including first and last
WIDTH = 512  # [pixels] largest width


def trial_stills(episode: Episode) -> tuple[StillImage, ...]:
    """Return the images by camera and time, for the cameras with a video.

    Raises:
        RecordingError: If a video is damaged.
    """
    found = []
    for number, camera in enumerate(episode.cameras[:CAMERAS], 1):
        video = video_file(episode.uuid, camera)
        if not video.exists():  # the camera failed before its first image
            continue
        with VideoFrames(video) as pictures:
            times = pictures.times
            for index in sample(len(pictures)):
                pixels = pictures[index]
                jpeg = jpeg_of(pixels, min(WIDTH, pixels.shape[1]))
                found.append(StillImage(f"camera {number}", round(times[index] - times[0], 3), jpeg))
    return tuple(found)


def sample(n: int, most: int = OF_EACH) -> list[int]:
    """Return at most `most` of the indices 0 to n - 1, evenly spaced, including both ends."""
    if n <= most:
        return list(range(n))
    return [round(k * (n - 1) / (most - 1)) for k in range(most)]
