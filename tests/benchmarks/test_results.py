import pytest

from benchmarks import results
from benchmarks.results_pages import _out_of_order, _share


def test_the_stopping_rule_keeps_its_alpha_where_peeking_does_not():
    found = {figure.name: figure for figure in results.rule_figures(300)}
    for rate in ("0.5", "0.8", "0.3"):
        assert found[f"false_positive_rate.{rate}"].holds
        assert found[f"naive_false_positive_rate.{rate}"].value > 0.1


def test_blocks_out_of_order_torn_apart_or_twice_are_counted():
    fine = [(0, 0, 1), (2, 1, 2), (1, 0, 1), (3, 1, 2)]
    assert _out_of_order(fine) == 0
    assert _out_of_order([(2, 1, 2), (0, 0, 1)]) == 1  # a later block began first
    assert _out_of_order([(1, 0, 1), (0, 0, 1)]) == 1  # not in the order of the block
    assert _out_of_order([(0, 0, 1), (1, 0, 2)]) == 1  # two stations had one block


def test_figures_of_a_database_are_named_by_page_and_database():
    page = {"p50": 10.0, "p95": 250.0, "cold_p95": 300.0, "queries": 12.0}
    row = {
        "database": "sqlite",
        "pages": dict.fromkeys(results.PAGES, page),
        "exports": {"evaluation_csv": 9000.0},
        "handing": {
            "left": 0.0,
            "twice": 1.0,
            "codes_twice": 0.0,
            "out_of_order": 0.0,
            "locked": 0.0,
            "p95_ms": 5.0,
        },
        "planner": {"page_p95_ms": 20.0, "answered": 3.0, "refused": 37.0},
    }
    found = {figure.name: figure for figure in results.database_figures(row)}
    assert found["page_p95_ms.dashboard.sqlite"].holds is False
    assert found["queries.results.sqlite"].holds is True
    assert found["handing.twice.sqlite"].holds is False
    assert found["export_rows_per_s.evaluation_csv.sqlite"].value == 9000.0


def test_a_share_is_one_of_the_values():
    assert _share([3.0, 1.0, 2.0], 0.95) == 3.0


@pytest.mark.exhaustive
def test_a_small_lab_is_measured_on_each_database():
    report = results.measure(1.0, plans=2, trials=80, runs=20)
    assert "export_rows_per_s" in {figure.name for figure in report.figures}
    assert report.rows[0]["database"] == "sqlite"
    for found in report.rows:
        assert set(found["pages"]) == set(results.PAGES)
        assert [found["handing"][fault] for fault in ("left", "twice", "out_of_order")] == [0, 0, 0]
        assert max(page["queries"] for page in found["pages"].values()) <= results.MOST_QUERIES
