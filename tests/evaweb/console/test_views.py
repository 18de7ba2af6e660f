"""The pages of the console: who may see them, what stands on them, in every state of a trial."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest
from django.contrib.auth.models import Group, User
from django.db import connection
from django.test import Client
from django.test.utils import CaptureQueriesContext
from django.urls import reverse
from django.utils import timezone

from evaweb.accounts.roles import Role
from evaweb.blinding.visibility import FULL_VISIBILITY
from evaweb.console import selectors
from evaweb.episodes.models import Episode
from evaweb.stations.commands import COLLECTING, KINDS
from evaweb.stations.models import Command, Lease, LeaseRequest, Station
from evaweb.trials.models import (
    FAILURE_KEYS,
    Checkpoint,
    Evaluation,
    FailureTerm,
    Milestone,
    Position,
    Scene,
    Score,
    Trial,
    TrialStatus,
)
from tests.evaweb.trials import builders

pytestmark = pytest.mark.django_db
NASTY = '<script>alert("x")</script>'
ESCAPED = "&lt;script&gt;alert(&quot;x&quot;)&lt;/script&gt;"
TEMPLATES = Path(__file__).parents[3] / "templates"
PAGES = ("/", "/stations/bench-1/", "/stations/bench-1/debug/", "/stations/bench-1/eval/")
FRAGMENTS = ("/stations/bench-1/eval/panel", "/stations/bench-1/lease")


def test_a_page_that_is_opened_again_writes_nothing(browser, station):
    browser.get("/stations/bench-1/debug/")
    with CaptureQueriesContext(connection) as asked:
        assert browser.get("/stations/bench-1/debug/").status_code == 200
    assert [query["sql"] for query in asked if not query["sql"].startswith("SELECT")] == []


@pytest.fixture
def station() -> Station:
    return Station.objects.create(name="bench-1", robot="agilex_piper")


@pytest.fixture
def ada() -> User:
    user = User.objects.create_user("ada", password="secret")
    user.groups.add(Group.objects.get_or_create(name=Role.OPERATOR)[0])
    return user


@pytest.fixture
def browser(client: Client, ada: User) -> Client:
    client.force_login(ada)
    return client


@pytest.fixture
def scene() -> Scene:
    made = Scene.objects.create(name="plate", title="Block on plate", instruction="put it there")
    for number in (1, 2):
        Position.objects.create(scene=made, number=number, label=f"place {number}")
    Milestone.objects.create(scene=made, order=1, text="holds the block")
    Milestone.objects.create(scene=made, order=2, text="block on the plate", required=True)
    return made


@pytest.fixture
def checkpoint() -> Checkpoint:
    return Checkpoint.objects.create(name="forty")


def make_trial(station: Station, user: User, status: str = "prepared", **other: Any) -> Trial:
    """A trial of the one scene and checkpoint there are, at the scene's first position."""
    scene, checkpoint = Scene.objects.get(), Checkpoint.objects.get()
    evaluation, _ = Evaluation.objects.get_or_create(
        name="open bench", kind=Evaluation.Kind.OPEN_BENCH, station=station
    )
    fields = {
        "position": scene.positions.first(),
        "number": Trial.objects.count() + 1,
        "instruction": scene.instruction,
        **other,
    }
    return Trial.objects.create(
        evaluation=evaluation,
        evaluation_version=1,
        checkpoint=checkpoint,
        scene=scene,
        station=station,
        operator=user,
        status=status,
        **fields,
    )


def text_of(browser: Client, address: str) -> str:
    """The page at `address`, which has to be there."""
    answer = browser.get(address)
    assert answer.status_code == 200, (address, answer.status_code)
    return answer.content.decode()


def buttons(html: str, kind: str) -> list[str]:
    """The tags of the buttons among the steps that give a command."""
    steps = html[html.index('id="steps"') :]
    return re.findall(rf'<button[^>]*data-command="{kind}"[^>]*>', steps)


def test_what_gives_a_command_can_be_pressed_only_once_the_pages_script_says_so() -> None:
    texts = {path.name: path.read_text("utf-8") for path in TEMPLATES.rglob("*.html")}
    gated = re.compile(r'data-(?:command|gate)="[^"]*"(?P<mark> aria-disabled="true")?')
    found = [(name, one["mark"]) for name, text in texts.items() for one in gated.finditer(text)]
    assert len(found) > 20
    assert [name for name, mark in found if mark is None] == []


def test_the_e_stop_can_be_pressed_from_the_start(browser: Client, station: Station) -> None:
    page = text_of(browser, "/stations/bench-1/debug/")
    (button,) = re.findall(r'<button[^>]*id="estop"[^>]*>', page)
    assert "disabled" not in button


def test_the_name_of_a_camera_that_is_cut_can_be_read(browser: Client, station: Station) -> None:
    named = re.findall(
        r'<span class="camera-name[^"]*" title="([^"]+)">([^<]+)<',
        text_of(browser, "/stations/bench-1/debug/"),
    )
    assert named
    assert all(title == name for title, name in named)


# --- who ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("address", [*PAGES, *FRAGMENTS])
def test_every_page_asks_for_a_login(client: Client, station: Station, address: str) -> None:
    answer = client.get(address)

    assert answer.status_code == 302
    assert answer["Location"] == f"/login/?next={address}"


def test_the_login_page_says_when_the_password_is_wrong(client: Client, ada: User) -> None:
    answer = client.post("/login/", {"username": "ada", "password": "wrong"})

    assert "The name or the password is wrong" in answer.content.decode()
    assert 'value="ada"' in answer.content.decode()  # forms keep what was typed


def test_a_login_leads_to_the_page_that_was_asked_for(client: Client, ada: User, station: Station) -> None:
    form = {"username": "ada", "password": "secret", "next": "/stations/bench-1/eval/"}

    assert client.post("/login/", form)["Location"] == "/stations/bench-1/eval/"


def test_an_unknown_station_is_named_with_those_that_exist(browser: Client, station: Station) -> None:
    answer = browser.get("/stations/bench-9/eval/")

    assert answer.status_code == 404
    assert "bench-9" in answer.content.decode()
    assert "bench-1" in answer.content.decode()


def test_a_missing_page_says_so_to_anybody_and_shows_nothing_of_the_lab(
    client: Client, station: Station
) -> None:
    answer = client.get("/nothing/here")

    assert answer.status_code == 404
    assert "There is nothing at this address" in answer.content.decode()
    assert "bench-1" not in answer.content.decode()


def test_a_viewer_is_told_that_a_viewer_watches(client: Client, station: Station) -> None:
    client.force_login(User.objects.create_user("vera"))

    html = text_of(client, "/stations/bench-1/lease")

    assert "viewers do not command" in html
    assert "data-lease=" not in html


def test_an_administrator_may_take_over_and_an_operator_may_not(
    browser: Client, client: Client, station: Station
) -> None:
    assert "data-lease-take" not in text_of(browser, "/stations/bench-1/lease")

    client.force_login(User.objects.create_superuser("root"))

    assert "data-lease-take" in text_of(client, "/stations/bench-1/lease")


# --- the shell ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("page", ["debug", "eval"])
def test_the_e_stop_is_on_every_page_of_a_station(browser: Client, station: Station, page: str) -> None:
    html = text_of(browser, f"/stations/bench-1/{page}/")

    assert html.count('id="estop"') == 1
    assert "console/station.js" in html  # which listens to Escape and space


@pytest.mark.parametrize("address", ["/", "/login/", "/nothing/here"])
def test_the_e_stop_is_on_no_other_page(browser: Client, station: Station, address: str) -> None:
    html = browser.get(address, follow=True).content.decode()

    assert "estop" not in html
    assert "console/station.js" not in html


def test_the_tabs_lead_to_the_station_last_used(browser: Client, station: Station) -> None:
    Station.objects.create(name="bench-2", robot="agilex_piper")
    assert 'href="/#stations">Eval' in text_of(browser, "/")  # of two stations none was used yet

    text_of(browser, "/stations/bench-2/debug/")

    assert 'href="/stations/bench-2/eval/">Eval' in text_of(browser, "/")


def test_the_tabs_lead_to_the_only_station(browser: Client, station: Station) -> None:
    assert 'href="/stations/bench-1/debug/">Debug' in text_of(browser, "/")


def test_the_tab_of_the_page_is_marked(browser: Client, station: Station) -> None:
    html = text_of(browser, "/stations/bench-1/debug/")

    assert re.findall(r'aria-current="page">(\w+)<', html) == ["Debug"]


def test_a_station_without_a_page_leads_to_eval(browser: Client, station: Station) -> None:
    assert browser.get("/stations/bench-1/")["Location"] == "/stations/bench-1/eval/"


def test_the_page_knows_its_addresses_joints_and_units(browser: Client, station: Station) -> None:
    html = text_of(browser, "/stations/bench-1/eval/")
    found = re.search(r'<script id="config" type="application/json">(.*?)</script>', html)
    assert found is not None
    config = json.loads(found[1])

    assert config["socket"] == "/ws/stations/bench-1"
    assert config["role"] == "operator"
    assert config["joints"][0] == "left_arm.joint0"
    assert (config["units"][0], config["units"][6]) == ("rad", "m")
    assert config["grippers"] == [6, 13]
    assert config["cameras"] == ["cam_high", "cam_left_wrist", "cam_right_wrist"]


def test_every_camera_has_its_place_before_a_picture_has_come(browser: Client, station: Station) -> None:
    html = text_of(browser, "/stations/bench-1/eval/")

    assert re.findall(r'data-camera="(\w+)" data-stale', html) == [
        "cam_high",
        "cam_left_wrist",
        "cam_right_wrist",
    ]


def test_a_station_whose_robot_is_unknown_still_has_its_page_and_e_stop(browser: Client) -> None:
    Station.objects.create(name="odd", robot="../../etc")

    html = text_of(browser, "/stations/odd/debug/")

    assert 'id="estop"' in html
    assert selectors.robot_facts(robot="../../etc")["error"]


def test_names_that_need_escaping_are_escaped(browser: Client, ada: User) -> None:
    station = Station.objects.create(name="bench-1", title=NASTY, robot="agilex_piper", message=NASTY)
    scene = Scene.objects.create(name="s", title=NASTY, instruction=NASTY, criterion=NASTY, layout=NASTY)
    Position.objects.create(scene=scene, number=1, label=NASTY, description=NASTY)
    Milestone.objects.create(scene=scene, order=1, text=NASTY)
    Checkpoint.objects.create(name=NASTY)
    eve = User.objects.create_user(NASTY)
    LeaseRequest.objects.create(station=station, user=eve, holder="web:x:1")
    for status in (None, "prepared", "ended"):
        Trial.objects.all().delete()
        if status:
            make_trial(station, ada, status, reason=NASTY, duration_s=1.0)
        for address in ("/", "/stations/bench-1/eval/", *FRAGMENTS):
            html = text_of(browser, address)
            assert NASTY not in html, (status, address)
            assert ESCAPED in html or "\\u003Cscript" in html, (status, address)


def test_no_page_has_a_script_of_its_own_in_it(browser: Client, station: Station) -> None:
    for address in ("/", "/stations/bench-1/debug/", "/stations/bench-1/eval/"):
        scripts = re.findall(r"<script([^>]*)>", text_of(browser, address))
        assert scripts
        assert all("src=" in script or "application/json" in script for script in scripts), address
        assert not re.search(r"\son\w+=", text_of(browser, address)), address


# --- the Debug page ------------------------------------------------------------------------------------------

BY_HAND = ("tune", "step", "commit", "cancel", "move", "gripper", "approach")


def test_the_debug_page_gives_every_command_there_is(browser: Client, station: Station) -> None:
    html = text_of(browser, "/stations/bench-1/debug/")
    given = set(re.findall(r'data-command="(\w+)"', html))

    assert given == set(KINDS) - {"estop", *COLLECTING}


@pytest.mark.parametrize("status", [None, "prepared", "running", "paused", "ended"])
def test_nothing_on_the_eval_page_changes_what_a_trial_measures(
    browser: Client, ada: User, station: Station, scene: Scene, checkpoint: Checkpoint, status: str | None
) -> None:
    if status:
        make_trial(station, ada, status, duration_s=1.0)
    html = text_of(browser, "/stations/bench-1/eval/")

    assert not [kind for kind in BY_HAND if f'data-command="{kind}"' in html]
    assert 'name="mode"' not in html


@pytest.mark.parametrize("page", ["debug", "eval"])
def test_a_key_means_one_thing_on_a_page(browser: Client, station: Station, page: str) -> None:
    html = text_of(browser, f"/stations/bench-1/{page}/")
    tags = re.findall(r'<(?:button|input|select)[^>]*data-key="[^"]+"[^>]*>', html)
    meant: dict[str, set[str]] = {}
    for tag in tags:
        what = re.search(r'data-(?:command|lease|prepare)="?(\w*)', tag)
        key = re.search(r'data-key="([^"]+)"', tag)
        assert key is not None
        meant.setdefault(key[1], set()).add(
            what[0].split("=")[0] + what[1] if what and key[1] in "sl" else tag
        )

    assert {key: sorted(tags) for key, tags in meant.items() if len(tags) > 1 and key != "l"} == {}
    assert not {"escape", "space", " ", "shift+s", "shift+p", "shift+escape"} & set(meant)


def test_every_button_and_field_of_the_debug_page_has_a_key(browser: Client, station: Station) -> None:
    html = text_of(browser, "/stations/bench-1/debug/")
    steps = html[html.index('id="steps"') : html.index('id="scene"')]
    tags = re.findall(
        r"<(?:button|input|select)\b[^>]*>", re.sub(r"<template.*?</template>", "", steps, flags=re.S)
    )
    without = [tag for tag in tags if "data-key=" not in tag and 'id="task-choice"' not in tag]

    assert len(tags) > 40
    assert without == []


def test_the_checkpoints_that_may_be_set_up_are_offered_by_name(
    browser: Client, station: Station, checkpoint: Checkpoint
) -> None:
    Checkpoint.objects.create(name="old", active=False)
    html = text_of(browser, "/stations/bench-1/debug/")

    assert re.findall(r"<option value=\"\d+\">(\w+)</option>", html) == ["forty"]


def test_a_bench_is_laid_out_only_where_it_is_simulated(browser: Client, station: Station) -> None:
    assert 'id="seed"' not in text_of(browser, "/stations/bench-1/debug/")

    Station.objects.update(simulated=True)

    assert 'id="seed"' in text_of(browser, "/stations/bench-1/debug/")


# --- home --------------------------------------------------------------------------------------------------


def test_an_empty_lab_shows_the_way_to_the_first_trial(browser: Client, client: Client) -> None:
    assert "An administrator sets up the first one" in text_of(browser, "/")

    client.force_login(User.objects.create_superuser("root"))

    assert f'class="button button-primary" href="{reverse("first-steps")}"' in text_of(client, "/")


def test_home_lists_stations_with_who_commands_and_what_is_tried(
    browser: Client, ada: User, station: Station, scene: Scene, checkpoint: Checkpoint
) -> None:
    Lease.objects.create(station=station, user=ada, holder="web:ada:1", epoch=1)
    make_trial(station, ada, "running")
    Station.objects.create(name="old", robot="agilex_piper", active=False, message="in repair")

    html = text_of(browser, "/")

    assert re.search(r"commanded by\s*<span[^>]*>ada", html)
    assert "Block on plate" in html
    assert "switched off" in html
    assert "in repair" in html
    assert html.index("bench-1") < html.index("old")


def test_home_as_a_fragment_is_the_list_alone(browser: Client, station: Station) -> None:
    html = browser.get("/", headers={"HX-Request": "true"}).content.decode()

    assert "bench-1" in html
    assert "<html" not in html


# --- the four steps ----------------------------------------------------------------------------------------


def test_without_scenes_and_checkpoints_the_panel_says_what_is_missing(
    browser: Client, station: Station
) -> None:
    html = text_of(browser, "/stations/bench-1/eval/panel")

    assert "No scene yet" in html
    assert "No checkpoint yet" in html
    assert 'id="choose"' not in html


def test_without_a_trial_the_panel_offers_a_choice(
    browser: Client, station: Station, scene: Scene, checkpoint: Checkpoint
) -> None:
    html = text_of(browser, "/stations/bench-1/eval/panel")

    assert 'data-status=""' in html
    assert re.search(r'value="1" checked', html)
    assert "data-prepare" in html
    assert "data-needs-setup" in html  # Run stands there, and says why it cannot be pressed
    assert not buttons(html, "setup")


def test_scenes_that_are_switched_off_are_not_offered(
    browser: Client, station: Station, scene: Scene, checkpoint: Checkpoint
) -> None:
    Scene.objects.create(name="old", title="Old scene", instruction="x", active=False)

    assert "Old scene" not in text_of(browser, "/stations/bench-1/eval/panel")


def test_the_positions_are_those_of_the_scene_that_is_chosen(
    browser: Client, station: Station, scene: Scene, checkpoint: Checkpoint
) -> None:
    other = Scene.objects.create(name="other", title="Another", instruction="y")
    Position.objects.create(scene=other, number=7, label="far away")

    html = text_of(browser, "/stations/bench-1/eval/panel?scene=other")

    assert "far away" in html
    assert "place 1" not in html


def test_a_prepared_trial_can_be_set_up_and_chosen_again(
    browser: Client, ada: User, station: Station, scene: Scene, checkpoint: Checkpoint
) -> None:
    trial = make_trial(station, ada)

    html = text_of(browser, "/stations/bench-1/eval/panel")

    assert f'data-trial="{trial.pk}"' in buttons(html, "setup")[0]
    assert f'data-abandon="{trial.pk}"' in html
    assert 'data-set-up=""' in html
    assert len(buttons(html, "run")) == 1


def test_a_trial_is_set_up_by_the_last_set_up_of_its_station_alone(
    ada: User, station: Station, scene: Scene, checkpoint: Checkpoint
) -> None:
    own = Command.objects.create(station=station, user=ada, kind="setup", status="accepted")
    make_trial(station, ada, setup=own.pk)
    assert selectors.eval_panel(station=station, user=ada, sight=FULL_VISIBILITY).set_up

    refused = Command.objects.create(station=station, user=ada, kind="setup", status="refused")
    assert selectors.eval_panel(station=station, user=ada, sight=FULL_VISIBILITY).set_up, refused

    Command.objects.create(station=station, user=ada, kind="setup", status="unknown")
    assert not selectors.eval_panel(station=station, user=ada, sight=FULL_VISIBILITY).set_up


@pytest.mark.parametrize(
    ("status", "shown", "absent"),
    [
        ("running", ("stop", "halt"), ("run", "resume", "setup")),
        ("paused", ("stop", "resume"), ("run", "halt", "setup")),
    ],
)
def test_a_trial_that_goes_on_can_be_ended(
    browser: Client,
    ada: User,
    station: Station,
    scene: Scene,
    checkpoint: Checkpoint,
    status: str,
    shown: tuple[str, ...],
    absent: tuple[str, ...],
) -> None:
    make_trial(station, ada, status, reason="the lease ended", time_limit_s=40.0)

    html = text_of(browser, "/stations/bench-1/eval/panel")

    visible = {kind: [tag for tag in buttons(html, kind) if "data-only-while" not in tag] for kind in shown}
    assert all(visible.values()), visible
    assert not any(buttons(html, kind) for kind in absent)
    assert 'data-limit="40.0"' in html
    assert ("the lease ended" in html) == (status == "paused")


def test_an_ended_trial_is_scored_by_its_milestones(
    browser: Client, ada: User, station: Station, scene: Scene, checkpoint: Checkpoint
) -> None:
    trial = make_trial(station, ada, "ended", duration_s=12.34, reason="stopped")

    html = text_of(browser, "/stations/bench-1/eval/panel")

    assert f'data-score="{trial.pk}"' in html
    assert re.findall(r'name="milestone" value="(\d+)"', html) == [
        str(milestone.pk) for milestone in scene.milestones.order_by("order")
    ]
    assert "Ran 12.3 s: stopped" in html
    assert 'name="success"' not in html  # the required milestone decides
    assert f'data-void="{trial.pk}"' in html
    assert not buttons(html, "run")


def test_without_a_required_milestone_success_is_asked_for(
    browser: Client, ada: User, station: Station, scene: Scene, checkpoint: Checkpoint
) -> None:
    scene.milestones.update(required=False)
    make_trial(station, ada, "ended")

    assert 'name="success"' in text_of(browser, "/stations/bench-1/eval/panel")


def test_phases_and_causes_are_offered_with_their_keys_where_a_trial_is_scored(
    browser: Client, ada: User, station: Station, scene: Scene, checkpoint: Checkpoint
) -> None:
    builders.failure_terms()
    trial = make_trial(station, ada, "ended")
    text = text_of(browser, "/stations/bench-1/eval/panel")
    chosen = re.findall(r'name="(failure\w*)" value="(\w*)"(?: checked)?(?: data-key="([^"]+)")?', text)
    assert chosen == [
        *(("failure_phase", "approach", "shift+a"), ("failure_phase", "grasp", "shift+g")),
        ("failure_phase", "", ""),
        *(("failure", "missed", "shift+m"), ("failure", "dropped", "shift+d"), ("failure", "", "")),
    ]
    type(scene).objects.update(failure_required=True)
    text = text_of(browser, "/stations/bench-1/eval/panel")
    assert 'data-explained="yes"' in text
    assert "not specified" not in text
    type(trial).objects.filter(pk=trial.pk).update(status="prepared")
    assert "failure" not in text_of(browser, "/stations/bench-1/eval/panel")


def test_no_key_of_a_failure_is_another_one_of_the_eval_page_or_commands_without_shift(
    browser: Client, ada: User, station: Station, scene: Scene, checkpoint: Checkpoint
) -> None:
    FailureTerm.objects.all().delete()
    make_trial(station, ada, "prepared")
    pages = text_of(browser, "/stations/bench-1/eval/")
    assert 'data-key="shift+u"' in pages
    Trial.objects.update(status="ended")
    pages += text_of(browser, "/stations/bench-1/eval/")
    keys = set(re.findall(r'data-key="([^"]+)"', pages))
    assert keys.isdisjoint({f"shift+{key}" for key in FAILURE_KEYS})
    acting = re.findall(r"<[^>]*data-(?:command|lease|prepare|next|confirm-cameras)[^>]*>", pages)
    used = {key for tag in acting for key in re.findall(r'data-key="([^"]+)"', tag)}
    assert {"r", "s", "u"} <= used
    assert used.isdisjoint(FAILURE_KEYS)


@pytest.mark.parametrize(("status", "number"), [("scored", 2), ("voided", 1), ("interrupted", 1)])
def test_the_next_choice_begins_where_the_last_trial_leads(
    ada: User, station: Station, scene: Scene, checkpoint: Checkpoint, status: str, number: int
) -> None:
    make_trial(station, ada, status)

    found = selectors.eval_panel(station=station, user=ada, sight=FULL_VISIBILITY)

    assert found.position is not None
    assert found.position.number == number
    assert found.checkpoint == checkpoint


def test_an_interrupted_trial_says_why_and_where_it_is(
    browser: Client, ada: User, station: Station, scene: Scene, checkpoint: Checkpoint
) -> None:
    trial = make_trial(station, ada, "interrupted", reason="e-stop by ada")

    html = text_of(browser, "/stations/bench-1/eval/panel")

    assert "e-stop by ada" in html
    assert f"/result/trials/{trial.pk}/" in html


@pytest.mark.parametrize("status", TrialStatus.values)
def test_page_and_fragment_are_the_same_in_every_state(
    browser: Client, ada: User, station: Station, scene: Scene, checkpoint: Checkpoint, status: str
) -> None:
    episode = Episode.objects.create(station=station, status="finished", started_at=timezone.now())
    trial = make_trial(station, ada, status, episode=episode, duration_s=3.0, seed=5)
    if status == "scored":
        trial.verdict = Score.objects.create(trial=trial, rater=ada, success=True, score=1.0)
        trial.save()

    fragment = text_of(browser, "/stations/bench-1/eval/panel")
    page = text_of(browser, "/stations/bench-1/eval/")

    assert re.findall(r'data-step="(\w+)"', fragment) == ["choose", "setup", "run", "score"]
    assert fragment.strip() in page


def test_the_e_stop_of_a_station_needs_no_module(browser: Client, ada: User, station: Station) -> None:
    html = text_of(browser, "/stations/bench-1/debug/")

    assert 'data-address="/api/v1/stations/bench-1/estop"' in html
    script = re.search(r'<script src="[^"]*console/commands/estop_early.js"></script>', html)
    assert script
    assert html.index('id="estop"') < script.start() < html.index("console/station.js")


# --- lease -------------------------------------------------------------------------------------------------


def test_who_asks_for_the_station_is_shown_with_an_answer_to_give(
    browser: Client, ada: User, station: Station
) -> None:
    bob = User.objects.create_user("bob")
    asked = LeaseRequest.objects.create(station=station, user=bob, holder="web:bob:2")
    LeaseRequest.objects.create(station=station, user=bob, holder="web:bob:1", answer="declined")

    html = text_of(browser, "/stations/bench-1/lease")

    assert re.findall(r'data-lease="(hand_over|decline)" data-request="(\d+)"', html) == [
        ("hand_over", str(asked.pk)),
        ("decline", str(asked.pk)),
    ]
    assert 'data-lease="request"' in html


def test_an_operator_can_take_the_station_from_another_page_of_theirs(
    browser: Client, ada: User, station: Station
) -> None:
    html = text_of(browser, "/stations/bench-1/lease")

    assert re.search(r'data-lease-when="elsewhere".*?data-lease="move"', html, re.DOTALL)


def test_who_has_asked_can_withdraw(browser: Client, ada: User, station: Station) -> None:
    asked = LeaseRequest.objects.create(station=station, user=ada, holder="web:ada:2")

    html = text_of(browser, "/stations/bench-1/lease")

    assert f'data-lease="withdraw" data-request="{asked.pk}"' in html
    assert 'data-lease="request"' not in html


# --- admin -------------------------------------------------------------------------------------------------


def test_the_admin_pages_lead_back_to_the_lab(client: Client) -> None:
    client.force_login(User.objects.create_superuser("root"))

    html = text_of(client, "/admin/")

    assert '<a href="/">Back to the lab</a>' in html
    assert "estop" not in html
