"""What a lab has, and what is missing in it next."""

from __future__ import annotations

import pytest
from django.test import Client
from django.urls import resolve, reverse

from evaweb.blinding.visibility import FULL_VISIBILITY, Visibility
from evaweb.plans.models import Plan
from evaweb.preflights.models import Preflight
from evaweb.setup.selectors import cards
from evaweb.stations.models import Station
from evaweb.trials.models import Checkpoint
from tests.evaweb.trials import builders

pytestmark = pytest.mark.django_db


def missing(user, sight=FULL_VISIBILITY):
    return {card.title: [one.text for one in card.missing] for card in cards(user=user, sight=sight)}


def test_an_empty_lab_misses_everything_and_each_has_a_form(alma, client):
    assert missing(alma) == {
        "Scenes": ["No scene is offered to operators."],
        "Checkpoints": ["No checkpoint yet."],
        "Plans": ["No plan yet: trials outside a plan answer no question."],
        "People": ["alma is the only one who runs and scores trials: there is no second rater."],
        "Stations": ["No station yet."],
    }
    client.force_login(alma)
    for card in cards(user=alma, sight=FULL_VISIBILITY):
        for address in (card.address, card.add, *(one.address for one in card.missing)):
            assert client.get(address).status_code == 200, address


def test_each_thing_that_is_not_whole_is_named_with_the_form_that_mends_it(alma, bob, bench):
    scene = builders.scene("cups")
    scene.positions.all().delete()
    scene.milestones.all().delete()
    off = builders.scene("off")
    off.active = False
    off.save()
    Station.objects.update(boot="")
    draft = Plan.objects.create(name="cups", title="Cups", owner=alma)
    told = missing(alma)
    assert told["Scenes"] == [
        "block on plate does not say what counts as success.",
        "cups has no position: no trial can begin.",
        "cups has no milestone: its score is success or failure alone.",
        "cups does not say what counts as success.",
    ]
    assert told["Plans"] == ["Cups v1 has no position and no checkpoint."]
    assert told["People"] == []
    assert told["Stations"] == [f"{bench.station} was never seen: start its runtime, or correct its name."]
    draft.positions.set(bench.scene.positions.all())
    draft.checkpoints.set([bench.checkpoint])
    [plans] = [card for card in cards(user=alma, sight=FULL_VISIBILITY) if card.title == "Plans"]
    assert [one.text for one in plans.missing] == ["Cups v1 is a draft: its trials begin once it is frozen."]
    assert resolve(plans.missing[0].address).view_name == "result-plan"
    Station.objects.update(boot="b1")
    assert missing(alma)["Stations"] == []
    assert missing(bob)["Plans"] == ["No plan yet: trials outside a plan answer no question."]  # it is alma's


@pytest.mark.parametrize(("verdict", "usable"), [("ok", True), ("timeout", False)])
def test_a_checkpoint_wants_a_preflight_that_succeeded(alma, bench, verdict, usable):
    told = f"{bench.checkpoint} has no successful preflight."
    assert missing(alma)["Checkpoints"] == [told]
    report = {"verdict": verdict}
    row = {"checkpoint": bench.checkpoint, "station": bench.station, "by": "worker", "status": "done"}
    Preflight.objects.create(**row, report=report)
    assert missing(alma)["Checkpoints"] == ([] if usable else [told])


def test_a_hidden_checkpoint_is_neither_counted_nor_named(bob, bench):
    hidden = Checkpoint.objects.create(name="secret")
    sight = Visibility(checkpoints=frozenset({hidden.pk}), names=frozenset({"secret"}))
    [card] = [card for card in cards(user=bob, sight=sight) if card.title == "Checkpoints"]
    assert (card.count, card.newest) == (1, bench.checkpoint.name)
    assert not any("secret" in one.text for one in card.missing)


def test_an_operator_is_led_to_no_form_of_administration(client: Client, bob, bench):
    client.force_login(bob)
    Station.objects.update(boot="")
    page = client.get(reverse("setup")).content.decode()
    assert "was never seen" in page
    assert "/admin/" not in page
