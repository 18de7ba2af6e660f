"""`python -m runtime DEPLOYMENT`: check a deployment, run it in lockstep, or start the processes of a station.

`--from-run UUID` uses the deployment in the manifest of an earlier run instead of a file.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from robots.broken_pipe import exit_on_broken_pipe
from runtime.config import loader
from runtime.config.loader import Resolved
from runtime.core import environment
from runtime.core import logs as log
from runtime.core.clock import MonotonicClock
from runtime.core.errors import ConfigurationError, RuntimeFault, SetupError
from runtime.ipc.lifeline import Lifeline
from runtime.processes.coordinator.builders import make_policy
from runtime.processes.supervisor.supervisor import Supervisor
from runtime.station.checks import check_deployment
from runtime.station.rerun import data_folder, rerun
from runtime.station.spec import StationSpec

if TYPE_CHECKING:
    from runtime.processes.lockstep.lockstep import Peers


@exit_on_broken_pipe
def main(arguments: Sequence[str] | None = None) -> int:
    """Run as the command line demands; return 0 on success, 1 if the run failed, 2 if the deployment is invalid."""
    options = _parser().parse_args(arguments)
    log.configure_logging("supervisor")
    try:
        spec = check_deployment(_resolved(options))
        # What does not fit it is said here, not by a coordinator that dies.
        make_policy(spec, MonotonicClock()).close()
        _require_encoder(spec)
        if options.headless:
            from runtime.clients import headless

            headless.check(spec.deployment)
        if options.lockstep:
            from runtime.processes.lockstep import lockstep

            lockstep.check(spec)
    except RuntimeFault as fault:
        print(fault, file=sys.stderr)
        return 2
    try:
        if options.check:
            return _check(spec)
        if options.lockstep:
            return run_in_lockstep(spec)
        if spec.deployment.lockstep.benchmark:
            raise SetupError(
                "lockstep.benchmark = true: a station in real time does not wait for its policy; allowed: "
                "python -m runtime.standins.lockstep, or lockstep.benchmark = false"
            )
        return Supervisor(spec, Lifeline() if options.lifeline else None).run(options.headless)
    except RuntimeFault as fault:
        print(f"error: {fault}", file=sys.stderr)
        return 1


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m runtime", description=__doc__)
    parser.add_argument("deployment", type=Path, nargs="?", help="a TOML file; deployments/ has examples")
    parser.add_argument(
        "--from-run",
        metavar="UUID",
        help="the deployment of that run in its place; how its uuid begins will do",
    )
    parser.add_argument(
        "--data-dir",
        type=Path,
        metavar="DIR",
        help="where that run lies; $EVA_DATA_DIR or ./data if not given",
    )
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", dest="assignments")
    parser.add_argument("--lifeline", action="store_true", help="end when standard input ends")
    how = parser.add_mutually_exclusive_group()
    how.add_argument(
        "--check", action="store_true", help="print the resolved deployment and its hash, start nothing"
    )
    how.add_argument("--lockstep", action="store_true", help="one process on a virtual clock")
    how.add_argument(
        "--headless", action="store_true", help="set up, run once, publish, end; holds the lease itself"
    )
    return parser


def _resolved(options: argparse.Namespace) -> Resolved:
    """Return the deployment from the file, or from an earlier run.

    If the deployment is that of an earlier run, the differences from this run are printed.

    Raises: ConfigurationError.
    """
    if (options.deployment is None) == (options.from_run is None):
        raise ConfigurationError("give one of the two: a deployment file, or --from-run UUID")
    if options.from_run is None and options.data_dir is not None:
        raise ConfigurationError("--data-dir belongs to --from-run; for a file it is --set data_dir=DIR")
    if options.from_run is None:
        return loader.load(options.deployment, options.assignments)
    repeated = rerun(options.from_run, data_folder(options.data_dir), options.assignments)
    print(*repeated.lines, sep="\n", flush=True)
    return repeated.resolved


def _require_encoder(spec: StationSpec) -> None:
    """Raise ConfigurationError if the encoder of the recording is missing, before the first run would need it."""
    from runtime.recording import encoder_check

    if spec.deployment.recording.enabled:
        encoder_check.require_encoder(spec.deployment.recording)


def _check(spec: StationSpec) -> int:
    print(json.dumps(dict(spec.resolved.tree), indent=1))
    print(f"hash {spec.resolved.digest}")
    robot = spec.robot
    counts = f"{robot.dim} joints, {len(robot.cameras)} cameras"
    print(f"ok: {robot.name}, {counts}, {spec.rate:g} Hz, {spec.fps:g} fps")
    return 0


def run_in_lockstep(made: StationSpec, peers: Peers | None = None) -> int:
    """Run in lockstep, print the result, export the episode and publish it if the run succeeded; return the exit code.

    `peers` are those of `Lockstep`.
    """
    from runtime.ipc.session_state import SessionState
    from runtime.processes.lockstep import lockstep

    result = lockstep.run(made, peers=peers)
    episode = result.episode
    print(f"{result.state}: {result.reason}")
    print(
        f"episode  {episode.get('path', 'none')}  {episode.get('rows', 0)} rows, {episode.get('status', '')}"
    )
    if episode:
        from runtime.recording.export import write_export

        print(f"export   {write_export(Path(episode['path']), made.deployment.data)}")
    # A run that held was ended by nobody's judgement: it is kept, but neither published nor a success.
    well = result.state is SessionState.READY and episode.get("status", "finished") == "finished"
    into = made.deployment.publish
    if well and into.dataset and episode and made.deployment.run.mode != "sim":
        from runtime.datasets.publishing import publish

        published = publish(Path(episode["path"]), made.deployment.data / into.dataset, version=into.version)
        print(f"dataset  {published.dataset}  episode {published.episode_index}, {published.frames} frames")
    return 0 if well else 1


if __name__ == "__main__":
    environment.restart_without_web_secrets()
    sys.exit(main())
