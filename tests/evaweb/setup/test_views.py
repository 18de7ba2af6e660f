"""The pages on which a lab is set up: who may ask for them, what they are given, what they answer."""

from __future__ import annotations

import json
import shutil
from typing import Any

import numpy as np
import pytest
from django.test import Client
from django.urls import reverse

from evaweb.plans.models import Reference
from evaweb.setup.editing import OVERHEAD
from evaweb.stations.models import Station
from evaweb.trials.models import FailureTerm, Scene
from evaweb.trials.tables import example_layout
from runtime.benches.schema import FOLDER, load_schema
from runtime.simulation.bench.bench import Bench, overhead_camera
from tests.evaweb.trials import builders

pytestmark = pytest.mark.django_db


@pytest.fixture
def scene(db):
    return builders.scene()


@pytest.fixture
def to(client, alma):
    """What is answered to an administrator, or to `user`, who posts JSON."""

    def posted(name: str, content: Any, *args: Any, user: Any = alma) -> Any:
        client.force_login(user)
        return client.post(reverse(name, args=args), json.dumps(content), content_type="application/json")

    return posted


def state(client: Client, user: Any, address: str) -> Any:
    client.force_login(user)
    return client.get(address).context["state"]


def test_the_corners_are_where_the_camera_from_above_sees_them():
    left, right, near, far = Bench().area
    corners = np.array([[left, near, 0], [right, near, 0], [right, far, 0], [left, far, 0]])
    pixels = overhead_camera(640, 480).project(corners) + 0.5
    assert pixels / (640, 480) == pytest.approx(np.array(OVERHEAD), abs=1e-4)


def test_an_editor_is_given_the_scene_and_saves_it_once(client, alma, to, scene):
    address = reverse("setup-scene", args=[scene.name])
    given = state(client, alma, address)
    assert [row["number"] for row in given["scene"]["positions"]] == [1, 2]
    given["scene"]["title"] = "Another title"
    saved = to("setup-scene", {"scene": given["scene"], "seen": given["seen"]}, scene.name)
    assert saved.status_code == 200, saved.content
    assert saved.json()["address"] == address
    assert saved.json()["scene"]["title"] == Scene.objects.get().title == "Another title"
    late = to("setup-scene", {"scene": {**given["scene"], "title": "His"}, "seen": given["seen"]}, scene.name)
    assert (late.status_code, late.json()["seen"]) == (409, saved.json()["seen"])


def test_a_new_scene_begins_with_a_position_and_is_refused_place_by_place(client, alma, to):
    given = state(client, alma, reverse("setup-new-scene"))["scene"]
    assert [(row["number"], row["bench"]) for row in given["positions"]] == [(1, None)]
    answer = to("setup-new-scene", {"scene": given})
    assert answer.status_code == 400
    assert {fault["place"] for fault in answer.json()["faults"]} == {"name", "title", "instruction"}
    given |= {"name": "cups", "title": "Cups", "instruction": "stack"}
    assert to("setup-new-scene", {"scene": given}).json()["address"] == reverse("setup-scene", args=["cups"])
    again = to("setup-new-scene", {"scene": {**given, "title": "Other cups"}})
    assert "name" in {fault["place"] for fault in again.json()["faults"]}


def test_a_new_scene_of_a_lab_with_a_simulated_bench_has_its_block_and_plate(client, alma, live):
    live.simulated = True
    live.save()
    given = state(client, alma, reverse("setup-new-scene"))
    assert given["scene"]["positions"][0]["bench"] == example_layout(load_schema("tabletop"))
    assert given["stations"][0]["corners"]["cam_high"] == OVERHEAD


def test_a_new_scene_for_another_bench_begins_with_its_task_and_is_saved(client, alma, to):
    given = state(client, alma, reverse("setup-new-scene") + "?bench=sorting")
    assert set(given["bench"]["objects"]) == set(given["scene"]["positions"][0]["bench"])
    assert len(given["scene"]["milestones"]) == 5
    assert to("setup-new-scene", {"scene": given["scene"]}).status_code == 200
    page = client.get(reverse("setup-scene", args=["sorting-by-colour"]))
    assert "Red block 1 rests in the blue bin" in page.content.decode()
    assert page.context["state"]["bench"]["objects"]["red_1"]["colour"] == "#e24a16"


def test_an_unknown_bench_is_refused_and_a_lost_one_is_named(client, alma, to, scene, tmp_path):
    client.force_login(alma)
    assert client.get(reverse("setup-new-scene") + "?bench=moon").status_code == 400
    bench = tmp_path / "own"
    shutil.copytree(FOLDER / "tabletop", bench)
    Scene.objects.update(bench=str(bench))
    shutil.rmtree(bench)
    load_schema.cache_clear()
    page = client.get(reverse("setup-scene", args=[scene.name]))
    assert f"bench &#x27;{bench}&#x27; has no bench.toml" in page.content.decode()
    assert client.get(reverse("setup-scenes")).status_code == 200


def test_positions_are_compared_with_the_bench_that_a_scene_is_changed_to(client, alma, to, scene):
    scene.positions.update(bench={"block": [0.0, 0.3, 0]})
    given = state(client, alma, reverse("setup-scene", args=[scene.name]))
    answer = to(
        "setup-scene", {"scene": {**given["scene"], "bench": "sorting"}, "seen": given["seen"]}, scene.name
    )
    assert answer.status_code == 400
    assert "block: unknown key; allowed: blue_bin" in answer.json()["faults"][0]["text"]
    answer = to(
        "setup-scene", {"scene": {**given["scene"], "bench": "moon"}, "seen": given["seen"]}, scene.name
    )
    assert [fault["place"] for fault in answer.json()["faults"]] == ["bench"]


def test_a_copy_is_of_no_trial_and_of_no_plan(client, alma, to, bench):
    bench.prepare()
    name = bench.scene.name
    given = state(client, alma, reverse("setup-new-scene") + f"?from={name}")
    assert given["kept"] == {}
    copied = {**given["scene"], "name": "copied"}
    assert copied["title"] == f"{bench.scene.title} (copy)"
    assert to("setup-new-scene", {"scene": copied}).status_code == 200
    made = Scene.objects.get(name="copied")
    assert made.positions.count() == bench.scene.positions.count()
    assert list(made.milestones.values_list("text", "required")) == list(
        bench.scene.milestones.values_list("text", "required")
    )


def test_a_position_has_its_newest_reference_pictures(client, alma, scene):
    station = Station.objects.create(name="bench-7", robot="agilex_piper")
    first = scene.positions.first()
    for picture in ("0" * 64, "1" * 64):
        Reference.objects.create(station=station, camera="cam_high", position=first, picture=picture, by=alma)
    newest = reverse("picture", args=["1" * 64])
    [seen] = state(client, alma, reverse("setup-scene", args=[scene.name]))["references"][first.pk]
    assert (seen["station"], seen["camera"], seen["picture"]) == ("bench-7", "cam_high", newest)
    [(_, drawn)] = client.get(reverse("setup-scenes")).context["rows"]
    assert [row["picture"] for row in drawn["positions"]] == [newest, ""]


def test_the_operators_view_is_made_by_the_templates_of_the_eval_page(to, scene):
    FailureTerm.objects.all().delete()
    scene = {
        "layout": "the cup stands left",
        "criterion": "the cup is in the bowl",
        "positions": [{"number": 1}, {"number": 2, "description": "handle to the right"}],
        "milestones": [{"text": "held <b>"}, {"text": "in the bowl", "points": 3, "required": True}],
    }
    html = to("setup-preview", {"scene": scene, "position": 1}).json()["html"]
    for words in (
        "the cup stands left",
        "handle to the right",
        "the cup is in the bowl",
        "in the bowl",
        "3 points",
    ):
        assert words in html
    assert "held &lt;b&gt;" in html
    assert 'data-key="2"' in html
    assert "required for success" in html
    assert 'name="success"' not in html  # the milestones decide
    refused = to("setup-preview", {"scene": {"positions": 7}})
    assert refused.status_code == 400
    assert refused.json() == {"error": "positions = 7: Input should be a valid list"}


@pytest.mark.parametrize("sent", ["[]", "{", '{"scene": 7}', '{"scene": {"title": []}}'])
def test_what_is_no_scene_is_refused_in_a_sentence(client, alma, scene, sent):
    client.force_login(alma)
    answer = client.post(reverse("setup-scene", args=[scene.name]), sent, content_type="application/json")
    assert answer.status_code in (400, 409)
    assert answer.json()["error"]


def test_administrators_write_operators_read_and_viewers_have_no_hub(client, to, ann, vera, alma, scene):
    seen = [reverse("setup-scenes"), reverse("setup-scene", args=[scene.name])]
    seen.append(reverse("setup-sheet", args=[scene.name]))
    for user, statuses in ((alma, (200, 200)), (ann, (200, 403)), (vera, (403, 403))):
        client.force_login(user)
        assert [client.get(address).status_code for address in seen] == [200] * 3
        asked = (reverse("setup"), reverse("setup-new-scene"))
        assert tuple(client.get(address).status_code for address in asked) == statuses
        assert (reverse("setup") in client.get(reverse("home")).content.decode()) == (user != vera)
    assert to("setup-scene", {"scene": {}, "seen": ""}, scene.name, user=ann).status_code == 403
    assert "data-remove" not in client.get(seen[1]).content.decode()


def test_a_scene_is_found_by_its_id_too_and_one_that_does_not_exist_is_named(client, alma, scene):
    client.force_login(alma)
    own = client.get(reverse("setup-scene", args=[scene.pk]))
    assert own["Location"] == reverse("setup-scene", args=[scene.name])
    assert client.get(reverse("setup-scene", args=["nowhere"])).status_code == 404
    assert client.get(reverse("setup-new-scene") + "?from=nowhere").status_code == 404


def test_a_camera_that_shows_nothing_says_so(client, bob, bench):
    client.force_login(bob)
    answer = client.get(reverse("setup-live", args=[bench.station.name, "cam_high"]))
    assert answer.status_code in (409, 503)
    assert bench.station.name in answer.json()["error"] or "cam_high" in answer.json()["error"]
