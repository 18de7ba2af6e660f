"""Visibility of data while a plan is blind: the single gate for pages, REST, websockets, downloads and exports.

A plan is blind for every user who has not unblinded it, until it is revealed. Its checkpoints are hidden, and with them
all that tells them apart: names, addresses, metrics of the policy, texts that name a server. A higher layer registers
the rules (evaweb.plans.blinding_rules); without them every request for data raises ImproperlyConfigured.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from django.core.exceptions import ImproperlyConfigured

from evaweb.blinding.station_messages import uncovered
from evaweb.core.errors import NotAllowed
from runtime.core.sentences import fixed, identity, plain, shows

HIDDEN = fixed("blinding.hidden", "hidden until the reveal")
COVERED = fixed(
    "blinding.covered",
    "hidden until the reveal: check whether the robot stands safely, then resume, or stop and have the trial repeated",
)

COVERED_AT_REST = fixed(
    "blinding.covered_at_rest",
    "hidden until the reveal: set up again; if that fails again, return the trial unrun",
)

# Messages that cannot depend on the checkpoint. All others may name a server, a time or a number of rows.
_HARMLESS = re.compile(
    r"""
    \w+\ by\ [\w.@+-]+
    | (stop|halt|resume|run|setup|home)
    | (run\ )?stopped(\ by\ the\ operator)?
    | the\ run's\ [\d.e+]+\ s\ are\ over
    | ended\ while\ the\ web\ was\ away
    | the\ station\ was\ restarted\ during\ the\ run
    | (abandoned|chosen\ again)(\ \([\w.@+-]+\))?
    | the\ e-stop\ was\ (pressed|released)[\w .,:@+-]*
    | lease\ [\w .,]*
    | the\ process\ \w+\ (gives\ no\ sign\ of\ life|does\ not\ answer)\ yet:\ try\ again\ in\ a\ moment
    | nobody\ commands\ the\ station:\ [\w .,;+]*
    | too\ little\ room\ to\ record\ in\ [^\n:]*:\ [\w ,]*\ wanted\ [\w .;()]*
    | disk\ (full|error)\ while\ creating\ [^\n:]*:\ [\w ;]*\ free\ in\ [^\n:]*
    """,
    re.VERBOSE,
)


@dataclass(frozen=True, slots=True)
class Visibility:
    """Data hidden from one user: checkpoints of blind plans, in trials, episodes and at stations.

    Attributes:
        checkpoints: Ids of the hidden checkpoints.
        names: Names of the hidden checkpoints.
        stations: Names of stations that have been handed a trial of a plan that is blind for the user.
        busy_stations: Names of stations with an unfinished trial of such a plan.
        keys: Ids of the plans that are blind for the user.
        plans: Titles of these plans as text.
        user: Id of the account, None without an account.
    """

    checkpoints: frozenset[int] = frozenset()
    names: frozenset[str] = frozenset()
    stations: frozenset[str] = frozenset()
    busy_stations: frozenset[str] = frozenset()
    keys: frozenset[int] = frozenset()
    plans: str = ""
    user: int | None = None

    @property
    def hides_nothing(self) -> bool:
        """Whether nothing is hidden."""
        return not self.checkpoints

    def hides_plan(self, plan: Any) -> bool:
        """Return True if the plan's checkpoints are hidden, and with them its question, digest and amendments.

        The draft of an amendment is hidden like the plan that it amends, because it reveals the same.
        """
        return plan.pk in self.keys or (plan.state == "draft" and plan.amends_id in self.keys)

    # --- trials and checkpoints ------------------------------------------------------------------------------

    def hides(self, trial: Any) -> bool:
        """Return True if the checkpoint of this trial is hidden."""
        return trial.checkpoint_id in self.checkpoints

    def checkpoint_label(self, trial: Any) -> str:
        """Return the name of a trial's checkpoint; if it is hidden, the code of the trial."""
        if not self.hides(trial):
            return str(trial.checkpoint.name)
        return code_of(trial) or HIDDEN

    def reason(self, trial: Any) -> str:
        """Return the reason for a trial's state: unchanged if a person wrote it, redacted if the station did."""
        if not self.hides(trial) or trial.status in ("voided", "abandoned"):
            return str(trial.reason)
        return self.redact_text(trial.reason)

    def redact_text(self, text: str, covered: str = HIDDEN) -> str:
        """Return a station's message without hidden data.

        A Sentence keeps its id and arguments, by which it is translated, only if all of them may be shown. `covered`
        replaces a message that must be hidden entirely.
        """
        redacted = text
        if text and not _HARMLESS.fullmatch(text):
            message = uncovered(text)
            redacted = covered if message is None else message
        return redacted if shows(redacted, identity(redacted)["arguments"]) else plain(redacted)

    def filter_visible(self, rows: Any, checkpoint: str = "checkpoint") -> Any:
        """Exclude rows of hidden checkpoints; `checkpoint` is the query path to the checkpoint."""
        if self.hides_nothing:
            return rows
        return rows.exclude(**{f"{checkpoint}__in": self.checkpoints})

    # --- episodes ---------------------------------------------------------------------------------------------

    def hides_episode(self, episode: Any) -> bool:
        """Return True if the policy that made this recording is hidden."""
        trial = getattr(episode, "trial", None)
        return self.hides(trial) if trial is not None else episode.checkpoint in self.names

    def policy_of(self, episode: Any) -> str:
        """Return the displayed name of a recording's policy."""
        trial = getattr(episode, "trial", None)
        if not self.hides_episode(episode):
            return str(trial.checkpoint.name if trial is not None else episode.checkpoint)
        return self.checkpoint_label(trial) if trial is not None else HIDDEN

    def tags_of(self, episode: Any) -> list[str]:
        """Return the tags of a recording that this user may see.

        Left out are tags by other people if this user may still have to judge the recording blind, and tags that name a
        hidden checkpoint.
        """
        tags = [tag for tag in episode.tags.all() if not self.hides_opinion(episode, tag.by_id)]
        return [tag.words for tag in tags if not self.named_in(tag.words)]

    def hides_opinion(self, episode: Any, author: int | None) -> bool:
        """Return True for another person's opinion on a recording that this user may still have to judge blind."""
        return author != self.user and self.hides_episode(episode)

    def named_in(self, words: str) -> bool:
        """Return True if `words` contains the name of a hidden checkpoint, ignoring case."""
        return any(
            re.search(rf"(?<!\w){re.escape(name.casefold())}(?!\w)", words.casefold()) for name in self.names
        )

    def require_episode(self, episode: Any) -> None:
        """Raise NotAllowed if the checkpoint that made the recording is hidden from the user.

        Call this before returning a part of the recording that would reveal the checkpoint.
        """
        if self.hides_episode(episode):
            raise NotAllowed(f"this part of the recording tells which checkpoint it is of: {self.plans}")

    # --- stations -----------------------------------------------------------------------------------------------

    def redacts_snapshot(self, station: str, snapshot: Mapping[str, Any] | None) -> bool:
        """Return True if the station's snapshot must be shown without data of the loaded checkpoint."""
        if self.hides_nothing:
            return False
        loaded = (snapshot or {}).get("checkpoint") or {}
        if (
            loaded.get("id") in self.checkpoints
            or loaded.get("name") in self.names
            or station in self.busy_stations
        ):
            return True
        # Messages about a hidden checkpoint remain in the snapshot until the station is set up for another one.
        another = loaded.get("id") is not None and bool((snapshot or {}).get("validated"))
        return station in self.stations and not another

    def redacts_events(self, station: str) -> bool:
        """Return True if events of the station may concern a hidden checkpoint, also of earlier trials."""
        return station in self.stations


FULL_VISIBILITY = Visibility()

_find: Callable[[Any], Visibility] | None = None


def register_visibility_rule(find: Callable[[Any], Visibility]) -> None:
    """Register the function that returns the Visibility of a user."""
    global _find
    _find = find


def visibility_for_user(user: Any) -> Visibility:
    """Return the user's current Visibility. Raises: ImproperlyConfigured if no rule is registered."""
    if _find is None:
        raise ImproperlyConfigured("blinding rules are not declared (evaweb.plans.blinding_rules does it)")
    return _find(user)


def visibility_for_request(request: Any) -> Visibility:
    """Return the Visibility of the user of a login or token; looked up once per request."""
    if not hasattr(request, "_eva_sight"):
        request._eva_sight = visibility_for_user(getattr(request, "auth", None) or request.user)
    visibility: Visibility = request._eva_sight
    return visibility


def code_of(trial: Any) -> str:
    """Return the code under which a trial was handed out, "" for a trial outside any plan."""
    handout = getattr(trial, "handout", None)
    return str(handout.code) if handout is not None else ""


def plan_titles(rows: Iterable[Any]) -> str:
    """Return the distinct titles of plans, joined by commas."""
    return ", ".join(dict.fromkeys(map(str, rows)))
