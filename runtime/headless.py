"""Drives a station without anybody at it: set up, one run, stop, publish, report."""

from __future__ import annotations

import json
import logging
import math
import sys
import time
from pathlib import Path
from typing import Any

from runtime.client import StationClient
from runtime.ctl import line
from runtime.errors import RuntimeFault
from runtime.family import Plan, join

log = logging.getLogger(__name__)
_START_S = 30.0
_SETUP_S = 240.0
_CLOSE_S = 30.0
RESULT_NAME = "headless.json"


def drive(plan: Plan, client: StationClient) -> dict[str, Any]:
    """One run from start to published dataset; returns what came of it. Raises RuntimeFault with the reason."""
    _wait_for_start(client)
    client.claim()
    status = client.wait(lambda s: s["state"] != "disconnected", _START_S)
    client.command("setup")
    status = _follow(client, "setting_up", _SETUP_S)
    if status["state"] != "ready":
        raise RuntimeFault(f"set-up failed: {status['reason']}")
    print(f"set up: {status['validated']}", flush=True)
    client.command("run")
    status = _follow(client, "running", math.inf)
    how = status["reason"]
    failed = status["state"] != "ready"
    if status["state"] == "holding":
        client.command("stop")
    status = client.wait(lambda s: _closed(plan, s), _CLOSE_S)
    result = _result(status, how)
    if failed:
        raise RuntimeFault(f"the run did not end well: {how}; episode: {result['episode_path'] or 'none'}")
    if plan.deployment.publish.dataset and result["episode_path"]:
        result |= _publish(plan, Path(result["episode_path"]))
    return result


def _wait_for_start(client: StationClient) -> None:
    deadline = time.monotonic() + _START_S
    while True:
        try:
            client.status()
        except RuntimeFault:
            if time.monotonic() > deadline:
                raise
            time.sleep(0.1)
        else:
            return


def _follow(client: StationClient, state: str, timeout: float) -> dict[str, Any]:
    """Print live figures while the station is in `state`; the lease is kept."""
    deadline, shown = time.monotonic() + timeout, 0.0
    while (status := client.status())["state"] == state:
        client.renew()
        if time.monotonic() - shown >= 1.0:
            shown = time.monotonic()
            print(line(status), flush=True)
        if time.monotonic() > deadline:
            raise RuntimeFault(f"still {state} after {timeout:g} s: {status['reason']}")
        time.sleep(0.05)
    return status


def _closed(plan: Plan, status: dict[str, Any]) -> bool:
    return not plan.deployment.recording.enabled or (
        bool(status["episode"]) and not status["recording"]["uuid"]
    )


def _result(status: dict[str, Any], how: str) -> dict[str, Any]:
    episode = status["episode"]
    return {
        "ended": how,
        "episode_path": episode.get("path", ""),
        "episode_status": episode.get("status", ""),
        "frames": episode.get("rows", 0),
        "control": status["control"],
        "policy": status["policy"],
        "link": status["link"],
    }


def _publish(plan: Plan, episode: Path) -> dict[str, Any]:
    from runtime.datasets.published import publish

    dataset = plan.deployment.data / str(plan.deployment.publish.dataset)
    published = publish(episode, dataset)
    return {
        "dataset_path": str(published.dataset),
        "episode_index": published.episode_index,
        "published_frames": published.frames,
    }


def main() -> int:
    """Drive, print, leave the result in the station's folder; exit code 0 where all went well."""
    member = join("headless")
    station_dir = member.plan.deployment.station_dir
    client = StationClient(station_dir, holder=f"headless:{member.boot}")
    try:
        result = drive(member.plan, client)
    except RuntimeFault as fault:
        print(f"error: {fault}", file=sys.stderr)
        (station_dir / RESULT_NAME).write_text(json.dumps({"error": str(fault)}), "utf-8")
        return 1
    finally:
        client.close()
    (station_dir / RESULT_NAME).write_text(json.dumps(result, indent=1), "utf-8")
    print(f"episode  {result['episode_path']}  {result['frames']} rows, {result['episode_status']}")
    if "dataset_path" in result:
        print(f"dataset  {result['dataset_path']}  episode {result['episode_index']}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
