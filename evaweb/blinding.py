"""Visibility of data while a plan is blind: the one seam of pages, REST, live sockets, downloads and exports.

A plan is blind for every user who has not looked behind it, until it is revealed. Hidden are its checkpoints, and with
them whatever tells one from another: names, addresses, figures of the policy, texts in which a server is named. The
rules are declared from above (evaweb.plans.blinding_rules); without them no user is shown anything.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from django.core.exceptions import ImproperlyConfigured

from evaweb.blinding_reasons import uncovered
from evaweb.errors import NotAllowed
from runtime.core.sentences import fixed, identity, plain, shows

HIDDEN = fixed("blinding.hidden", "hidden until the reveal")
COVERED = fixed(
    "blinding.covered",
    "hidden until the reveal: look whether the robot stands safely, then resume, or stop and have the trial repeated",
)

COVERED_AT_REST = fixed(
    "blinding.covered_at_rest",
    "hidden until the reveal: set up again; if that fails again, return the trial unrun",
)

# Sentences that no checkpoint has a part in. All others may name a server, a time or a number of rows.
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
    """Data hidden from one user: checkpoints by id and by name, in trials, episodes and at stations.

    `stations` are those, by name, at which a trial of such a plan was handed out; `at_work` those at which one is not
    finished; `plans` says of which, in words, `keys` by their ids. `user` is the account, None for nobody's.
    """

    checkpoints: frozenset[int] = frozenset()
    names: frozenset[str] = frozenset()
    stations: frozenset[str] = frozenset()
    busy_stations: frozenset[str] = frozenset()
    keys: frozenset[int] = frozenset()
    plans: str = ""
    user: int | None = None

    @property
    def sees_everything(self) -> bool:
        """True if nothing is hidden."""
        return not self.checkpoints

    def hides_plan(self, plan: Any) -> bool:
        """True if what the plan says of its checkpoints is hidden: question, digest, what was amended.

        The draft of an amendment says the same as the plan that it amends.
        """
        return plan.pk in self.keys or (plan.state == "draft" and plan.amends_id in self.keys)

    # --- trials and checkpoints ------------------------------------------------------------------------------

    def hides(self, trial: Any) -> bool:
        """True if the checkpoint of this trial is hidden."""
        return trial.checkpoint_id in self.checkpoints

    def checkpoint_label(self, trial: Any) -> str:
        """Shown name of a trial's checkpoint: its own; of a hidden one the code of the trial."""
        if not self.hides(trial):
            return str(trial.checkpoint.name)
        return code_of(trial) or HIDDEN

    def reason(self, trial: Any) -> str:
        """Why the trial is where it is. What a person wrote is theirs; what the station said may tell."""
        if not self.hides(trial) or trial.status in ("voided", "abandoned"):
            return str(trial.reason)
        return self.redact_text(trial.reason)

    def redact_text(self, text: str, covered: str = HIDDEN) -> str:
        """A station's sentence as a user may read it from whom something is hidden; with its id if it is all shown.

        `covered` stands for what may not be read.
        """
        shown = text
        if text and not _HARMLESS.fullmatch(text):
            said = uncovered(text)
            shown = covered if said is None else said
        return shown if shows(shown, identity(shown)["arguments"]) else plain(shown)

    def filter_visible(self, rows: Any, checkpoint: str = "checkpoint") -> Any:
        """The rows of a query that are of no hidden checkpoint; `checkpoint` leads to it."""
        if self.sees_everything:
            return rows
        return rows.exclude(**{f"{checkpoint}__in": self.checkpoints})

    # --- episodes ---------------------------------------------------------------------------------------------

    def hides_episode(self, episode: Any) -> bool:
        """True if the policy that made this recording is hidden."""
        trial = getattr(episode, "trial", None)
        return self.hides(trial) if trial is not None else episode.checkpoint in self.names

    def policy_of(self, episode: Any) -> str:
        """Shown name of a recording's policy."""
        trial = getattr(episode, "trial", None)
        if not self.hides_episode(episode):
            return str(trial.checkpoint.name if trial is not None else episode.checkpoint)
        return self.checkpoint_label(trial) if trial is not None else HIDDEN

    def tags_of(self, episode: Any) -> list[str]:
        """Tags of a recording, without those of others before the reveal, and those that name a hidden checkpoint."""
        tags = [tag for tag in episode.tags.all() if not self.hides_opinion(episode, tag.by_id)]
        return [tag.words for tag in tags if not self.named_in(tag.words)]

    def hides_opinion(self, episode: Any, author: int | None) -> bool:
        """True for what another person says of a recording that this user may still have to judge blind."""
        return author != self.user and self.hides_episode(episode)

    def named_in(self, words: str) -> bool:
        """True if words of somebody name a hidden checkpoint, in whatever letters."""
        return any(
            re.search(rf"(?<!\w){re.escape(name.casefold())}(?!\w)", words.casefold()) for name in self.names
        )

    def require_episode(self, episode: Any) -> None:
        """NotAllowed for the parts of a recording that tell which policy made it."""
        if self.hides_episode(episode):
            raise NotAllowed(f"this part of the recording tells which checkpoint it is of: {self.plans}")

    # --- stations -----------------------------------------------------------------------------------------------

    def redacts_snapshot(self, station: str, snapshot: Mapping[str, Any] | None) -> bool:
        """True if the station's state is shown without what tells which checkpoint it is set up for."""
        if self.sees_everything:
            return False
        loaded = (snapshot or {}).get("checkpoint") or {}
        if (
            loaded.get("id") in self.checkpoints
            or loaded.get("name") in self.names
            or station in self.busy_stations
        ):
            return True
        # What the station said of a hidden checkpoint stands there until it is set up for another one.
        another = loaded.get("id") is not None and bool((snapshot or {}).get("validated"))
        return station in self.stations and not another

    def redacts_events(self, station: str) -> bool:
        """True if events of the station may be about a hidden checkpoint; also those of earlier trials."""
        return station in self.stations


FULL_VISIBILITY = Visibility()

_find: Callable[[Any], Visibility] | None = None


def register_visibility_rule(find: Callable[[Any], Visibility]) -> None:
    """`find` says what is hidden from a user."""
    global _find
    _find = find


def visibility_for_user(user: Any) -> Visibility:
    """The user's sight as of now."""
    if _find is None:
        raise ImproperlyConfigured(
            "nobody has declared what is hidden from whom (evaweb.plans.blinding_rules does)"
        )
    return _find(user)


def visibility_for_request(request: Any) -> Visibility:
    """The caller's sight, by login or by token; looked up once per request."""
    if not hasattr(request, "_eva_sight"):
        request._eva_sight = visibility_for_user(getattr(request, "auth", None) or request.user)
    found: Visibility = request._eva_sight
    return found


def code_of(trial: Any) -> str:
    """The code under which a trial was handed out, "" for one that is of no plan."""
    handout = getattr(trial, "handout", None)
    return str(handout.code) if handout is not None else ""


def plan_titles(rows: Iterable[Any]) -> str:
    """The titles of plans, as a sentence says them."""
    return ", ".join(dict.fromkeys(map(str, rows)))
