import csv
import io

import pytest
from pyarrow import parquet

from tests.evaweb.results.conftest import _alone, bench, carry_out, owner, plan, revealed  # noqa: F401  fixtures

PLAN = "/api/v1/plans/blocks/1"


@pytest.fixture
def asked(revealed, client, vera):  # noqa: F811
    client.force_login(vera)
    return lambda rest: client.get(f"{PLAN}/{rest}")


def body(answer):
    return b"".join(answer.streaming_content)


@pytest.mark.exhaustive
def test_every_statistic(asked):
    found = asked("results").json()
    assert found["n"] == 16
    assert set(found["arms"]) == {"pi0-new", "pi0-block"}
    arm = found["arms"]["pi0-new"]
    assert arm["n"] == 8
    assert arm["wilson"][0] < arm["rate"] < arm["wilson"][1]
    assert asked("results/pi0-new").json() == arm
    assert (arm["smoothness"]["n"], arm["smoothness"]["mean"]) == (6, pytest.approx(-5.3))
    assert arm["smoothness_commanded"]["mean"] == pytest.approx(-4.8)
    assert asked("results?position=1").json()["n"] == 8
    assert asked("comparison?first=pi0-block&second=pi0-new").json() == found["comparisons"][0]


def test_what_does_not_exist_is_named(asked):
    assert "there are trials of: " in asked("results/none").json()["error"]
    assert asked("comparison?first=a&second=b").status_code == 404
    assert "allowed: 1, 2" in asked("results?position=9").json()["error"]
    assert asked("results?chekpoint=1").status_code == 422


def test_attempts_in_pages_as_csv_and_as_parquet(asked):
    page = asked("outcomes?limit=5&offset=10").json()
    assert page["total"] == 16
    assert [row["order"] for row in page["items"]] == [11, 12, 13, 14, 15]
    rows = list(csv.DictReader(io.StringIO(body(asked("outcomes?format=csv")).decode())))
    table = parquet.read_table(io.BytesIO(body(asked("outcomes?format=parquet")))).to_pylist()
    assert len(rows) == len(table) == 16
    assert [row["code"] for row in rows] == [row["code"] for row in table]
    assert {row["success"] for row in table} == {True, False}
    assert {row["failure"] for row in rows} == {"", "'=dropped"}  # no formula for a spreadsheet
    assert {row["failure"] for row in table} == {"", "=dropped"}
    assert table[0]["duration_s"] == pytest.approx(float(rows[0]["duration_s"]))
    assert body(asked("outcomes?format=csv&position=1")).count(b"\r\n") == 9
    assert sorted(row["smoothness"] for row in rows)[:4] == [""] * 4  # absent, and not 0
    assert [row["smoothness"] for row in table].count(None) == 4


@pytest.mark.parametrize("what", ["scores", "ratings", "judgements", "preferences"])
def test_other_entities_in_all_formats(asked, what):
    n = 16 if what == "scores" else 0
    assert asked(what).json()["total"] == n
    assert body(asked(f"{what}?format=csv")).count(b"\r\n") == n + 1
    assert parquet.read_table(io.BytesIO(body(asked(f"{what}?format=parquet")))).num_rows == n


@pytest.mark.exhaustive
def test_the_planner(asked, client):
    found = client.get("/api/v1/planner?rate=0.6&better=0.9").json()
    by_rule = {row["rule"]: row for row in found["designs"]}
    assert by_rule["none"]["pairs"] in (31, 32, 33)
    assert by_rule["early"]["mean"] < by_rule["none"]["pairs"] <= by_rule["late"]["pairs"]
    assert by_rule["evidence"]["pairs"] > by_rule["late"]["pairs"]
    assert found["comparisons"] == 1
    several = client.get("/api/v1/planner?rate=0.3&better=0.9&checkpoints=3").json()
    assert (several["comparisons"], several["alpha"]) == (3, pytest.approx(0.05 / 3))
    assert several["designs"][0]["total"] == 3 * several["designs"][0]["pairs"]
    assert {row["mean"] for row in several["designs"]} == {
        None
    }  # it goes on until the last comparison has ended
    with_first = client.get("/api/v1/planner?rate=0.3&better=0.9&checkpoints=3&comparing=control").json()
    assert (with_first["comparisons"], with_first["alpha"]) == (2, pytest.approx(0.025))
    assert client.get("/api/v1/planner?comparing=each").status_code == 422
    assert client.get("/api/v1/planner?rate=3").status_code == 422
    near = client.get("/api/v1/planner?rate=0&better=1e-170")
    assert (near.status_code, "at least 0.001" in near.json()["error"]) == (400, True)
    small = client.get("/api/v1/planner?rate=0.5&better=0.501&hours=1").json()
    assert {row["pairs"] for row in small["designs"]} == {None}
