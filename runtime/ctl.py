"""`python -m runtime.ctl STATION COMMAND`: command and observe a station from a terminal."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from robots.broken_pipe import exit_on_broken_pipe
from runtime.clients.client import Refused, StationClient
from runtime.clients.terminal import aim_text, watch
from runtime.clients.terminal.arguments import arguments
from runtime.clients.terminal.command_follower import LASTING, follow_command
from runtime.clients.terminal.status_text import status_line, status_report, tuning_lines
from runtime.clients.terminal.syntax import parse
from runtime.clients.terminal.wait_settled import wait_until_settled
from runtime.core.errors import RuntimeFault, TransportError

DONE, FAILED, UNKNOWN, INTERRUPTED = 0, 1, 3, 130  # exit codes; 2 is argparse's, 141 that of broken_pipe
_RELEASE_S = 2.0


@exit_on_broken_pipe
def main(words: Sequence[str] | None = None) -> int:
    """Run one command.

    Return 0 on success, 1 if the command was refused or failed, 3 if there was no answer, 141 if the output is no
    longer read.
    """
    options = parse(sys.argv[1:] if words is None else words)
    client = StationClient(Path(options.data_dir).expanduser().absolute() / "stations" / options.station)
    try:
        return _run_command(client, options)
    except Refused as refusal:
        print(f"refused: {refusal}", file=sys.stderr)
    except TransportError as fault:
        print(f"error: {fault}", file=sys.stderr)
        return UNKNOWN
    except RuntimeFault as fault:
        print(f"error: {fault}", file=sys.stderr)
    except KeyboardInterrupt:
        return INTERRUPTED
    finally:
        client.close()
    return FAILED


def _run_command(client: StationClient, options: argparse.Namespace) -> int:
    if options.command in _OWN_WAYS:
        return _OWN_WAYS[options.command](client, options)
    if options.command in LASTING:
        return _follow(client, options)
    return _run_and_wait(client, options, options.command, arguments(options))


# --- commands that go on, and commands within a run ----------------------------------------------------------


def _follow(client: StationClient, options: argparse.Namespace) -> int:
    status = follow_command(client, options.command, arguments(options), _silent if options.json else _print)
    _show(status, options.json)
    return _outcome("" if status["state_is"]["ready"] else f"{status['state']}, {status['reason']}")


def _run_and_wait(
    client: StationClient, options: argparse.Namespace, kind: str, fields: dict[str, Any], wants: str = ""
) -> int:
    """Send one command and return the exit code; with --wait, wait until the command has ended.

    `wants` is the event without which the command has failed, "" if none is needed.
    """
    before = client.status()
    client.command(kind, **fields)
    if not getattr(options, "wait", False):
        _show(client.status(), options.json)
        return DONE
    settled = wait_until_settled(client, before, _silent if options.json else _print_event)
    _show(settled.status, options.json)
    return _outcome(settled.failure(wants))


def _outcome(failure: str) -> int:
    if failure:
        print(f"failed: {failure}", file=sys.stderr)
    return FAILED if failure else DONE


def _print(text: str) -> None:
    print(text, flush=True)


def _print_event(event: dict[str, Any]) -> None:
    if event["kind"] != "command":  # the one that was just given
        watch.print_event(event)


def _silent(value: object) -> None:
    """Ignore an event: a program that reads the output needs only the outcome."""


def _show(status: dict[str, Any], as_json: bool) -> None:
    print(json.dumps(status, default=str) if as_json else status_line(status), flush=True)


# --- commands with ways of their own -------------------------------------------------------------------------


def _setup(client: StationClient, options: argparse.Namespace) -> int:
    if not options.cancel:
        return _follow(client, options)
    status = client.status()
    if not status["state_is"]["preparing"]:  # else it would stop a run
        raise Refused(f"there is no set-up to cancel: the station is {status['state']}")
    return _run_and_wait(client, options, "stop", {})


def _run(client: StationClient, options: argparse.Namespace) -> int:
    collect = client.status()["collect"] if options.arm else None
    if options.arm and not (collect and collect["armed"]):
        client.command("arm")
    return _follow(client, options)


def _approach(client: StationClient, options: argparse.Namespace) -> int:
    if client.status()["state_is"]["going"]:
        return _run_and_wait(client, options, "approach", {}, "motion_done")
    return _follow(client, options)


def _move(client: StationClient, options: argparse.Namespace) -> int:
    return _run_and_wait(
        client, options, "move", aim_text.aim_arguments(client, options) | _speed(options), "motion_done"
    )


def _jog(client: StationClient, options: argparse.Namespace) -> int:
    """Show the joints to which a jog leads, then move to exactly these joints.

    Raises: Refused if they do not reach the requested pose, unless --nearest is given.
    """
    aim = client.query("aim", **aim_text.aim_arguments(client, options)).data
    _show_aim(client, aim, options)
    short = aim_text.aim_problem(aim)
    if short and not options.nearest:
        raise Refused(f"it cannot go there: {short}; allowed: a smaller step, or --nearest")
    return _run_and_wait(client, options, "move", {"joints": aim["joints"]} | _speed(options), "motion_done")


def _aim(client: StationClient, options: argparse.Namespace) -> int:
    aim = client.query("aim", **aim_text.aim_arguments(client, options)).data
    _show_aim(client, aim, options)
    return FAILED if aim_text.aim_problem(aim) else DONE


def _speed(options: argparse.Namespace) -> dict[str, float]:
    return {} if options.speed is None else {"speed": options.speed}


def _show_aim(client: StationClient, aim: Any, options: argparse.Namespace) -> None:
    if options.json:
        print(json.dumps(dict(aim)), flush=True)
        return
    names = client.status()["facts"]["joint_names"]
    commanded = client.query("aim").data["joints"]
    speed = getattr(options, "speed", None) or 1.0
    print("\n".join(aim_text.aim_lines(aim, commanded, names, speed)), flush=True)


def _tune(client: StationClient, options: argparse.Namespace) -> int:
    fields = arguments(options)
    if fields:
        client.command("tune", **fields)
    status = client.status()
    if options.json:
        print(json.dumps({"strategy": status["tuning"], "task": status["task"]}))
    else:
        print("\n  ".join(tuning_lines(status, everything=options.show)))
        print(f"task: {status['task'] or 'none'}")
    return DONE


def _record(client: StationClient, options: argparse.Namespace) -> int:
    return _run_and_wait(client, options, f"record_{options.what}", {})


def _release(client: StationClient, options: argparse.Namespace) -> int:
    client.command("release")
    _show(client.wait(lambda status: not status["state_is"]["latched"], _RELEASE_S), options.json)
    return DONE


def _estop(client: StationClient, options: argparse.Namespace) -> int:
    ack = client.estop(options.why)
    print(
        json.dumps({"status": ack.status, "reason": ack.reason})
        if options.json
        else f"{ack.status}: {ack.reason}"
    )
    return DONE if ack.status == "done" else FAILED


def _status(client: StationClient, options: argparse.Namespace) -> int:
    status = client.status()
    text = (
        json.dumps(status, indent=1, default=str)
        if options.json
        else "\n".join(status_report(status, client.holder))
    )
    print(text)
    return DONE


def _wait(client: StationClient, options: argparse.Namespace) -> int:
    status = client.wait(lambda status: options.what in (status["state"], status["phase"]), options.timeout)
    _show(status, options.json)
    return DONE


def _watch(client: StationClient, options: argparse.Namespace) -> int:
    return watch.watch(client, options.json)


_OWN_WAYS = {
    "setup": _setup,
    "run": _run,
    "approach": _approach,
    "move": _move,
    "jog": _jog,
    "aim": _aim,
    "tune": _tune,
    "record": _record,
    "release": _release,
    "estop": _estop,
    "status": _status,
    "wait": _wait,
    "watch": _watch,
    "events": watch.list_events,
}


if __name__ == "__main__":
    sys.exit(main())
