"""URL patterns of the result pages."""

from __future__ import annotations

from django.urls import path

from evaweb.results.pages import views, views_crates, views_draft, views_judging, views_lab

_PLAN = "result/plans/<slug:name>/<int:version>/"
_FROZEN = "result/frozen/<digest:digest>/"
_CRATE = "result/crates/<digest:digest>/"
urlpatterns = [
    path("result/lab/", views_lab.dashboard, name="lab-dashboard"),
    path("result/wall/", views_lab.wall, name="lab-wall"),
    path("result/planner/", views_lab.planner, name="result-planner"),
    path("result/rate/", views_judging.rate, name="rate"),
    path("result/prefer/", views_judging.prefer, name="prefer"),
    path("result/crates/", views_crates.crates, name="crates"),
    path("result/crates/import", views_crates.import_crate, name="crate-import"),
    path(_CRATE, views_crates.crate, name="imported-crate"),
    path(_CRATE + "crate.zip", views_crates.crate_file, name="imported-crate-file"),
    path(_CRATE + "remove", views_crates.remove_crate, name="imported-crate-remove"),
    path("result/plans/", views.plans, name="result-plans"),
    path("result/plans/new/", views_draft.new, name="result-plan-new"),
    path("result/plans/<slug:name>/", views.plan, name="result-plan-newest"),
    path(_PLAN, views.plan, name="result-plan"),
    path(_PLAN + "draft/", views_draft.edit, name="result-draft"),
    path(_PLAN + "draft/power/", views_draft.power, name="result-draft-power"),
    path(_PLAN + "compare/", views.compare, name="result-compare"),
    path(_PLAN + "evidence/", views.evidence, name="result-evidence"),
    path(_PLAN + "report.zip", views.report, name="result-report"),
    path(_PLAN + "crate/", views.crate, name="result-crate"),
    path(_PLAN + "integrity/", views.integrity, name="result-integrity"),
    path(_PLAN + "simulated/", views.simulated, name="result-simulated"),
    path(_PLAN + "cite/", views.cite, name="result-cite"),
    path(_FROZEN, views.frozen, name="result-frozen"),
    *(
        path(f"{_FROZEN}result.{form}", views.frozen_file, {"form": form}, name=f"result-frozen-{form}")
        for form in ("txt", "tex", "svg")
    ),
    path(_PLAN + "trials/", views.trials, name="result-plan-trials"),
    *(
        path(f"{_PLAN}{what}", views.plan_action, {"what": what}, name=f"result-{what}")
        for what in ("freeze", "amend", "close", "reveal", "look", "judge", "carry-out", "pause")
    ),
]
