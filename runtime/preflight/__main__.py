"""python -m runtime.preflight DEPLOYMENT: query the deployment's policy once without a robot, and report faults.

Nothing is sent to any robot. Exit codes: 0 success, 1 a fault of the policy, 2 an invalid deployment.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import threading
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from robots.broken_pipe import exit_on_broken_pipe
from runtime.config import loader
from runtime.config.loader import Resolved
from runtime.core import environment
from runtime.core import logs as log
from runtime.core.errors import ConfigurationError, RuntimeFault
from runtime.ipc.lifeline import Lifeline
from runtime.policies.websocket_link import wait_closed
from runtime.preflight.report import Report
from runtime.preflight.runner import PreflightRunner
from runtime.preflight.verdict import PreflightStage, PreflightVerdict
from runtime.station.checks import check_deployment
from runtime.station.permissions import require_allowed_references
from runtime.station.preflight_child import default_deadline

_LOOK_S = 0.2
_LONGEST_S = 3600.0
_GOODBYE_S = 1.0
_BACKGROUND_NICE = 5  # stations on the same machine have priority


@exit_on_broken_pipe
def main(arguments: Sequence[str] | None = None) -> int:
    """Run one preflight and print its report."""
    parser = _parser()
    options = parser.parse_args(arguments)
    if options.given == (options.deployment is not None) or (options.given and options.assignments):
        parser.error("give one of the two: a deployment file, or --given")
    if options.given:
        return _for_a_parent()
    report = preflight(lambda: loader.load(options.deployment, options.assignments), options.deadline)
    print(json.dumps(report.to_dict(), indent=1) if options.json else "\n".join(report.lines()))
    return exit_code(report)


def preflight(resolved: Any, deadline: float | None = None) -> Report:
    """Return the report on the deployment that `resolved()` returns.

    Args:
        resolved: Function that returns the resolved deployment; it may raise RuntimeFault.
        deadline: Time for everything [s]; None: the sum of the policy's own deadlines.
    """
    try:
        spec = check_deployment(resolved())
    except RuntimeFault as fault:
        return Report(
            PreflightVerdict.MISCONFIGURED,
            PreflightStage.RESOLVE,
            str(fault),
            PreflightVerdict.MISCONFIGURED.advice,
        )
    return PreflightRunner(spec).run(default_deadline(spec.deployment) if deadline is None else deadline)


def exit_code(report: Report) -> int:
    """Return the exit code for a shell."""
    return 2 if report.verdict is PreflightVerdict.MISCONFIGURED else 0 if report.ok else 1


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m runtime.preflight", description=__doc__)
    parser.add_argument("deployment", type=Path, nargs="?", help="a TOML file; deployments/ has examples")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", dest="assignments")
    parser.add_argument(
        "--deadline",
        type=_seconds,
        metavar="S",
        help="for everything; without it what the policy's own deadlines come to",
    )
    parser.add_argument("--json", action="store_true", help="say it as JSON")
    parser.add_argument(
        "--given", action="store_true", help="for a parent process: see runtime.station.preflight_child"
    )
    return parser


def _seconds(text: str) -> float:
    seconds = float(text)
    if not 0 < seconds <= _LONGEST_S:
        raise argparse.ArgumentTypeError(f"{text} was given; allowed: above 0, at most {_LONGEST_S:g}")
    return seconds


def _for_a_parent() -> int:
    """Run one preflight for a parent process; stop early if standard input closes.

    The request is a line of JSON on standard input, the report a line of JSON on standard output. The request has
    "tree" (a resolved deployment) or "deployment" (path of a file), "changes" (tables merged over the deployment, such
    as a checkpoint's), and "deadline_s" [s] (null: the default).
    """
    os.nice(_BACKGROUND_NICE)
    log.configure_logging("preflight")
    request = json.loads(_line())
    threading.Thread(target=_end_with_parent, name="lifeline", daemon=True).start()
    report = preflight(lambda: _asked_for(request), request.get("deadline_s"))
    print(json.dumps(report.to_dict()), flush=True)
    wait_closed(_GOODBYE_S)
    os._exit(exit_code(report))  # without waiting for a policy's own threads


def _asked_for(request: Mapping[str, Any]) -> Resolved:
    changes = request.get("changes", {})
    if "tree" in request:  # the station has already checked the permissions
        base = loader.resolve_deployment(request["tree"], {}, "the station's deployment")
        return loader.apply_changes(base, changes, "the checkpoint")
    if "deployment" not in request:
        raise ConfigurationError(
            f"preflight: given {', '.join(request) or 'nothing'}; needed: tree or deployment"
        )
    base = loader.load(Path(request["deployment"]))
    resolved = loader.apply_changes(base, changes, "the checkpoint")
    require_allowed_references(base.deployment, resolved.deployment)
    return resolved


def _line() -> bytes:
    """Read the first line of standard input, without consuming further input."""
    line = b""
    while not line.endswith(b"\n"):
        byte = os.read(0, 1)
        if not byte:
            raise SystemExit("preflight --given: standard input ended before its line")
        line += byte
    return line


def _end_with_parent() -> None:
    lifeline = Lifeline()
    while not lifeline.is_cut:
        time.sleep(_LOOK_S)
    os._exit(3)


if __name__ == "__main__":
    environment.restart_without_web_secrets()
    sys.exit(main())
