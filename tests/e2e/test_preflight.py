"""A preflight with the real processes: of a server that is there, of one that is not, and by the worker."""

import pytest

from tests.e2e.bench_page import BenchPage
from tests.e2e.lab import DEAD, ROOT, STATION, WIDE
from tests.processes import PATIENCE_S, eventually

pytestmark = pytest.mark.slow
SERVED = "pick-place-40k"
_RESTING = f"""
from evaweb.stations.models import Station
file = "{ROOT / "deployments" / "tabletop.toml"}"
Station.objects.get_or_create(name="resting", defaults=dict(robot="agilex_piper", deployment=file, active=False))
"""


@pytest.fixture(scope="module")
def bench(browser, patient):
    bench = BenchPage(browser, patient, "ann", WIDE).open(f"/stations/{STATION}/eval/")
    bench.at_rest()
    yield bench
    assert bench.errors == []
    bench.close()


def flown(bench, checkpoint):
    """Press the button and wait for what is found; the text of it."""
    page = bench.page
    page.select_option("#checkpoint-choice", checkpoint)
    page.locator("[data-preflight-ask]").click()
    eventually(lambda: page.locator("#outcome").inner_text().startswith("Preflight: "), "it is pressed")
    eventually(
        lambda: page.locator("#outcome").inner_text() not in ("Preflight: pressed …", "Preflight: under way"),
        "the preflight is over",
        3 * PATIENCE_S,
    )
    return page.locator("[data-preflight-result]").inner_text()


def test_a_server_that_is_there_is_usable_and_one_that_is_not_has_a_closed_port(bench):
    text = flown(bench, SERVED)
    assert "USABLE" in text
    assert " ms" in text
    text = flown(bench, DEAD)
    assert "PORT CLOSED" in text
    assert "no policy server listens at ws://127.0.0.1:1" in text
    newest = [bench.api(f"preflights?checkpoint={name}")["items"][0] for name in (SERVED, DEAD)]
    assert [row["verdict"] for row in newest] == ["ok", "port_closed"]
    assert newest[0]["report"]["chunk"]["joints"] == 14
    assert {row["by"] for row in newest} == {"station"}


def test_what_was_last_found_is_there_again_when_the_checkpoint_is_chosen(bench):
    page = bench.page
    page.reload()
    page.select_option("#checkpoint-choice", SERVED)
    page.locator("[data-preflight][data-verdict=ok]").wait_for()
    page.select_option("#checkpoint-choice", DEAD)
    page.locator("[data-preflight][data-verdict=port_closed]").wait_for()


def test_the_worker_asks_where_the_station_does_not_run(bench, patient):
    patient.python(_RESTING)
    asked = bench.page.evaluate(
        """async (asked) => {
          const token = document.querySelector('input[name="csrfmiddlewaretoken"]').value;
          const headers = { "Content-Type": "application/json", "X-CSRFToken": token };
          const answer = await fetch("/api/v1/preflights", { method: "POST", headers, body: JSON.stringify(asked) });
          return answer.json();
        }""",
        {"checkpoint": DEAD, "station": "resting"},
    )
    assert asked.get("by") == "worker", asked
    address = f"preflights/{asked['id']}"
    eventually(lambda: bench.api(address)["status"] != "running", "the worker has asked", 3 * PATIENCE_S)
    assert bench.api(address)["verdict"] == "port_closed"
