"""Template tags for trials and recordings: their names, or substitutes while they are blinded."""

from __future__ import annotations

from typing import Any

from django import template

from evaweb.blinding.visibility import code_of, visibility_for_request

register = template.Library()


@register.simple_tag(takes_context=True)
def checkpoint_label(context: Any, trial: Any) -> str:
    """Return the name of a trial's checkpoint, or the trial's code if the checkpoint is hidden."""
    return visibility_for_request(context["request"]).checkpoint_label(trial)


@register.simple_tag(takes_context=True)
def policy_label(context: Any, episode: Any) -> str:
    """Return the name of the checkpoint that made a recording, or the code of its trial if it is hidden."""
    return visibility_for_request(context["request"]).policy_of(episode)


@register.simple_tag(takes_context=True)
def trial_reason(context: Any, trial: Any) -> str:
    """Return the reason for a trial's state, redacted as needed; "" without a trial."""
    return visibility_for_request(context["request"]).reason(trial) if trial else ""


@register.simple_tag(takes_context=True)
def visible_tags(context: Any, episode: Any) -> list[str]:
    """Return the tags of a recording that this user may read."""
    return visibility_for_request(context["request"]).tags_of(episode)


@register.simple_tag(takes_context=True)
def is_opinion_hidden(context: Any, episode: Any, author: int) -> bool:
    """Return True if the opinion of `author` on a recording is hidden until the reveal."""
    return visibility_for_request(context["request"]).hides_opinion(episode, author)


@register.simple_tag(takes_context=True)
def is_hidden(context: Any, trial: Any) -> bool:
    """Return True if the trial's checkpoint is hidden."""
    return visibility_for_request(context["request"]).hides(trial)


@register.simple_tag(takes_context=True)
def is_plan_hidden(context: Any, plan: Any) -> bool:
    """Return True if the checkpoints in a plan's texts are hidden."""
    return visibility_for_request(context["request"]).hides_plan(plan)


@register.simple_tag(takes_context=True)
def is_recording_hidden(context: Any, episode: Any) -> bool:
    """Return True if the policy that made a recording is hidden."""
    return visibility_for_request(context["request"]).hides_episode(episode)


@register.simple_tag(takes_context=True)
def end_reason(context: Any, episode: Any) -> str:
    """Return the reason why a recording ended, redacted if its policy is hidden."""
    visibility = visibility_for_request(context["request"])
    return (
        visibility.redact_text(episode.reason) if visibility.hides_episode(episode) else str(episode.reason)
    )


@register.filter
def trial_code(trial: Any) -> str:
    """Return the code under which a trial was handed out, "" for a trial outside any plan."""
    return code_of(trial)
