"""Search by kind, each by its own index; only checkpoints that the user may know are found."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any
from urllib.parse import urlencode
from uuid import UUID

from django.db.models import Case, IntegerField, Q, QuerySet, Value, When
from django.urls import reverse
from django.utils.timezone import localtime

from evaweb.accounts.roles import Role, role_of
from evaweb.blinding.visibility import Visibility
from evaweb.core.errors import EvaError
from evaweb.datasets.overview import dataset_names
from evaweb.episodes.models import Episode
from evaweb.episodes.selectors import tag_counts
from evaweb.find.pages import pages_of
from evaweb.find.ranking import rank, words_of
from evaweb.plans.models import Handout
from evaweb.plans.selectors import plan_list
from evaweb.stations.models import Station
from evaweb.trials.models import Trial
from evaweb.trials.selectors import checkpoint_list, scene_list
from runtime.core.sentences import Pattern

_Q_HAS_CHARACTERS_ALLOWED_1 = Pattern(
    "find.selectors.q_has_characters_allowed_1",
    "q has {count} characters; allowed: 1 to {longest}",
)

LONGEST = 200  # [characters] longest query
MOST = 8  # items per group
_LOOKED_AT = 200  # rows per kind, best matches first
_COMPARED = 3  # longest words of the query that the database filters by; the others are matched in the result
_DIGITS = 9  # digits of the largest trial number
_CODE = re.compile(r"[A-Za-z0-9]{2,8}")
_UUID = re.compile(r"[0-9a-f]{4,32}")


@dataclass(frozen=True, slots=True)
class FoundItem:
    """Item that a search has found, with its name, details and address."""

    title: str
    detail: str
    address: str


@dataclass(frozen=True, slots=True)
class Group:
    """Items of one kind, best first; `more` is True if there are further items."""

    name: str
    items: tuple[FoundItem, ...]
    more: bool


Candidate = tuple[FoundItem, str]  # item with its further searchable words


def find(*, query: str, user: Any, sight: Visibility) -> list[Group]:
    """Return the non-empty groups of matches.

    Raises:
        EvaError: If the query does not have 1 to LONGEST characters.
    """
    query = " ".join(query.split())
    if not 0 < len(query) <= LONGEST:
        raise EvaError(_Q_HAS_CHARACTERS_ALLOWED_1(count=len(query), longest=LONGEST))
    role = role_of(user)
    kinds: dict[str, Callable[[], Iterable[FoundItem]]] = {
        "Stations": lambda: _ranked(query, _stations(query)),
        "Trials": lambda: _trials(query),
        "Episodes": lambda: _episodes(query),
        "Tags": lambda: _ranked(query, _tags(sight)),
        "Plans": lambda: _ranked(query, _plans(query, user)),
        "Checkpoints": lambda: _ranked(query, _checkpoints(query, role, sight)),
        "Scenes": lambda: _ranked(query, _scenes(query, role)),
        "Datasets": lambda: _ranked(query, _datasets()),
        "Pages": lambda: _ranked(query, _pages(role)),
    }
    groups = []
    for name, search in kinds.items():
        items = list(search())
        if items:
            groups.append(Group(name, tuple(items[:MOST]), len(items) > MOST))
    return groups


def _ranked(query: str, candidates: Iterable[Candidate]) -> list[FoundItem]:
    """Return the matching items, best first; items of equal rank keep the given order."""
    fits = [(rank(query, item.title, more), item) for item, more in candidates]
    ranked = [(fit, item) for fit, item in fits if fit is not None]
    return [item for _, item in sorted(ranked, key=lambda one: one[0])]


def _narrowed(rows: QuerySet[Any], query: str, *fields: str) -> QuerySet[Any]:
    """Return the first rows that contain the longest words of the query in their `fields`.

    Exact matches come first, then rows that begin with the query.
    """
    for word in sorted(words_of(query), key=len, reverse=True)[:_COMPARED]:
        rows = rows.filter(_any_of(fields, "icontains", word))
    nearness = Case(
        When(_any_of(fields, "iexact", query), then=Value(0)),
        When(_any_of(fields, "istartswith", query), then=Value(1)),
        default=Value(2),
        output_field=IntegerField(),
    )
    return rows.order_by(nearness, "pk")[:_LOOKED_AT]


def _any_of(fields: Iterable[str], lookup: str, value: str) -> Q:
    condition = Q()
    for field in fields:
        condition |= Q(**{f"{field}__{lookup}": value})
    return condition


# --- kinds with few rows -------------------------------------------------------------------------------------


def _stations(query: str) -> Iterator[Candidate]:
    """Yield each station with its Eval page, and its other pages if the query names them."""
    parts = words_of(query)
    for station in Station.objects.order_by("-active", "name"):
        detail = " · ".join((station.name, station.robot, *(() if station.active else ("switched off",))))
        pages = {"Debug": "station-debug", **({"Collect": "station-collect"} if station.collects else {})}
        yield (
            FoundItem(str(station), detail, reverse("station-eval", args=[station.name])),
            f"{detail} station eval",
        )
        for page, route in pages.items():
            if any(len(word) > 1 and page.casefold().startswith(word) for word in parts):
                item = FoundItem(f"{station} · {page}", detail, reverse(route, args=[station.name]))
                yield item, f"{detail} station"


def _plans(query: str, user: Any) -> Iterator[Candidate]:
    rows = (
        plan_list(user=user)
        .select_related(None)
        .prefetch_related(None)
        .only("name", "version", "title", "state")
    )
    for plan in _narrowed(rows, _without(query, "plan"), "title", "name"):
        detail = f"{plan.name} v{plan.version} · {plan.get_state_display()}"
        yield (
            FoundItem(plan.title, detail, reverse("result-plan", args=[plan.name, plan.version])),
            f"{detail} plan",
        )


def _checkpoints(query: str, role: Role, visibility: Visibility) -> Iterator[Candidate]:
    rows = checkpoint_list(all_of_them=True, sight=visibility).prefetch_related(None).only("name", "active")
    for row in _narrowed(rows, _without(query, "checkpoint"), "name"):
        detail = "" if row.active else "not offered"
        yield FoundItem(row.name, detail, _administered("checkpoint", row.pk, row.name, role)), "checkpoint"


def _scenes(query: str, role: Role) -> Iterator[Candidate]:
    rows = scene_list(all_of_them=True).prefetch_related(None)
    for row in _narrowed(rows, _without(query, "scene"), "title", "name"):
        detail = row.name if row.active else f"{row.name} · not offered"
        yield FoundItem(row.title, detail, _administered("scene", row.pk, row.title, role)), f"{detail} scene"


def _administered(kind: str, key: int, name: str, role: Role) -> str:
    """Return the address of an item for a user of this role.

    For administrators, it is the item's page in the administration. For other users, it is the list of the recordings
    that match the item's name.
    """
    if role is Role.ADMIN:
        return reverse(f"admin:trials_{kind}_change", args=[key])
    return f"{reverse('replay-list')}?{urlencode({'words': name})}"


def _tags(visibility: Visibility) -> Iterator[Candidate]:
    """Yield the tags, each with the address of its episodes."""
    for tag, n in tag_counts(sight=visibility).items():
        detail = f"{n} episode{'' if n == 1 else 's'}"
        yield FoundItem(tag, detail, f"{reverse('replay-list')}?{urlencode({'tag': tag})}"), "tag tagged"


def _datasets() -> Iterator[Candidate]:
    for name in dataset_names():
        short = name.removeprefix("datasets/")
        yield FoundItem(short, "", reverse("dataset", args=[short])), "dataset"


def _pages(role: Role) -> Iterator[Candidate]:
    for page, address in pages_of(role):
        yield FoundItem(page.title, "", address), page.more


def _without(query: str, kind: str) -> str:
    """Return the query without the name of the kind, which no row contains."""
    left = [word for word in query.split() if word.casefold() not in (kind, f"{kind}s")]
    return " ".join(left)


# --- kinds with many rows, each by an index ------------------------------------------------------------------


def _trials(query: str) -> list[FoundItem]:
    """Return the trials whose number begins with the query, then those whose code begins with it.

    In both groups exact matches come first.
    """
    text = _without(query, "trial").removeprefix("#")
    rows = Trial.objects.select_related("scene", "position", "station", "handout")
    by_pk: dict[int, Trial] = {}
    if re.fullmatch(rf"[1-9][0-9]{{0,{_DIGITS - 1}}}", text, re.ASCII):
        for first, last in _numbers(text):
            if len(by_pk) <= MOST:
                near = rows.filter(pk__range=(first, last)).order_by("pk")[: MOST + 1]
                by_pk |= {trial.pk: trial for trial in near}
    if _CODE.fullmatch(text) and len(by_pk) <= MOST:
        code = text.upper()
        coded = Handout.objects.filter(code__gte=code, code__lte=f"{code}{'Z' * 8}").order_by("code", "-pk")
        keys = list(coded.values_list("trial", flat=True)[: MOST + 1])
        by_key = rows.in_bulk(keys)
        by_pk |= {key: by_key[key] for key in keys}
    return [_trial(trial) for trial in list(by_pk.values())[: MOST + 1]]


def _numbers(digits: str) -> Iterator[tuple[int, int]]:
    """Yield the ranges (first, last) of the numbers that begin with these digits: one range per number of digits."""
    for more in range(_DIGITS - len(digits) + 1):
        yield int(digits) * 10**more, (int(digits) + 1) * 10**more - 1


def _trial(trial: Trial) -> FoundItem:
    handout = getattr(trial, "handout", None)
    title = f"Trial {trial.pk}" + (f" · {handout.code}" if handout else "")
    where = f"{trial.scene.title}, position {trial.position.number} · {trial.station.name}"
    return FoundItem(title, where, reverse("result-trial", args=[trial.pk]))


def _episodes(query: str) -> list[FoundItem]:
    """Return the episodes by a prefix of their uuid, of at least four characters."""
    text = _without(query, "episode").casefold().replace("-", "")
    if not _UUID.fullmatch(text):
        return []
    first, last = UUID(text.ljust(32, "0")), UUID(text.ljust(32, "f"))
    rows = Episode.objects.select_related("station").filter(uuid__range=(first, last)).order_by("uuid")
    return [_episode(episode) for episode in rows[: MOST + 1]]


def _episode(episode: Episode) -> FoundItem:
    began = f"{localtime(episode.started_at):%Y-%m-%d %H:%M}" if episode.started_at else "unknown time"
    detail = " · ".join(filter(None, (began, episode.station.name, episode.task[:80])))
    return FoundItem(str(episode.uuid), detail, reverse("replay", args=[episode.uuid]))
