"""Template tags for trials and recordings: their names, or the substitutes where those are hidden."""

from __future__ import annotations

from typing import Any

from django import template

from evaweb.blinding import code_of, visibility_for_request

register = template.Library()


@register.simple_tag(takes_context=True)
def checkpoint_of(context: Any, trial: Any) -> str:
    """The name of a trial's checkpoint, or the trial's code."""
    return visibility_for_request(context["request"]).checkpoint_label(trial)


@register.simple_tag(takes_context=True)
def policy_of(context: Any, episode: Any) -> str:
    """The name of the checkpoint that a recording is of, or the code of its trial."""
    return visibility_for_request(context["request"]).policy_of(episode)


@register.simple_tag(takes_context=True)
def reason_of(context: Any, trial: Any) -> str:
    """Why a trial is where it is; nothing of none."""
    return visibility_for_request(context["request"]).reason(trial) if trial else ""


@register.simple_tag(takes_context=True)
def tags_of(context: Any, episode: Any) -> list[str]:
    """The tags of a recording that may be shown."""
    return visibility_for_request(context["request"]).tags_of(episode)


@register.simple_tag(takes_context=True)
def hidden_opinion(context: Any, episode: Any, author: int) -> bool:
    """True for what that person says of a recording, before the reveal."""
    return visibility_for_request(context["request"]).hides_opinion(episode, author)


@register.simple_tag(takes_context=True)
def hidden(context: Any, trial: Any) -> bool:
    """True if the trial's checkpoint is hidden."""
    return visibility_for_request(context["request"]).hides(trial)


@register.simple_tag(takes_context=True)
def hidden_plan(context: Any, plan: Any) -> bool:
    """True if what a plan says of its checkpoints is hidden."""
    return visibility_for_request(context["request"]).hides_plan(plan)


@register.simple_tag(takes_context=True)
def hidden_recording(context: Any, episode: Any) -> bool:
    """True if the policy that made a recording is hidden."""
    return visibility_for_request(context["request"]).hides_episode(episode)


@register.simple_tag(takes_context=True)
def told(context: Any, episode: Any) -> str:
    """Why a recording ended."""
    seen = visibility_for_request(context["request"])
    return seen.redact_text(episode.reason) if seen.hides_episode(episode) else str(episode.reason)


@register.filter
def code(trial: Any) -> str:
    """The code under which a trial was handed out, "" for one of no plan."""
    return code_of(trial)
