"""Headless driver of a station, which works without a person: set-up, one run, stop, publication, report."""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from robots.broken_pipe import exit_on_broken_pipe
from runtime.clients.client import StationClient
from runtime.clients.terminal.status_text import format_figure, status_line
from runtime.config import loader
from runtime.config.schema import Deployment
from runtime.core import logs as log
from runtime.core.errors import RuntimeFault, SetupError

_START_S = 30.0
_SETUP_S = 240.0
_CLOSE_S = 30.0
_SHOWN_EVERY_S = 2.0
_POLL_S = 0.05
MODES = ("continuous", "sim")  # all other modes need a person
# Events of no interest without a person who commands; changes of state are printed anyway.
_SILENT = frozenset(
    {"command", "setup", "tuned", "locked", "motion_done", "episode_opened", "episode_closed"}
)
RESULT_NAME = "headless.json"


def run_headless(settings: Deployment, client: StationClient) -> dict[str, Any]:
    """Execute one run from start to publication.

    Returns:
        The result: end of the run, episode, figures, and paths of exports and dataset.

    Raises:
        RuntimeFault: Any step failed, or the run did not end well; the message is the reason.
    """
    check(settings)
    attended = LeasedStation(client)
    attended.begin()
    status = attended.run()
    how, well = status["reason"], status["state_is"]["ready"]
    if status["state_is"]["held"]:
        client.command("stop")
    try:
        status = attended.wait_until_closed()
        result = _result(status, how, attended.seconds)
        well = well and status["last_run"].get("status", "finished") == "finished"
        if result["episode_path"]:
            result |= _export_and_publish(settings, Path(result["episode_path"]), well)
    except RuntimeFault as fault:  # report this fault together with the reason of the run's end
        raise RuntimeFault(f"the run ended ({how}), but then: {fault}") from None
    print("\n".join(summary(result)), flush=True)
    if not well:
        raise RuntimeFault(f"the run did not end well: {how}; episode: {result['episode_path'] or 'none'}")
    return result


def check(settings: Deployment) -> None:
    """Raise SetupError if the mode of the run needs a person."""
    mode, station = settings.run.mode, settings.station
    if mode not in MODES:
        raise SetupError(
            f"run.mode = {mode!r} needs a person; headless: {', '.join(MODES)}. Start the station without "
            f"--headless, then python -m runtime.ctl {station} run --mode {mode}"
        )


class LeasedStation:
    """Station under a lease that is renewed at each poll; its events are printed as they arrive."""

    def __init__(self, client: StationClient) -> None:
        self._client = client
        self._boot = ""
        self._heard = 0  # number of the newest event
        self._shown = -math.inf
        self.opened = self.closed = False  # whether an episode was opened and closed in this session
        self.seconds = 0.0  # duration of the run at the last poll [s]

    def begin(self) -> None:
        """Wait for the station, claim its lease and set it up. Raises: RuntimeFault if it does not become ready."""
        self._wait_for_start()
        self._client.claim()
        self.wait_for(lambda s: s["state_is"]["connected"], _START_S, "the first observation")
        self._client.command("setup")
        status = self.wait_for(lambda s: not s["state_is"]["preparing"], _SETUP_S, "set-up")
        if not status["state_is"]["ready"]:
            raise RuntimeFault(f"set-up failed: {status['reason']}")

    def run(self) -> dict[str, Any]:
        """Start a run and wait for its end, successful or not; return the station's status after the end."""
        self._client.command("run")
        return self.wait_for(lambda s: not s["state_is"]["going"], math.inf, "the end of the run")

    def wait_until_closed(self) -> dict[str, Any]:
        """Wait until the recording, if there is one, is on disk; return the station's status after that."""
        status = self.poll_status()
        if self.opened:
            status = self.wait_for(lambda _: self.closed, _CLOSE_S, "the end of the recording")
        return status

    def wait_for(
        self, reached: Callable[[dict[str, Any]], bool], seconds: float, what: str
    ) -> dict[str, Any]:
        """Poll until `reached` returns True for the status, and return the status.

        A status line is printed now and then. Raises: RuntimeFault, which names `what`, after `seconds` [s].
        """
        deadline = time.monotonic() + seconds
        while not reached(status := self.poll_status()):
            if time.monotonic() > deadline:
                raise RuntimeFault(f"{what}: not within {seconds:g} s; {status['state']}: {status['reason']}")
            if time.monotonic() - self._shown >= _SHOWN_EVERY_S:
                self._shown = time.monotonic()
                print(status_line(status), flush=True)
            time.sleep(_POLL_S)
        return status

    def poll_status(self) -> dict[str, Any]:
        """Renew the lease, print new events and return the status."""
        self._client.renew()
        status = self._client.status()
        if status["boot"] != self._boot:  # a restarted coordinator numbers its events from 1
            self._boot, self._heard = status["boot"], 0
        if status["newest_event"] > self._heard:
            for event in self._client.events_since(self._heard):
                self._on_event(event)
        if status["run"]["number"]:
            self.seconds = status["run"]["elapsed"]
        return status

    def _on_event(self, event: dict[str, Any]) -> None:
        self._heard = event["number"]
        self.opened |= event["kind"] == "episode_opened"
        self.closed |= event["kind"] == "episode_closed"
        if event["kind"] not in _SILENT:
            print(f"  {event['kind']}: {event['text']}", flush=True)

    def _wait_for_start(self) -> None:
        deadline = time.monotonic() + _START_S
        while True:
            try:
                self._client.status()
            except RuntimeFault:
                if time.monotonic() > deadline:
                    raise
                time.sleep(0.1)
            else:
                return


def _result(status: dict[str, Any], how: str, seconds: float) -> dict[str, Any]:
    episode = status["episode"]
    path = episode.get("path", "")
    result = {
        "ended": how,
        "run_seconds": seconds,
        "episode_path": path,
        "episode_status": episode.get("status", ""),
        "frames": episode.get("rows", 0),
        "control": status["control"],
        "policy": status["policy"],
        "link": status["link"],
    }
    return result | (_episode_figures(Path(path)) if path else {})


def _episode_figures(path: Path) -> dict[str, Any]:
    """Return figures from the episode's files: duration [s], and numbers of refused and limited ticks."""
    from runtime.recording.reader import open_episode

    episode = open_episode(path)
    refused = episode.ticks["refused"].to_pylist()
    changes = episode.ticks["changes"].to_pylist()
    limited = sum(bool(changed) and not no for changed, no in zip(changes, refused, strict=True))
    return {
        "duration_s": episode.frames / episode.layout.fps,
        "safety": {"ticks": len(refused), "refused": sum(refused), "limited": limited},
    }


def _export_and_publish(settings: Deployment, episode: Path, well: bool) -> dict[str, Any]:
    """Export the streams of any run; publish a run that ended well, unless it was simulated. Raises: RuntimeFault."""
    from runtime.recording.export import write_export

    result: dict[str, Any] = {"export_path": str(write_export(episode, settings.data))}
    if well and settings.publish.dataset and settings.run.mode != "sim":
        result |= _publish(settings, episode)
    return result


def _publish(settings: Deployment, episode: Path) -> dict[str, Any]:
    from runtime.datasets.publishing import publish

    dataset = settings.data / str(settings.publish.dataset)
    published = publish(episode, dataset, version=settings.publish.version)
    return {
        "dataset_path": str(published.dataset),
        "episode_index": published.episode_index,
        "published_frames": published.frames,
    }


def summary(result: dict[str, Any]) -> list[str]:
    """Return the summary of a run for the operator, as lines."""
    policy, control = result["policy"], result["control"]
    rows = [("ended", f"{result['ended']}, after {result['run_seconds']:.1f} s")]
    if "duration_s" in result:
        recorded = f"{result['frames']} rows, {result['duration_s']:.1f} s, {result['episode_status']}"
        rows.append(("recorded", recorded))
    if policy["answers"]:
        latency = f"p50 {policy['latency_p50_ms']:.0f} ms, p90 {policy['latency_p90_ms']:.0f} ms"
        delay = (
            f"delay {format_figure(policy['delay_p50'])} ticks, at most {format_figure(policy['delay_max'])}"
        )
        rows.append(("policy", f"{latency}, {delay}"))
    late = f"ticks late by p99 {control['lateness_p99_ms']:.2f} ms, {control['missed']} missed"
    rows.append(("control", f"{control['rate']:g} Hz, {late}"))
    if "safety" in result:
        safety = result["safety"]
        ticks = f"{safety['refused']} of {safety['ticks']} ticks refused, {safety['limited']} limited"
        rows.append(("safety", ticks))
    rows.append(("episode", result["episode_path"] or "none"))
    if "export_path" in result:
        rows.append(("streams", result["export_path"]))
    if "dataset_path" in result:
        place = f"episode {result['episode_index']}, {result['published_frames']} frames"
        rows.append(("dataset", f"{result['dataset_path']}  {place}"))
    return ["", "How it went", *(f"  {name:<9} {text}" for name, text in rows)]


@exit_on_broken_pipe
def main() -> int:
    """Run headless and write the result into the station's folder; return 0 if all went well, else 1."""
    parser = argparse.ArgumentParser(prog="runtime.clients.headless", description="started by the supervisor")
    parser.add_argument("--resolved", required=True)
    parser.add_argument("--boot", required=True)
    options = parser.parse_args()
    log.configure_logging("headless")
    settings = loader.resolve_deployment(
        json.loads(Path(options.resolved).read_text("utf-8")), {}, options.resolved
    ).deployment
    station_dir = settings.station_dir
    client = StationClient(station_dir, holder=f"headless:{options.boot}")
    try:
        result = run_headless(settings, client)
    except RuntimeFault as fault:
        print(f"error: {fault}", file=sys.stderr)
        (station_dir / RESULT_NAME).write_text(json.dumps({"error": str(fault)}), "utf-8")
        return 1
    finally:
        client.close()
    (station_dir / RESULT_NAME).write_text(json.dumps(result, indent=1), "utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
