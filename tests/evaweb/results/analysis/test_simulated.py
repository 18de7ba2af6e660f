"""A plan on simulated benches beside a real one of the same checkpoints: page, REST, and who sees what."""

from __future__ import annotations

from dataclasses import replace

import pytest
from django.test import Client

from evaweb.api.tokens import create_token
from evaweb.plans.models import Plan
from evaweb.plans.services import close_plan, freeze_plan
from evaweb.results.analysis.simulated import compare_with_real, is_simulated, simulated_plans
from evaweb.stations.models import Station
from tests.evaweb.results.conftest import _carried_out

PAGE = "/result/plans/blocks/1/simulated/"


@pytest.fixture
def played(revealed, bench, owner):
    """The same checkpoints on a simulated bench: 16 trials, closed; and the real plan, revealed."""
    Station.objects.filter(pk=bench.station.pk).update(simulated=False)
    made = Plan.objects.create(
        name="played", title="Played", question="?", owner=owner, repetitions=4, blind=False
    )
    made.checkpoints.set(revealed.checkpoints.all())
    made.positions.set(revealed.positions.all())
    made.first, made.second = revealed.first, revealed.second
    made.save()
    plan = freeze_plan(user=owner, plan=made)
    station = Station.objects.create(name="sim-1", robot="agilex_piper", simulated=True)
    _carried_out(replace(bench, station=station), plan, 16, pictures=False)
    plan.refresh_from_db()
    return plan


def test_rates_orders_and_differences_stand_side_by_side(revealed, played):
    assert (is_simulated(revealed), is_simulated(played)) == (False, True)
    assert simulated_plans(revealed) == [played]
    assert simulated_plans(played) == []
    found = compare_with_real(revealed, played)
    assert [(name, real.n, simulated.n) for name, real, simulated in found["rates"]] == [
        ("pi0-block", 8, 8),
        ("pi0-new", 8, 8),
    ]
    assert (found["rank_correlation"], found["rank_violation"]) == (pytest.approx(1.0), 0.0)
    ((first, second, difference),) = found["differences"]
    assert (first, second) == ("pi0-new", "pi0-block")
    assert difference is None  # of eight trials each


def test_page_and_rest_show_those_that_the_reader_may_see(revealed, played, owner, bench):
    client = Client()
    client.force_login(owner)
    text = client.get(PAGE).content.decode()
    assert "Played v1" in text
    assert "needs eight matched trials of each, five successes and five failures" in text
    bearer = Client(headers={"Authorization": f"Bearer {create_token(user=owner, name='x')}"})
    (row,) = bearer.get("/api/v1/plans/blocks/1/simulated").json()
    assert (row["plan"], row["checkpoints"]["pi0-new"]["simulated"]["n"]) == ("played", 8)
    again = Plan.objects.create(name="blind", title="Blind", question="?", owner=owner, repetitions=1)
    again.checkpoints.set(revealed.checkpoints.all())
    again.positions.set(revealed.positions.all())
    close_plan(user=owner, plan=freeze_plan(user=owner, plan=again), reason="it hides its checkpoints")
    assert "Played" not in client.get(PAGE).content.decode()
    assert bearer.get("/api/v1/plans/blocks/1/simulated").status_code == 403
