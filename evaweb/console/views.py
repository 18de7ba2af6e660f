"""Pages of the console, and the fragments that they fetch."""

from __future__ import annotations

import logging
from typing import Any

from django.contrib.sessions.backends.base import UpdateError
from django.http import Http404, HttpRequest, HttpResponse
from django.shortcuts import redirect, render
from django.templatetags.static import static
from django.urls import reverse
from django.views.decorators.http import require_safe

from evaweb.accounts.roles import role_of
from evaweb.blinding.visibility import visibility_for_request
from evaweb.collect import panel as collecting
from evaweb.console import selectors
from evaweb.console.history import histories
from evaweb.console.home import alarms, now
from evaweb.console.stills import still_of
from evaweb.core.errors import EvaError, NotFound
from evaweb.core.lock_wait import lock_wait
from evaweb.datasets.robot_replay import make_offer, playable_episode
from evaweb.serving.stop_port import origin_for
from evaweb.stations.models import Station
from evaweb.stations.selectors import request_list, station_get
from evaweb.trials.selectors import checkpoint_list

log = logging.getLogger(__name__)
_REMEMBER_S = 0.5


def home(request: HttpRequest) -> HttpResponse:
    """Render the home page; with htmx one part of it: the stations, the alarms, or everything except the stations."""
    htmx: Any = request.htmx  # type: ignore[attr-defined]
    part = (htmx.target if htmx.target in ("now", "alarms") else "stations") if htmx else ""
    context: dict[str, Any] = {}
    if part in ("", "stations"):
        context["rows"] = selectors.station_rows()
    if part in ("", "now"):
        context["now"] = now(user=request.user, sight=visibility_for_request(request))
    if part == "alarms":
        context["now"] = {"alarms": list(alarms())}
    return render(request, f"console/{part or 'home'}.html", context)


@require_safe
def history(request: HttpRequest) -> HttpResponse:
    """Render the stations' last week."""
    return render(
        request, "console/history.html", {"histories": list(histories(visibility_for_request(request)))}
    )


@require_safe
def still(request: HttpRequest, name: str) -> HttpResponse:
    """Return the newest image of a station's first camera.

    If there is none, the answer is empty (204), because that is not a fault.
    """
    station = _station(name)
    try:
        return HttpResponse(still_of(station), content_type="image/jpeg")
    except NotFound:
        return HttpResponse(status=204)


def station(request: HttpRequest, name: str) -> HttpResponse:
    """Redirect a station's bare address to its evaluation page."""
    return redirect("station-eval", name=_station(name).name)


def debug(request: HttpRequest, name: str) -> HttpResponse:
    """Render the page for operating a station manually: every command, every value."""
    station, visibility = _station(name), visibility_for_request(request)
    if name in visibility.busy_stations:
        return _page(request, station, "redacted", {"why": visibility.plans})
    context = {"checkpoints": checkpoint_list(sight=visibility), **_replayed(request, station)}
    return _page(request, station, "debug", context)


def _replayed(request: HttpRequest, station: Station) -> dict[str, Any]:
    """Return the station's offer to replay the episode in ?replay=, or the reason why it cannot.

    {} without ?replay=.
    """
    source = request.GET.get("replay", "")
    if not source:
        return {}
    try:
        recorded = playable_episode(source, request.GET.get("robot", ""))
        return {"replay": make_offer(recorded, station, request.GET.get("space", "joint"))}
    except EvaError as error:
        return {"replay_problem": str(error)}


def evaluate(request: HttpRequest, name: str) -> HttpResponse:
    """Render a station's evaluation page with its current trial."""
    station = _station(name)
    return _page(request, station, "eval", _panel(request, station))


def panel(request: HttpRequest, name: str) -> HttpResponse:
    """Render the four steps of a trial as a fragment."""
    return render(request, "console/panel.html", _panel(request, _station(name)))


def collect(request: HttpRequest, name: str) -> HttpResponse:
    """Render a station's collecting page with its current session."""
    station = _station(name)
    context = {**collecting.session_panel(station=station), **collecting.progress_panel(station=station)}
    return _page(request, station, "collect", context)


def collect_session(request: HttpRequest, name: str) -> HttpResponse:
    """Render the session, or the form that opens one, as a fragment."""
    station = _station(name)
    return render(request, "collect/session.html", collecting.session_panel(station=station))


def collect_progress(request: HttpRequest, name: str) -> HttpResponse:
    """Render counts, last episode and queue as a fragment."""
    station = _station(name)
    return render(request, "collect/progress.html", collecting.progress_panel(station=station))


def lease(request: HttpRequest, name: str) -> HttpResponse:
    """Render the holder of the lease and the waiting requests as a fragment."""
    return render(request, "console/lease.html", _lease(request, _station(name)))


def _station(name: str) -> Station:
    try:
        return station_get(name=name)
    except NotFound as error:
        raise Http404(str(error)) from None


def _page(request: HttpRequest, station: Station, page: str, extra: dict[str, Any]) -> HttpResponse:
    _remember(request, station)
    robot, stops = selectors.robot_facts(robot=station.robot), origin_for(request)
    context = {
        "station": station,
        "robot": robot,
        "config": {**_config(request, station, page, robot), "stops": stops},
        **_lease(request, station),
        **extra,
    }
    response = render(request, f"console/{page}.html", context)
    if stops:
        response._csp_update = {"connect-src": [stops]}  # type: ignore[attr-defined]
    return response


def _remember(request: HttpRequest, station: Station) -> None:
    """Remember this station as the one to which this browser's tabs lead; a database failure is only logged."""
    if request.session.get(selectors.SESSION_KEY) == station.name:
        return
    request.session[selectors.SESSION_KEY] = station.name
    try:
        with lock_wait(_REMEMBER_S):
            request.session.save()
    except UpdateError as error:
        log.warning(
            "nobody notes that %a is at %a: %r", request.user.get_username(), station.name, error.__context__
        )
    request.session.modified = False


def _config(request: HttpRequest, station: Station, page: str, robot: dict[str, Any]) -> dict[str, Any]:
    """Return the settings that the page's modules need before the socket is open."""
    api = f"/api/v1/stations/{station.name}"
    return {
        "page": page,
        "station": station.name,
        "user": request.user.get_username(),
        "role": role_of(request.user).value,
        "simulated": station.simulated,
        "joints": robot["names"],
        "units": robot["units"],
        "grippers": robot["grippers"],
        "cameras": robot["cameras"],
        "socket": f"/ws/stations/{station.name}",
        "geometry": f"/stations/{station.name}/geometry",
        "lease": reverse("station-lease", args=[station.name]),
        "api": {"lease": f"{api}/lease", "commands": f"{api}/commands", "estop": f"{api}/estop"},
        "trials": f"{api}/trials",
        "trial": "/api/v1/trials",
        "plans": "/api/v1/plans",
        "cameras_confirmed": f"{api}/cameras",
        "references": f"{api}/references",
        "sessions": f"{api}/sessions",
        "session": "/api/v1/sessions",
        "jobs": "/api/v1/jobs",
        "preflights": {
            "ask": "/api/v1/preflights",
            "result": "/preflights/",
            "newest": reverse("preflight-newest"),
        },
        "uplot": static("uplot/uPlot.iife.min.js"),
        "beat": static("console/commands/beat.js"),
    }


def _panel(request: HttpRequest, station: Station) -> dict[str, Any]:
    panel = selectors.eval_panel(
        station=station,
        user=request.user,
        sight=visibility_for_request(request),
        scene=request.GET.get("scene", ""),
        plan=request.GET.get("plan"),
    )
    return {"panel": panel, "station": station}


def _lease(request: HttpRequest, station: Station) -> dict[str, Any]:
    waiting = list(request_list(station=station))
    return {
        "station": station,
        "role": role_of(request.user).value,
        "waiting": waiting,
        "mine": next(
            (request_row for request_row in waiting if request_row.user_id == request.user.pk), None
        ),
    }
