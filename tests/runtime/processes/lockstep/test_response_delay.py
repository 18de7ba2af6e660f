"""The delay of a response in lockstep is what the deployment declares, never what the server says or takes."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from runtime.config import loader
from runtime.core.errors import ConfigurationError
from runtime.processes.lockstep.response_delay import draw_delay
from runtime.station.checks import check_deployment
from runtime.station.spec import StationSpec
from tests.runtime.simulation.tabletop_station import DEPLOYMENTS


def declaring(data: Path, *assignments: str) -> StationSpec:
    given = [f'data_dir="{data}"', *assignments]
    return check_deployment(loader.load(DEPLOYMENTS / "tabletop.toml", given))


def test_one_number_is_the_delay_of_every_response(tmp_path: Path) -> None:
    made = declaring(tmp_path, "policy.delay_ms=80")
    assert {draw_delay(made, seed, number) for seed in range(3) for number in range(5)} == {0.08}


def test_of_a_list_each_value_comes_as_often_as_it_stands_there(tmp_path: Path) -> None:
    made = declaring(tmp_path, "policy.delay_ms=[50, 50, 50, 400]")
    drawn = Counter(draw_delay(made, 7, number) for number in range(4000))
    assert set(drawn) == {0.05, 0.4}
    assert drawn[0.4] == pytest.approx(1000, abs=110)  # four standard deviations


def test_seed_and_number_alone_decide(tmp_path: Path) -> None:
    def course(seed: int, *assignments: str) -> list[float | None]:
        made = declaring(tmp_path, "policy.delay_ms=[10, 20, 30, 40]", *assignments)
        return [draw_delay(made, seed, number) for number in range(40)]

    assert course(3) == course(3, 'policy.url="ws://127.0.0.1:1"', "control.rate=15")
    assert course(3) != course(4)


@pytest.mark.parametrize("wrong", ["-1", "[]", "[10, -1]", "nan", "[inf]", "70000", '"80"', "true"])
def test_a_delay_that_cannot_be_is_refused_by_name(tmp_path: Path, wrong: str) -> None:
    with pytest.raises(ConfigurationError, match=r"policy\.delay_ms"):
        declaring(tmp_path, f"policy.delay_ms={wrong}")


@pytest.mark.parametrize("changes", [{"collecting": True}, {}])
def test_who_declares_none_has_that_of_the_station(tmp_path: Path, changes: dict[str, Any]) -> None:
    declared = ["policy.delay_ms=80"] if changes else []
    assert draw_delay(replace(declaring(tmp_path, *declared), **changes), 1, 1) is None
