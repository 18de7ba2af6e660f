"""Pages of the lab for the search, by title and common synonyms."""

from __future__ import annotations

from dataclasses import dataclass

from django.urls import NoReverseMatch, reverse

from evaweb.accounts.roles import Role


@dataclass(frozen=True, slots=True)
class Page:
    """Page; `more` are synonyms for the search."""

    title: str
    route: str
    more: str = ""
    least: Role = Role.VIEWER


_PAGES = (
    Page("Home", "home", "stations overview alarms my work"),
    Page("Set up a lab", "setup", "scenes checkpoints people stations missing", least=Role.OPERATOR),
    Page("Scenes", "setup-scenes", "editor positions layout milestones bench"),
    Page("New plan", "result-plan-new", "draft wizard evaluation", least=Role.ADMIN),
    Page("Replay", "replay-list", "episodes recordings videos review"),
    Page("Datasets", "dataset-list", "lerobot merge convert push"),
    Page("Lab", "lab-dashboard", "dashboard result now"),
    Page("Subsets", "subset-list", "episodes query training set provenance"),
    Page("Bags", "bag-list", "ros mcap import mapping topics"),
    Page("Evaluations", "result-plans", "plans results comparisons"),
    Page("Other labs", "crates", "ro-crate import results external"),
    Page("All trials", "result", "results statistics scores"),
    Page("Second ratings", "rate", "rate again rater video score"),
    Page("Pairwise preference", "prefer", "prefer pairs judge"),
    Page("How many trials?", "result-planner", "planner power sample size hours"),
    Page("Wall", "lab-wall", "big screen spectator"),
    Page("Failures", "result-failures", "gallery clips causes"),
    Page("Jobs", "jobs", "worker queue progress preview publish"),
    Page("Your account", "account", "orcid profile role hugging face token hub"),
    Page("Change your password", "password", "account settings"),
    Page("First steps", "first-steps", "set up begin start help", least=Role.ADMIN),
    Page("Check of the machine", "machine-check", "real time disk clock memory ports", least=Role.ADMIN),
    Page("Diagnostic bundle", "diagnosis", "logs help support versions", least=Role.ADMIN),
    Page("Administration", "admin:index", "settings", least=Role.ADMIN),
    Page("People", "admin:auth_user_changelist", "users accounts roles administration", least=Role.ADMIN),
    Page("Stations, in administration", "admin:stations_station_changelist", "robots", least=Role.ADMIN),
    Page("Scenes, in administration", "admin:trials_scene_changelist", "tasks positions", least=Role.ADMIN),
    Page(
        "Checkpoints, in administration", "admin:trials_checkpoint_changelist", "policies", least=Role.ADMIN
    ),
    Page("Plans, in administration", "admin:plans_plan_changelist", "evaluations", least=Role.ADMIN),
    Page("Failure words", "admin:trials_failureterm_changelist", "causes phases taxonomy", least=Role.ADMIN),
    Page("API tokens", "admin:api_token_changelist", "rest credentials scripts", least=Role.ADMIN),
)


def pages_of(role: Role) -> list[tuple[Page, str]]:
    """Return the pages that the role may open, with their addresses."""
    pages = [(page, _address(page.route)) for page in _PAGES if role.includes(page.least)]
    return [(page, address) for page, address in pages if address]


def _address(route: str) -> str:
    try:
        return reverse(route)
    except NoReverseMatch:
        return ""
