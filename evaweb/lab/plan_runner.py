"""Automated blind evaluation: trial by trial as by an operator, scored by the bench's ground truth.

The operator's session takes the station, confirms its cameras, requests trials, sets up, runs and scores, all over
REST and the live socket; it never learns the checkpoint. Then the plan's owner closes and reveals the plan.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import closing
from dataclasses import asdict, dataclass, replace
from typing import Any
from urllib.parse import quote

from evaweb.lab.progress import Progress
from evaweb.lab.rest_client import LivePage, RestClient
from evaweb.lab.single_trial import (
    claim_station,
    run_to_its_end,
    score_by_truth,
    set_up_and_run,
    wait_for_recorded,
)
from evaweb.lab.stall_detection import DemoFailed, wait_until

_OPEN = ("prepared", "running", "paused", "ended")  # statuses of a trial that keeps its station
_FREE_S = 60.0  # time for the lease of a program that was killed to expire
_LOOK_S = 10.0  # patience for a state of the station
_TRIES = 3  # attempts of a trial whose set-up or run is interrupted
Tell = Callable[[str], None]


@dataclass(frozen=True, slots=True)
class CompletedTrial:
    """Trial that counts, as known to the operator; `times` maps milestones to the time when they were reached
    [s of the run].
    """

    code: str
    trial: int
    attempt: int
    scene: str
    position: int
    success: bool
    score: float
    duration_s: float
    times: Mapping[str, float]


def require_simulated(operator: RestClient, station: str) -> None:
    """Raise DemoFailed if the station has a real robot: nobody would watch it."""
    if not operator.get(f"stations/{_quoted(station)}")["simulated"]:
        raise DemoFailed(
            f"station {station} has a real robot; allowed: a simulated one, nobody watches it here"
        )


def trials_left(operator: RestClient, plan: str) -> int:
    """Return how many trials of a plan are not scored yet; 0 if it has ended.

    Raises:
        DemoFailed: If the plan is not frozen yet, or not blind.
    """
    fields = operator.get(f"plans/{_quoted(plan)}")
    if fields["state"] == "draft":
        raise DemoFailed(f"plan {plan} is a draft; allowed: a frozen one")
    if not fields["blind"]:
        raise DemoFailed(f"plan {plan} is not blind; allowed: a blind one, or --copies")
    return int(fields["total"]) - int(fields["counted"]) if fields["state"] == "frozen" else 0


def run_plan(
    operator: RestClient,
    station: str,
    plan: str,
    count: int,
    tell: Tell,
    progress: Progress,
    *,
    lockstep: bool,
) -> list[CompletedTrial]:
    """Run the next `count` trials of a plan, or fewer if its design ends.

    A trial that an earlier program left open at the station is scored if its run has ended, otherwise given up.

    Raises:
        DemoFailed: If a trial cannot be completed, or reveals its checkpoint.
    """
    trials = []
    with closing(LivePage(operator, station)) as page:
        page.wait(lambda state: not state["lease"]["holder"], _FREE_S, "waiting until the station is free")
        claim_station(page)
        _finish_open_trials(operator, page, station, plan)
        operator.post(f"stations/{_quoted(station)}/cameras", {"first": True})
        for number in range(1, count + 1):
            try:
                with progress.during(f"trial {number} of {count}"):
                    trial = _run_trial(operator, page, station, plan, lockstep)
            except DemoFailed:
                if operator.get(f"plans/{_quoted(plan)}")["state"] == "frozen":
                    raise
                tell(f"the plan's design has ended after {number - 1} trials")
                break
            trials.append(trial)
            verdict = "success" if trial.success else "no success"
            tell(
                f"{number:>3} of {count}  {trial.code}  position {trial.position}  {verdict}, {trial.score:.0%}"
            )
    return [
        replace(trial, duration_s=wait_for_recorded(operator, trial.trial)["duration_s"]) for trial in trials
    ]


def close_and_reveal(owner: RestClient, plan: str, made: list[CompletedTrial]) -> dict[str, Any]:
    """Close and reveal the plan; return commitment, key, and the trials with the names of their checkpoints."""
    if owner.get(f"plans/{plan}")["state"] == "frozen":  # else its design has ended it
        owner.post(f"plans/{plan}/close", {"reason": f"{len(made)} trials were made"})
    fields = owner.post(f"plans/{plan}/reveal", {})
    trials = [
        {**asdict(trial), "checkpoint": owner.get(f"trials/{trial.trial}")["checkpoint"]} for trial in made
    ]
    return {
        "plan": fields["name"],
        "version": fields["version"],
        "digest": fields["digest"],
        "commitment": fields["commitment"],
        "key": fields["key"],
        "trials": trials,
    }


def _finish_open_trials(operator: RestClient, page: LivePage, station: str, plan: str) -> None:
    for status in _OPEN:
        asked = f"trials?station={_quoted(station)}&status={status}&evaluation={_quoted(plan)}"
        for trial in operator.get(asked)["items"]:
            if trial["operator"] != operator.username:
                raise DemoFailed(
                    f"trial {trial['id']} at {station} is {trial['operator']}'s and {status}: allowed once it is scored"
                )
            if status == "ended":
                score_by_truth(operator, trial["id"])
            else:
                _give_up(operator, page, trial["id"], "the program that ran it was ended")


def _run_trial(
    operator: RestClient, page: LivePage, station: str, plan: str, lockstep: bool
) -> CompletedTrial:
    fault = ""
    for _ in range(_TRIES):
        handed = operator.post(f"plans/{_quoted(plan)}/next", {"station": station})
        code, trial = handed["code"], handed["trial"]
        try:
            limit = _check(operator, code, trial)
        except DemoFailed as refused:
            _give_up(operator, page, trial["id"], str(refused))
            raise
        try:
            set_up_and_run(page, trial["id"], lockstep=lockstep)
            run_to_its_end(page, trial["id"], limit, lockstep=lockstep)
        except DemoFailed as failed:
            _require_no_estop(page, station)
            fault = str(failed)
            _give_up(operator, page, trial["id"], fault)
            continue
        _require_no_estop(page, station)
        scored = score_by_truth(
            operator, trial["id"]
        )  # a run that has ended is never repeated for its result
        facts = {name: scored[name] for name in ("scene", "position", "success", "score", "duration_s")}
        times = operator.get(f"trials/{trial['id']}")["truth"].get("reached", {})
        return CompletedTrial(code=code, trial=trial["id"], attempt=handed["attempt"], times=times, **facts)
    raise DemoFailed(f"a trial of {plan} was not made in {_TRIES} attempts: {fault}")


def _check(operator: RestClient, code: str, trial: Mapping[str, Any]) -> float:
    """Return the time limit of a prepared trial [s].

    Raises:
        DemoFailed: If its checkpoint is visible, its run would not end by itself, or a person has to score it.
    """
    if trial["checkpoint"] != code:
        raise DemoFailed(f"the plan is not blind for its operator, who was told the checkpoint of {code}")
    if trial["time_limit_s"] is None:
        raise DemoFailed(
            f"scene {trial['scene']} has no time limit, and nobody ends its runs; allowed: one that has"
        )
    for milestone in operator.get(f"scenes/{_quoted(trial['scene'])}")["milestones"]:
        if not milestone["truth"]:
            raise DemoFailed(
                f"milestone {milestone['text']!r} of scene {trial['scene']} is none that the bench reports, and nobody "
                "scores it here; allowed: one with a name in the bench's truth"
            )
    return float(trial["time_limit_s"])


def _require_no_estop(page: LivePage, station: str) -> None:
    """Raise DemoFailed if the e-stop is pressed: a person judges that trial, and starts this again."""
    if page.wait(lambda state: True, _LOOK_S, "looking at the e-stop")["estop"]:
        raise DemoFailed(
            f"the e-stop of {station} is pressed: score or void its trial, release the e-stop, and start this again"
        )


def _quoted(name: str) -> str:
    return quote(name, safe="")


def _give_up(operator: RestClient, page: LivePage, trial: int, fault: str) -> None:
    """Stop, abandon or void the trial, whatever its status, so that the station is free for the next attempt."""
    status = operator.get(f"trials/{trial}")["status"]
    if status in ("running", "paused"):
        page.command("stop")
        over = wait_until(
            lambda: operator.get(f"trials/{trial}"),
            lambda found: found["status"] not in ("running", "paused"),
            "waiting for the end of the trial",
        )
        status = over["status"]
    if status == "prepared":
        operator.post(f"trials/{trial}/abandon", {"reason": fault[:200]})
    elif status in ("ended", "scored"):
        operator.post(f"trials/{trial}/void", {"reason": fault[:200]})
