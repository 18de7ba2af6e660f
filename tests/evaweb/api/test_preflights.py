"""Preflights over REST."""

import pytest

from evaweb.preflights.models import Preflight
from tests.evaweb.preflights.conftest import CLOSED, OK, Runtime

pytestmark = pytest.mark.django_db


@pytest.fixture
def runtime(bench, monkeypatch):
    made = Runtime()
    monkeypatch.setattr("evaweb.preflights.services.connection_to", lambda name: made)
    return made


def test_one_is_asked_for_and_read_until_it_is_over(rest, bench, runtime):
    status, asked = rest.post("preflights", checkpoint=bench.checkpoint.name, station=bench.station.name)
    assert (status, asked["status"], asked["report"]) == (202, "running", None)
    assert (asked["checkpoint"], asked["station"]) == (bench.checkpoint.name, bench.station.name)
    assert (asked["asked_by"], asked["by"]) == (bench.operator.username, "station")
    assert rest.get(f"preflights/{asked['id']}")[1]["status"] == "running"
    runtime.told[asked["id"]] = {"running": False, "report": OK, "failure": ""}
    status, found = rest.get(f"preflights/{asked['id']}")
    assert (status, found["status"], found["verdict"], found["report"]) == (200, "done", "ok", OK)
    assert found["ended_at"]


def test_those_of_a_checkpoint_are_listed_the_newest_first(rest, bench, runtime):
    for report in (OK, CLOSED):
        _, asked = rest.post("preflights", checkpoint=bench.checkpoint.pk)
        runtime.told[asked["id"]] = {"running": False, "report": report, "failure": ""}
        rest.get(f"preflights/{asked['id']}")
    status, page = rest.get("preflights", checkpoint=bench.checkpoint.name)
    assert (status, page["total"]) == (200, 2)
    assert [row["verdict"] for row in page["items"]] == ["port_closed", "ok"]
    assert rest.get("preflights", limit=1)[1]["items"][0]["verdict"] == "port_closed"


def test_what_is_refused_says_why(rest, viewer, bench, runtime):
    assert rest.post("preflights", checkpoint="nobody")[0] == 404
    assert rest.post("preflights", checkpoint=bench.checkpoint.name, station="nowhere")[0] == 404
    assert rest.post("preflights")[0] == 422
    assert rest.get("preflights/00000000-0000-0000-0000-000000000000")[0] == 404
    assert viewer.post("preflights", checkpoint=bench.checkpoint.name)[0] == 403
    runtime.refuses = "preflight is not allowed while running"
    status, said = rest.post("preflights", checkpoint=bench.checkpoint.name)
    assert (status, said["error"]) == (409, "preflight is not allowed while running")
    assert not Preflight.objects.exists()


def test_a_viewer_reads_the_verdict_alone(rest, viewer, bench, runtime):
    _, asked = rest.post("preflights", checkpoint=bench.checkpoint.name)
    runtime.told[asked["id"]] = {"running": False, "report": CLOSED, "failure": ""}
    found = viewer.get(f"preflights/{asked['id']}")[1]
    assert found["verdict"] == "port_closed"
    assert set(found["report"]) == {"verdict", "stage", "advice", "ok"}
    assert found["hidden"]
    assert "gpu-7" not in str(viewer.get("preflights")[1])
