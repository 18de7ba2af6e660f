"""Figures that compare the checkpoints of a result.

On pages, the figures have links to the trials that they are drawn from; in reports they have none.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from evaweb.results.analysis.arm import Arm
from evaweb.results.presentation.drawings import conditions, rates, time_courses
from evaweb.results.presentation.drawings.svg import Drawing

Link = Callable[..., str]  # address of the list of trials by checkpoint, scene and more; "" for no link


def draw_arms(
    arms: Sequence[Arm], letters: Mapping[str, str], link: Link, *, mixed: bool = False
) -> dict[str, Any]:
    """Return the figures of the checkpoints by name.

    The funnel of a scene whose milestones differ between checkpoints is drawn only with `mixed`.
    """
    rows = [(arm.checkpoint, arm.success, link(checkpoint=arm.checkpoint)) for arm in arms]
    order = {arm.checkpoint: arm.series for arm in arms}
    scenes = sorted({name for arm in arms for name in arm.scenes})
    return {
        "intervals": rates.draw_intervals("Success rates", rows, order) if arms else None,
        "violins": rates.draw_violins(arms, letters) if arms else None,
        "funnels": [drawn for scene in scenes if (drawn := _draw_funnel(arms, scene, link, mixed))],
        "success_times": time_courses.draw_success_times(arms),
        "grid": conditions.draw_grid(arms, _grid_links(arms, link)),
    }


def _draw_funnel(arms: Sequence[Arm], scene: str, link: Link, mixed: bool) -> Drawing | None:
    funnels = [
        (arm.series, arm.checkpoint, funnel)
        for arm in arms
        for funnel in arm.funnels
        if funnel.scene == scene
    ]
    if not funnels or (len({funnel.labels for _, _, funnel in funnels}) > 1 and not mixed):
        return None
    links = {
        (name, at): link(checkpoint=name, scene=scene, missed=label)
        for _, name, funnel in funnels
        for at, label in enumerate(funnel.labels)
    }
    return time_courses.draw_funnel(scene, funnels, links)


def _grid_links(arms: Sequence[Arm], link: Link) -> dict[tuple[str, str], str]:
    links = {}
    for arm in arms:
        for condition in arm.cells:
            scene, _, position = condition.rpartition("/")
            links[arm.checkpoint, condition] = link(checkpoint=arm.checkpoint, scene=scene, position=position)
    return links
