"""Clip of a failed trial's recording around the failure."""

from __future__ import annotations

from dataclasses import dataclass
from urllib.parse import urlencode

from django.urls import reverse

from evaweb.trials.models import Trial

BEFORE_S = 1.0  # lead before the last reached milestone
LASTS_S = 6.0


@dataclass(frozen=True, slots=True)
class Clip:
    """Part of the first camera's video from `begin` to `end` [s] in which a trial failed.

    `missed` is the first milestone that was not reached. `after` is the last milestone before it with a known time; if
    "", the clip is the end of the recording.
    """

    video: str
    share: str
    begin: float
    end: float
    missed: str
    after: str

    @property
    def description(self) -> str:
        """Description of the part of the video."""
        return f"after “{self.after}”" if self.after else f"the last {self.end - self.begin:.0f} s"


def clip_of(trial: Trial) -> Clip | None:
    """Return the clip of a scored trial; None without a recording with images.

    A missed milestone has no time, so the clip begins just before the last reached one was reached.
    """
    episode = trial.episode
    if episode is None or trial.verdict is None or not (episode.cameras and episode.frames and episode.fps):
        return None
    whole, missed, after, begin = episode.frames / episode.fps, "", "", None
    for row in trial.verdict.outcomes.all():
        if not row.reached:
            missed = row.text
            break
        if row.at_s is not None and row.at_s < whole:
            after, begin = row.text, max(0.0, row.at_s - BEFORE_S)
    begin = max(0.0, whole - LASTS_S) if begin is None else begin
    end = min(whole, begin + LASTS_S)
    query = urlencode({"t": f"{begin:.2f}", "from": f"{begin:.2f}", "to": f"{end:.2f}", "loop": 1})
    return Clip(
        video=reverse("episode-video", args=[episode.uuid, episode.cameras[0]]),
        share=f"{reverse('result-trial', args=[trial.pk])}?{query}",
        begin=round(begin, 2),
        end=round(end, 2),
        missed=missed,
        after=after,
    )
