"""Pictures of a trial as an automatic judge is shown them: few, small, by numbers of cameras, nothing but pixels."""

from __future__ import annotations

from evaweb.episodes.models import Episode
from evaweb.episodes.preview import jpeg_of
from evaweb.episodes.videos import video_file
from evaweb.results.judges.base import StillImage
from runtime.datasets.pictures import VideoFrames

CAMERAS = 4  # the first of the recording
OF_EACH = 8  # evenly over the run, with the first and the last that there are
WIDTH = 512  # pixels at most


def trial_stills(episode: Episode) -> tuple[StillImage, ...]:
    """Camera after camera in the order of time, of those that have a video; RecordingError where one is damaged."""
    found = []
    for number, camera in enumerate(episode.cameras[:CAMERAS], 1):
        video = video_file(episode.uuid, camera)
        if not video.exists():  # lost before its first picture
            continue
        with VideoFrames(video) as pictures:
            times = pictures.times
            for index in sample(len(pictures)):
                pixels = pictures[index]
                jpeg = jpeg_of(pixels, min(WIDTH, pixels.shape[1]))
                found.append(StillImage(f"camera {number}", round(times[index] - times[0], 3), jpeg))
    return tuple(found)


def sample(n: int, most: int = OF_EACH) -> list[int]:
    """At most so many of 0 to n - 1, evenly, both ends among them."""
    if n <= most:
        return list(range(n))
    return [round(k * (n - 1) / (most - 1)) for k in range(most)]
