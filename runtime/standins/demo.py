"""`python -m runtime.standins.demo`: a station on this machine with a simulated node and a stand-in policy server."""

from __future__ import annotations

import argparse
import json
import signal
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from types import FrameType
from typing import Any

from robots.broken_pipe import exit_on_broken_pipe
from runtime.clients.headless import RESULT_NAME
from runtime.config import loader as deployment
from runtime.core.errors import RuntimeFault, SetupError

_DEPLOYMENT = Path(__file__).parents[2] / "deployments" / "demo.toml"


class StandIns:
    """Child processes of the demo: node and policy server.

    They end when their standard input closes, and therefore also when the demo ends in any way.
    """

    def __init__(self) -> None:
        self._children: list[subprocess.Popen[str]] = []

    def start(self, module: str, *arguments: str) -> dict[str, Any]:
        """Start `python -m module`; return its addresses from the first line of its output.

        Raises:
            SetupError: If the process ends before it is ready.
        """
        child = subprocess.Popen(
            [sys.executable, "-m", module, *arguments, "--lifeline"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )
        self._children.append(child)
        assert child.stdout is not None
        first = child.stdout.readline()
        if not first:
            raise SetupError(f"{module} ended with {child.wait()} before it was ready")
        ready: dict[str, Any] = json.loads(first)
        return ready

    def end(self) -> None:
        """Close the lifelines and wait; processes that do not end within 5 s are killed."""
        for child in self._children:
            assert child.stdin is not None
            child.stdin.close()
        for child in self._children:
            try:
                child.wait(5)
            except subprocess.TimeoutExpired:
                child.kill()
                child.wait()


@exit_on_broken_pipe
def main(arguments: Sequence[str] | None = None) -> int:
    """Run the demo; return the run's exit code, 0 if it was successful; 1 after an error, 130 after Ctrl-C."""
    parser = argparse.ArgumentParser(prog="python -m runtime.standins.demo", description=__doc__)
    parser.add_argument("--once", action="store_true", help="one episode, then end; else until Ctrl-C")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures of the run there")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", dest="assignments")
    options = parser.parse_args(arguments)
    signal.signal(signal.SIGTERM, _interrupt)
    standins = StandIns()
    try:
        return _demo(standins, options)
    except RuntimeFault as fault:
        print(f"error: {fault}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        return 130
    finally:
        standins.end()


def _interrupt(number: int, frame: FrameType | None) -> None:
    raise KeyboardInterrupt


def start_standins(standins: StandIns, robot: str) -> list[str]:
    """Start node and policy server on free ports; return the settings that connect a deployment to them."""
    free = "tcp://127.0.0.1:0"
    node = standins.start(
        "runtime.simulation.node", "--robot", robot, "--obs-endpoint", free, "--action-endpoint", free
    )
    server = standins.start(
        "runtime.standins.serve", "openpi", "--robot", robot, "--port", "0", "--latency-ms", "80"
    )
    print(f"execution node   {node['obs_endpoint']}  {node['action_endpoint']}")
    print(f"policy server    {server['url']}", flush=True)
    return [
        f'transport.sub_endpoint="{node["obs_endpoint"]}"',
        f'transport.pub_endpoint="{node["action_endpoint"]}"',
        f'policy.url="{server["url"]}"',
    ]


def run_station(option: str, assignments: Sequence[str]) -> tuple[int, dict[str, Any]]:
    """Run the demo's supervisor until it ends; return its exit code and the run's result, {} if it wrote no result.

    Ctrl-C is passed on to the supervisor, and raised again after that has ended.
    """
    result = deployment.load(_DEPLOYMENT, assignments).deployment.station_dir / RESULT_NAME
    result.unlink(missing_ok=True)
    sets = [part for assignment in assignments for part in ("--set", assignment)]
    child = subprocess.Popen(
        [sys.executable, "-m", "runtime", str(_DEPLOYMENT), *([option] if option else []), *sets],
        start_new_session=True,
    )
    try:
        code = child.wait()
    except KeyboardInterrupt:
        child.send_signal(signal.SIGINT)
        child.wait()
        raise
    outcome: dict[str, Any] = json.loads(result.read_text("utf-8")) if result.exists() else {}
    return code, outcome


def _demo(standins: StandIns, options: argparse.Namespace) -> int:
    settings = deployment.load(_DEPLOYMENT, options.assignments).deployment
    assignments = [*start_standins(standins, settings.robot), *options.assignments]
    code, result = run_station("--headless", assignments)
    if options.json:
        options.json.write_text(json.dumps(result or {"error": "no result"}, indent=1), "utf-8")
    if code == 0 and not options.once:
        ctl = f".venv/bin/python -m runtime.ctl --data-dir {settings.data} {settings.station}"
        print("\nThe station stays up; Ctrl-C here ends everything. Command it from a second terminal:")
        print(
            f"  {ctl} watch\n  {ctl} setup   (run, stop, halt, resume, home, estop, release, status)\n",
            flush=True,
        )
        run_station("", assignments)
    return code


if __name__ == "__main__":
    sys.exit(main())
