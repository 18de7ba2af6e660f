"""What a program that works as an operator leaves alone, and what it refuses before it moves anything."""

from __future__ import annotations

from typing import Any

import pytest

from evaweb.lab import plan_runner
from evaweb.lab.progress import silent
from evaweb.lab.rest_client import RestClient
from evaweb.lab.stall_detection import DemoFailed

MILESTONES = [{"text": "held", "truth": "grasped"}]
TRIAL = {"id": 7, "checkpoint": "CODE1", "time_limit_s": 40.0, "scene": "blocks", "operator": "ann"}


class Lab:
    """A lab's REST with one plan, one scene and one trial, and the station's page."""

    username = "ann"

    def __init__(self, trial=TRIAL, milestones=MILESTONES, left_open=(), estop=False):
        self.trial, self.milestones, self.left_open, self.estop = trial, milestones, left_open, estop
        self.posted: list[str] = []

    def get(self, path: str) -> Any:
        if path.startswith("plans/"):
            return {"state": "frozen", "blind": True, "total": 2, "counted": 0}
        if path.startswith("scenes/"):
            return {"milestones": self.milestones}
        if path.startswith("trials?"):
            return {"items": [row for row in self.left_open if f"status={row['status']}" in path]}
        return {**self.trial, "status": "prepared"}

    def post(self, path: str, content: Any) -> Any:
        self.posted.append(path)
        return {"code": "CODE1", "attempt": 1, "trial": self.trial}

    def wait(self, reached, seconds, label):
        return {"estop": self.estop}


def run(lab, monkeypatch, page=None):
    page = page or lab
    monkeypatch.setattr(plan_runner, "LivePage", lambda *of: page)
    monkeypatch.setattr(plan_runner, "claim_station", lambda page: None)
    lab.close = lambda: None
    return plan_runner.run_plan(lab, "bench-1", "a plan", 1, print, silent(), lockstep=True)


@pytest.mark.parametrize(
    ("changes", "milestones", "why"),
    [
        ({"checkpoint": "pi0"}, MILESTONES, "was told the checkpoint of CODE1"),
        ({"time_limit_s": None}, MILESTONES, "scene blocks has no time limit"),
        (
            {},
            [{"text": "neat", "truth": ""}],
            "milestone 'neat' of scene blocks is none that the bench reports",
        ),
    ],
)
def test_what_needs_a_person_is_given_up_before_the_robot_moves(monkeypatch, changes, milestones, why):
    lab = Lab({**TRIAL, **changes}, milestones)
    monkeypatch.setattr(plan_runner, "set_up_and_run", lambda *of, **how: pytest.fail("the robot moves"))
    with pytest.raises(DemoFailed, match=why) as refused:
        run(lab, monkeypatch)
    assert lab.posted[-2:] == ["plans/a%20plan/next", "trials/7/abandon"]
    assert "pi0" not in str(refused.value)


def test_a_trial_of_somebody_else_is_left_alone(monkeypatch):
    lab = Lab(left_open=[{**TRIAL, "operator": "peter", "status": "ended"}])
    with pytest.raises(DemoFailed, match="trial 7 at bench-1 is peter's and ended"):
        run(lab, monkeypatch)
    assert lab.posted == []


def test_a_run_that_has_ended_is_never_voided_because_its_score_is_refused(monkeypatch):
    lab = Lab()

    def refuse(operator, trial):
        raise DemoFailed("no such score")

    monkeypatch.setattr(plan_runner, "set_up_and_run", lambda *of, **how: None)
    monkeypatch.setattr(plan_runner, "run_to_its_end", lambda *of, **how: 0)
    monkeypatch.setattr(plan_runner, "score_by_truth", refuse)
    with pytest.raises(DemoFailed, match="no such score"):
        run(lab, monkeypatch)
    assert lab.posted[-1] == "plans/a%20plan/next"


def test_a_pressed_e_stop_ends_the_program_and_leaves_the_trial_to_a_person(monkeypatch):
    lab = Lab(estop=True)
    monkeypatch.setattr(plan_runner, "set_up_and_run", lambda *of, **how: None)
    monkeypatch.setattr(plan_runner, "run_to_its_end", lambda *of, **how: 0)
    monkeypatch.setattr(plan_runner, "score_by_truth", lambda *of: pytest.fail("a person judges it"))
    with pytest.raises(DemoFailed, match="the e-stop of bench-1 is pressed"):
        run(lab, monkeypatch)


@pytest.mark.parametrize("url", ["", "moon", "http://127.0.0.1:port", "http://127.0.0.1:1 2"])
def test_an_address_that_is_none_is_named(url):
    with pytest.raises(DemoFailed, match="is no address"):
        RestClient(url).login("ann", "ann")
