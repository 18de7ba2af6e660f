"""A single trial, from its preparation to the dataset, made as an operator would make it.

The trial is scored by the ground truth of the simulated bench.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass
from typing import Any
from uuid import uuid4

from evaweb.lab.rest_client import LivePage, RestClient
from evaweb.lab.stall_detection import DemoFailed, wait_until

_RESUMES = 3
_REST_S = 1.0  # time that success must last before Stop is pressed
_OVER_S = 30.0  # station time after the limit by which a run should have ended by itself


@dataclass(frozen=True, slots=True)
class TrialChoice:
    """Station, trial and checkpoint of the run."""

    station: str
    scene: str
    position: int
    checkpoint: str
    seed: int


@dataclass(frozen=True, slots=True)
class TrialReport:
    """Scored, recorded and published trial."""

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


def run_one_trial(visitor: RestClient, choice: TrialChoice) -> TrialReport:
    """Take the station, set up, run to success or time limit, stop, score, and wait for the dataset."""
    begun = time.monotonic()
    with closing(LivePage(visitor, choice.station)) as page:
        trial = start(visitor, page, choice)
        resumed = run_to_its_end(page, trial, float(visitor.get(f"trials/{trial}")["time_limit_s"]))
        episode = _published(visitor, score_by_truth(visitor, trial)["episode"])
        scored = wait_for_recording(visitor, trial, episode)
    return TrialReport(
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


def start(visitor: RestClient, page: LivePage, choice: TrialChoice) -> int:
    """Take the station, prepare a trial, set up and run; return the trial's id."""
    claim_station(page)
    named = {name: value for name, value in asdict(choice).items() if name != "station"}
    trial: int = visitor.post(f"stations/{choice.station}/trials", named)["id"]
    set_up_and_run(page, trial)
    return trial


def claim_station(page: LivePage) -> None:
    """Take the station as soon as it is connected."""
    page.wait_with_progress(
        lambda state: state["state_is"]["connected"], "waiting for the station", progress_marker
    )
    page.claim()
    page.wait_with_progress(
        lambda state: state["lease"]["epoch"] == page.epoch, "waiting for the lease", progress_marker
    )


def progress_marker(state: Mapping[str, Any]) -> object:
    """Return facts of a station that change with any progress; the clock is not included."""
    stages = [stage["state"] for stage in state.get("stages", ())]
    facts = [state.get(name) for name in ("boot", "sequence", "state", "reason", "phase", "stage")]
    return facts, stages, state.get("lease", {}).get("epoch"), state.get("run", {}).get("number")


def _elapsed(state: Mapping[str, Any]) -> float:
    """Return the run's elapsed time on its own clock [s]."""
    return float(state.get("run", {}).get("elapsed", 0.0))


def set_up_and_run(page: LivePage, trial: int, lockstep: bool = False) -> None:
    """Set the station up for a prepared trial, and begin its run."""
    page.command("setup", trial)
    set_up = page.wait_with_progress(
        lambda state: not state["state_is"]["preparing"], "setting up", progress_marker
    )
    if not set_up["state_is"]["ready"]:
        raise DemoFailed(f"set-up ended {set_up['state']}: {set_up['reason']}")
    page.command("run", trial)
    # A run that holds at once, because an observation was late, has begun too and is resumed. In lockstep, which is as
    # fast as the machine, a run may begin and end between two polls.
    begun = "set_up" if lockstep else "run_open"
    page.wait_with_progress(lambda state: state["state_is"][begun], "starting the run", progress_marker)


def report(done: TrialReport) -> dict[str, Any]:
    """Return the result as JSON."""
    return asdict(done)


def run_to_its_end(page: LivePage, trial: int, limit: float, lockstep: bool = False) -> int:
    """Watch until the bench reports success or the run ends by itself, then press Stop; return the number of resumes.

    In lockstep the run always ends by itself, because the time of a Stop would depend on the machine's speed. A run
    that holds for a transient reason (a late observation) is resumed a few times, as an operator would.
    """
    succeeded = 0.0

    def over(state: Mapping[str, Any]) -> bool:
        nonlocal succeeded
        if _elapsed(state) > limit + _OVER_S:
            raise DemoFailed(f"the run goes on beyond its {limit:g} s: {_elapsed(state):.0f} s")
        if lockstep or not state["truth"].get("success"):
            succeeded = 0.0
        elif not succeeded:
            succeeded = state["clock"]
        return not state["state_is"]["going"] or bool(succeeded and state["clock"] - succeeded >= _REST_S)

    for resumed in range(_RESUMES + 1):
        state = page.wait_with_progress(over, "running", lambda now: (progress_marker(now), _elapsed(now)))
        if not state["state_is"]["held"] or resumed == _RESUMES:
            break
        page.command("resume", trial)
        page.wait_with_progress(lambda now: not now["state_is"]["held"], "resuming", progress_marker)
    if state["state_is"]["run_open"]:
        page.command("stop")
    page.wait_with_progress(lambda now: not now["state_is"]["run_open"], "stopping", progress_marker)
    return resumed


def score_by_truth(visitor: RestClient, trial: int) -> Mapping[str, Any]:
    """Score the milestones, with times, by the bench's ground truth, when truth and recording of the trial
    are available.
    """
    wait_until(
        lambda: visitor.get(f"trials/{trial}"),
        lambda found: found["status"] in ("ended", "interrupted") and found["truth"] is not None,
        "waiting for the end of the trial and the bench's truth",
    )
    wait_for_recorded(visitor, trial)
    remarks = {"note": "scored from the bench's truth", "source": "truth"}
    content = {"milestones": {}, "uuid": str(uuid4()), **remarks}
    scored: Mapping[str, Any] = wait_until(
        lambda: visitor.post(f"trials/{trial}/score", content), lambda found: True, "scoring"
    )
    return scored


def wait_for_recorded(visitor: RestClient, trial: int) -> Mapping[str, Any]:
    """Wait for the duration of the trial's recording, then return the trial with that duration."""
    uuid = visitor.get(f"trials/{trial}")["episode"]
    episode = _worked_on(visitor, uuid, ("duration_s",), "waiting for the recording")
    return wait_for_recording(visitor, trial, episode)


def _published(visitor: RestClient, episode: str) -> Mapping[str, Any]:
    return _worked_on(visitor, episode, ("dataset_index", "duration_s"), "waiting for the dataset")


def _worked_on(visitor: RestClient, uuid: str, facts: Sequence[str], label: str) -> Mapping[str, Any]:
    """Return the episode as soon as all its fields named in `facts` are known.

    Any activity of the worker counts as progress.

    Raises:
        DemoFailed: If there is no progress, or the episode's publication fails.
    """

    def ask() -> tuple[Mapping[str, Any], Sequence[Mapping[str, Any]]]:
        return visitor.get(f"episodes/{uuid}"), visitor.get("jobs?limit=50")["items"]

    def known(found: tuple[Mapping[str, Any], Sequence[Mapping[str, Any]]]) -> bool:
        for job in found[1]:
            if job["key"] == f"publish:{uuid}" and job["status"] == "failed":
                raise DemoFailed(f"{label}: job {job['key']} has failed: {job['error']}")
        return all(found[0][name] is not None for name in facts)

    return wait_until(ask, known, label)[0]


def wait_for_recording(visitor: RestClient, trial: int, episode: Mapping[str, Any]) -> Mapping[str, Any]:
    """Wait until the trial's duration is the exact one of its recording, and return the trial.

    Until then the duration is computed from the events of the run.
    """
    recorded: Mapping[str, Any] = wait_until(
        lambda: visitor.get(f"trials/{trial}"),
        lambda facts: facts["duration_s"] == episode["duration_s"],
        "waiting for the exact duration",
    )
    return recorded
