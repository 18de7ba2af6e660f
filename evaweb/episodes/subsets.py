"""Named subsets: which episodes a query found, kept under a name, to be published as a dataset and trained on."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping, Sequence
from typing import Any
from uuid import UUID

from django.core.exceptions import ValidationError
from django.db import IntegrityError, transaction
from django.db.models import Count

from evaweb.accounts.roles import Role, require_role
from evaweb.blinding.visibility import Visibility
from evaweb.core.errors import Conflict, EvaError, NotFound
from evaweb.episodes.models import Episode, Subset
from evaweb.episodes.selectors import episode_list
from evaweb.jobs.models import Job, JobStatus
from runtime.core.sentences import Pattern, fixed

_THERE_ALREADY = Pattern(
    "episodes.subsets.there_already", "there is a subset {name} already: choose another name"
)
_NONE_FOUND = fixed(
    "episodes.subsets.none_found",
    "no episode of these is in a dataset; allowed: at least one that was published, and whose trial is not blind",
)
_SEVERAL_ROBOTS = Pattern(
    "episodes.subsets.several_robots", "the episodes are of {count} robots ({names}); allowed: of one"
)
_IN_USE = Pattern(
    "episodes.subsets.in_use",
    "{name} was published, or is stated at a checkpoint: it stays, so that one can say later what was trained on",
)
_NO_SUBSET = Pattern("episodes.subsets.no_subset", "there is no subset {name!r:.120}; there are: {there}")
_NAME = Pattern("episodes.subsets.name", "name: {why}")
_CHOSEN = Pattern("episodes.subsets.chosen", "chosen = {chosen!r:.120}; allowed: UUIDs of episodes")

_NAMED = 8  # names in an error


@transaction.atomic
def create_subset(
    *,
    user: Any,
    sight: Visibility,
    name: str,
    query: Mapping[str, str],
    chosen: Sequence[str] = (),
    description: str = "",
) -> Subset:
    """Save the episodes that `query` (values of the filters of the list of episodes) finds now, under a name.

    With `chosen` (UUIDs), only those of them. Only published episodes are saved, and none whose policy is hidden from
    the user.

    Raises:
        EvaError: The name is not allowed or taken, no episode is found, or they are of several robots.
    """
    require_role(user, Role.OPERATOR)
    if Subset.objects.filter(name=name).exists():
        raise Conflict(_THERE_ALREADY(name=name))
    rows = [row for row in _publishable(query, sight, chosen) if not sight.hides_episode(row)]
    if not rows:
        raise EvaError(_NONE_FOUND)
    robots = sorted({row.robot for row in rows})
    if len(robots) > 1:
        raise EvaError(_SEVERAL_ROBOTS(count=len(robots), names=", ".join(robots[:_NAMED])))
    subset = Subset(
        name=name,
        description=description,
        query={key: value for key, value in (*query.items(), ("chosen", str(len(chosen) or ""))) if value},
        digest=_digest(str(row.uuid) for row in rows),
        created_by=user,
    )
    try:
        subset.full_clean()
        subset.save()
    except ValidationError as error:
        raise EvaError(_NAME(why=" ".join(error.messages))) from None
    except IntegrityError:
        raise Conflict(_THERE_ALREADY(name=name)) from None
    subset.episodes.set(rows)
    return subset


@transaction.atomic
def remove_subset(*, user: Any, subset: Subset) -> None:
    """Remove a subset. Raises: Conflict if it was published, or a checkpoint was trained on it."""
    require_role(user, Role.OPERATOR)
    locked = Subset.objects.select_for_update().get(pk=subset.pk)
    if locked.dataset or locked.checkpoints.exists() or _is_being_published(locked):
        raise Conflict(_IN_USE(name=locked.name))
    locked.delete()


def _is_being_published(subset: Subset) -> bool:
    active = Job.objects.filter(status__in=(JobStatus.QUEUED, JobStatus.RUNNING), args__subset=subset.name)
    return active.exists()


def _publishable(query: Mapping[str, str], sight: Visibility, chosen: Sequence[str]) -> Any:
    rows = episode_list(**query, sight=sight).exclude(dataset_index=None)
    if not chosen:
        return rows
    try:
        return rows.filter(uuid__in=[UUID(uuid) for uuid in chosen])
    except ValueError:
        raise EvaError(_CHOSEN(chosen=", ".join(chosen))) from None


def _digest(uuids: Iterable[str]) -> str:
    return hashlib.sha256("\n".join(sorted(uuids)).encode()).hexdigest()


def subset_get(*, name: str) -> Subset:
    """Return the subset of that name. Raises: NotFound, which lists the existing ones."""
    subset = Subset.objects.filter(name=name).first()
    if subset is None:
        names = list(Subset.objects.values_list("name", flat=True)[: _NAMED + 1])
        there = ", ".join(names[:_NAMED]) + (", ..." if len(names) > _NAMED else "")
        raise NotFound(_NO_SUBSET(name=name, there=there or "none"))
    return subset


def subset_list(*, sight: Visibility) -> list[Subset]:
    """Return the subsets, newest first.

    Attribute `n_episodes` is the number of their episodes, `trained_on` that of the checkpoints that were trained on
    them.

    Left out are those whose name, description or query names a hidden checkpoint.
    """
    rows = Subset.objects.select_related("created_by").annotate(
        n_episodes=Count("episodes", distinct=True), trained_on=Count("checkpoints", distinct=True)
    )
    rows = rows.order_by("-created_at", "-pk")
    return [row for row in rows if not _names_hidden(row, sight)]


def _names_hidden(subset: Subset, visibility: Visibility) -> bool:
    return any(
        visibility.named_in(text) for text in (subset.name, subset.description, *subset.query.values())
    )


def subset_datasets(*, subset: Subset) -> list[str]:
    """Return the names of the datasets that have episodes of a subset now, sorted."""
    return sorted(set(subset.episodes.exclude(dataset_index=None).values_list("dataset", flat=True)))


def subset_uuids(*, subset: Subset) -> list[str]:
    """Return the UUIDs of the episodes of a subset in the order in which they were recorded."""
    rows = Episode.objects.filter(subsets=subset).order_by("started_at", "uuid")
    return [str(uuid) for uuid in rows.values_list("uuid", flat=True)]
