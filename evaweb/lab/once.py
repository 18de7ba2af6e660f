"""One trial from choosing to dataset, as an operator does it, scored from the bench's own truth."""

from __future__ import annotations

import time
from collections.abc import Mapping
from contextlib import closing
from dataclasses import asdict, dataclass
from typing import Any

from evaweb.lab.visitor import LivePage, VisitFailed, Visitor

_STATION_UP_S = 60.0
_READY_S = 60.0
_STOPPED_S = 10.0
_PUBLISHED_S = 60.0
_RESUMES = 3
_REST_S = 1.0  # how long success has to last before the operator presses Stop
_SLOWEST = 30.0  # how many times as long as its own time a run in lockstep may take


@dataclass(frozen=True, slots=True)
class Choice:
    """What is run."""

    station: str
    scene: str
    position: int
    checkpoint: str
    seed: int


@dataclass(frozen=True, slots=True)
class Done:
    """A complete scored and recorded trial."""

    trial: int
    success: bool
    score: float
    duration_s: float
    episode: str
    frames: int
    dataset: str
    dataset_index: int
    control: Mapping[str, Any]
    resumed: int
    viewer_frames: int
    wall_s: float


def perform(visitor: Visitor, choice: Choice) -> Done:
    """Take the station, set up, run until it succeeds or its time is over, stop, score, wait for the dataset."""
    begun = time.monotonic()
    with closing(LivePage(visitor, choice.station)) as page:
        trial = start(visitor, page, choice)
        resumed = run_to_its_end(page, trial, float(visitor.get(f"trials/{trial}")["time_limit_s"]))
        episode = _published(visitor, score_by_truth(visitor, trial)["episode"])
        scored = whole(visitor, trial, episode)
    return Done(
        trial=trial,
        success=scored["success"],
        score=scored["score"],
        duration_s=scored["duration_s"],
        episode=episode["uuid"],
        frames=episode["frames"],
        dataset=episode["dataset"],
        dataset_index=episode["dataset_index"],
        control=episode["control"],
        resumed=resumed,
        viewer_frames=page.frames,
        wall_s=time.monotonic() - begun,
    )


def start(visitor: Visitor, page: LivePage, choice: Choice) -> int:
    """Take the station, prepare a trial, set up and run; its id."""
    page.wait(lambda state: state["state"] != "disconnected", _STATION_UP_S, "waiting for the station")
    page.claim()
    named = {name: value for name, value in asdict(choice).items() if name != "station"}
    trial: int = visitor.post(f"stations/{choice.station}/trials", named)["id"]
    page.wait(lambda state: state["lease"]["epoch"] == page.epoch, _STOPPED_S, "waiting for the lease")
    set_up_and_run(page, trial)
    return trial


def set_up_and_run(page: LivePage, trial: int, lockstep: bool = False) -> None:
    """Set the station up for a prepared trial, and begin its run."""
    page.command("setup", trial)
    set_up = page.wait(lambda state: state["state"] != "setting_up", _READY_S, "setting up")
    if set_up["state"] != "ready":
        raise VisitFailed(f"set-up ended {set_up['state']}: {set_up['reason']}")
    page.command("run", trial)
    # One that holds at once, because an observation was late, has begun too: it is resumed. In lockstep, as fast as the
    # machine, one may have begun and ended between two looks.
    begun = ("running", "holding", "ready") if lockstep else ("running", "holding")
    page.wait(lambda state: state["state"] in begun, _STOPPED_S, "starting the run")


def report(done: Done) -> dict[str, Any]:
    """The result as JSON."""
    return asdict(done)


def run_to_its_end(page: LivePage, trial: int, limit: float, lockstep: bool = False) -> int:
    """Watch until the bench says it is done or the run ends by itself; press Stop.

    In lockstep it always ends by itself: a Stop of ours would come when the machine has time for it. Where it holds for
    a reason that passes (an observation that was late), resume a few times as an operator would; returns how often.
    """
    succeeded = 0.0

    def over(state: Mapping[str, Any]) -> bool:
        nonlocal succeeded
        if lockstep or not state["truth"].get("success"):
            succeeded = 0.0
        elif not succeeded:
            succeeded = state["clock"]
        return state["state"] != "running" or bool(succeeded and state["clock"] - succeeded >= _REST_S)

    for resumed in range(_RESUMES + 1):
        state = page.wait(over, limit * _SLOWEST if lockstep else limit + 30.0, "running")
        if state["state"] != "holding" or resumed == _RESUMES:
            break
        page.command("resume", trial)
        page.wait(lambda now: now["state"] != "holding", _STOPPED_S, "resuming")
    if state["state"] in ("running", "holding"):
        page.command("stop")
    page.wait(lambda now: now["state"] not in ("running", "holding"), _STOPPED_S, "stopping")
    return resumed


def score_by_truth(visitor: Visitor, trial: int) -> Mapping[str, Any]:
    """Tick what the bench says was reached, and when, once the trial waits to be scored and its truth is there."""
    facts = _poll(
        lambda: visitor.get(f"trials/{trial}"),
        lambda found: found["status"] in ("ended", "interrupted") and found["truth"] is not None,
        _STOPPED_S,
        "waiting for the end of the trial and the bench's truth",
    )
    milestones = visitor.get(f"scenes/{facts['scene']}")["milestones"]
    said = facts["truth"]["milestones"]
    reached = {str(milestone["id"]): bool(said.get(milestone["truth"])) for milestone in milestones}
    when = {
        str(milestone["id"]): facts["truth"].get("reached", {}).get(milestone["truth"])
        for milestone in milestones
        if reached[str(milestone["id"])]
    }
    words = {"note": "scored from the bench's truth", "source": "truth"}
    content = {"milestones": reached, "times": when, **words}
    visitor.post(f"trials/{trial}/score", content)
    scored: Mapping[str, Any] = visitor.get(f"trials/{trial}")
    return scored


def recorded(visitor: Visitor, trial: int) -> Mapping[str, Any]:
    """The trial once it is as long as its recording, whatever becomes of that later."""
    uuid = visitor.get(f"trials/{trial}")["episode"]
    episode = _poll(
        lambda: visitor.get(f"episodes/{uuid}"),
        lambda facts: facts["duration_s"] is not None,
        _PUBLISHED_S,
        "waiting for the recording",
    )
    return whole(visitor, trial, episode)


def _published(visitor: Visitor, episode: str) -> Mapping[str, Any]:
    found: Mapping[str, Any] = _poll(
        lambda: visitor.get(f"episodes/{episode}"),
        lambda facts: facts["dataset_index"] is not None and facts["duration_s"] is not None,
        _PUBLISHED_S,
        "waiting for the dataset",
    )
    return found


def whole(visitor: Visitor, trial: int, episode: Mapping[str, Any]) -> Mapping[str, Any]:
    """The trial once it is as long as its recording: until then its duration is that of the commands."""
    found: Mapping[str, Any] = _poll(
        lambda: visitor.get(f"trials/{trial}"),
        lambda facts: facts["duration_s"] == episode["duration_s"],
        _STOPPED_S,
        "waiting for the exact duration",
    )
    return found


def _poll(ask: Any, reached: Any, seconds: float, what: str) -> Any:
    deadline = time.monotonic() + seconds
    while not reached(found := ask()):
        if time.monotonic() > deadline:
            raise VisitFailed(f"{what}: not within {seconds:g} s; it is {found}")
        time.sleep(0.25)
    return found
