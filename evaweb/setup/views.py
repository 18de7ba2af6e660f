"""Pages for setting up a lab: overview, scenes, and the scene editor."""

from __future__ import annotations

from typing import Any

from django.http import Http404, HttpRequest, HttpResponse, JsonResponse
from django.shortcuts import redirect, render
from django.urls import reverse
from django.views.decorators.http import require_GET, require_http_methods, require_POST

from evaweb.accounts.roles import Role, require_role, role_of
from evaweb.blinding.visibility import visibility_for_request
from evaweb.core.errors import EvaError, NotFound
from evaweb.plans import image_store
from evaweb.setup import editing, selectors
from evaweb.stations.selectors import station_get
from evaweb.trials.scene_writing import ChangedMeanwhile, SceneRefused, scene_write
from evaweb.trials.selectors import scene_get
from runtime.core import bounded_documents as bounded
from runtime.core.sentences import Pattern

_SENT_ALLOWED_APPLICATION_JSON = Pattern(
    "setup.views.sent_allowed_application_json",
    "{content_type!r:.60} was sent; allowed: application/json",
)
_SENT_ALLOWED_TABLE_WITH_SCENE = Pattern(
    "setup.views.sent_allowed_table_with_scene",
    "{given!r:.60} was sent; allowed: a table with the scene",
)

LONGEST_SCENE = 512 * 1024  # [characters]
_PATIENCE_S = 1.5  # timeout of a camera image


@require_GET
def hub(request: HttpRequest) -> HttpResponse:
    """Render the overview of what exists and what is missing."""
    require_role(request.user, Role.OPERATOR)
    cards = selectors.cards(user=request.user, sight=visibility_for_request(request))
    return render(request, "setup/hub.html", {"cards": cards, "may_write": _may_write(request)})


@require_GET
def scenes(request: HttpRequest) -> HttpResponse:
    """Render all scenes with their positions."""
    rows = [(scene, editing.shown(scene)) for scene in selectors.scene_rows()]
    return render(request, "setup/scenes.html", {"rows": rows, "may_write": _may_write(request)})


@require_http_methods(["GET", "POST"])
def new_scene(request: HttpRequest) -> HttpResponse:
    """Render the editor for a new scene, or for a copy of the scene in ?from=; write a posted scene.

    ?bench= is the simulated bench of a new scene, whose task it begins with.
    """
    require_role(request.user, Role.ADMIN)
    if request.method == "POST":
        return _written(request, None)
    source = request.GET.get("from", "")
    bench = request.GET.get("bench", "")
    return _editor(request, editing.new(scene_get(name=source) if source else None, bench))


@require_http_methods(["GET", "POST"])
def scene(request: HttpRequest, name: str) -> HttpResponse:
    """Render the editor of a scene, read-only for users who may not write; write a posted scene."""
    if request.method == "POST":
        return _written(request, name)
    row = _scene(name)
    if row.name != name:  # requested by id: the page saves under the name
        return redirect("setup-scene", name=row.name)
    return _editor(request, editing.existing(row))


@require_GET
def sheet(request: HttpRequest, name: str) -> HttpResponse:
    """Render the positions for printing in true size."""
    row = _scene(name)
    return render(request, "setup/sheet.html", {"scene": row, "drawn": editing.shown(row)})


@require_POST
def preview(request: HttpRequest) -> JsonResponse:
    """Return the cards of a scene for set-up and scoring, as the operator would see them.

    The scene is in the request, so that it can be previewed before it is saved.
    """
    body = _posted(request)
    return JsonResponse({"html": editing.operators_view(request, body.get("scene"), body.get("position"))})


@require_GET
def live(request: HttpRequest, name: str, camera: str) -> HttpResponse:
    """Return the current image of a station's camera."""
    images = image_store.current_images(station_get(name=name), [camera], _PATIENCE_S)
    return HttpResponse(images[camera], content_type="image/jpeg")


def _scene(name: str) -> Any:
    try:
        return scene_get(name=name)
    except NotFound as error:
        raise Http404(str(error)) from None


def _may_write(request: HttpRequest) -> bool:
    return role_of(request.user) is Role.ADMIN


def _editor(request: HttpRequest, context: dict[str, Any]) -> HttpResponse:
    return render(request, "setup/scene.html", {**context, "may_write": _may_write(request)})


def _posted(request: HttpRequest) -> dict[str, Any]:
    if request.content_type != "application/json":
        raise EvaError(_SENT_ALLOWED_APPLICATION_JSON(content_type=request.content_type))
    try:
        body = bounded.parse_json(request.body, "the scene", LONGEST_SCENE)
    except bounded.UnreadableDocument as error:
        raise EvaError(str(error)) from None
    if not isinstance(body, dict):
        raise EvaError(_SENT_ALLOWED_TABLE_WITH_SCENE(given=body))
    return body


def _written(request: HttpRequest, name: str | None) -> JsonResponse:
    """Write the scene of the request, and answer with the address of the scene, with remarks and the scene's state.

    `name` is the scene to be changed; None creates one. If the scene is invalid, the answer lists each faulty place. If
    the scene has changed meanwhile, the answer says so.
    """
    body = _posted(request)
    table = body.get("scene")
    try:
        scene, remarks = scene_write(
            user=request.user,  # type: ignore[arg-type]
            name=name,
            given=table if isinstance(table, dict) else {},
            seen=str(body.get("seen", "")),
        )
    except SceneRefused as refused:
        faults = [{"place": fault.place, "text": fault.text} for fault in refused.faults]
        return JsonResponse({"error": str(refused), "faults": faults}, status=refused.status)
    except ChangedMeanwhile as changed:
        return JsonResponse({"error": str(changed), "seen": changed.seen}, status=changed.status)
    address = reverse("setup-scene", args=[scene.name])
    return JsonResponse({"address": address, "remarks": remarks, **editing.state_of(scene)})
