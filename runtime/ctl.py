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
    given = parse(sys.argv[1:] if words is None else words)
    client = StationClient(Path(given.data_dir).expanduser().absolute() / "stations" / given.station)
    try:
        return _run_command(client, given)
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


def _run_command(client: StationClient, given: argparse.Namespace) -> int:
    if given.command in _OWN_WAYS:
        return _OWN_WAYS[given.command](client, given)
    if given.command in LASTING:
        return _follow(client, given)
    return _run_and_wait(client, given, given.command, arguments(given))


# --- commands that go on, and commands within a run ----------------------------------------------------------


def _follow(client: StationClient, given: argparse.Namespace) -> int:
    status = follow_command(client, given.command, arguments(given), _silent if given.json else _print)
    _show(status, given.json)
    return _outcome("" if status["state_is"]["ready"] else f"{status['state']}, {status['reason']}")


def _run_and_wait(
    client: StationClient, given: argparse.Namespace, kind: str, said: dict[str, Any], wants: str = ""
) -> int:
    """Send one command and return the exit code; with --wait, wait until the command has ended.

    `wants` is the event without which the command has failed, "" if none is needed.
    """
    before = client.status()
    client.command(kind, **said)
    if not getattr(given, "wait", False):
        _show(client.status(), given.json)
        return DONE
    settled = wait_until_settled(client, before, _silent if given.json else _print_event)
    _show(settled.status, given.json)
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


def _silent(what: object) -> None:
    """Ignore an event: a program that reads the output needs only the outcome."""


def _show(status: dict[str, Any], as_json: bool) -> None:
    print(json.dumps(status, default=str) if as_json else status_line(status), flush=True)


# --- commands with ways of their own -------------------------------------------------------------------------


def _setup(client: StationClient, given: argparse.Namespace) -> int:
    if not given.cancel:
        return _follow(client, given)
    status = client.status()
    if not status["state_is"]["preparing"]:  # else it would stop a run
        raise Refused(f"there is no set-up to cancel: the station is {status['state']}")
    return _run_and_wait(client, given, "stop", {})


def _run(client: StationClient, given: argparse.Namespace) -> int:
    collect = client.status()["collect"] if given.arm else None
    if given.arm and not (collect and collect["armed"]):
        client.command("arm")
    return _follow(client, given)


def _approach(client: StationClient, given: argparse.Namespace) -> int:
    if client.status()["state_is"]["going"]:
        return _run_and_wait(client, given, "approach", {}, "motion_done")
    return _follow(client, given)


def _move(client: StationClient, given: argparse.Namespace) -> int:
    return _run_and_wait(
        client, given, "move", aim_text.aim_arguments(client, given) | _speed(given), "motion_done"
    )


def _jog(client: StationClient, given: argparse.Namespace) -> int:
    """Show the result of an aim, and move there: exactly to the joints that were shown.

    Raises: Refused if they are not the requested pose, unless --nearest is given.
    """
    aim = client.query("aim", **aim_text.aim_arguments(client, given)).data
    _show_aim(client, aim, given)
    short = aim_text.aim_problem(aim)
    if short and not given.nearest:
        raise Refused(f"it cannot go there: {short}; allowed: a smaller step, or --nearest")
    return _run_and_wait(client, given, "move", {"joints": aim["joints"]} | _speed(given), "motion_done")


def _aim(client: StationClient, given: argparse.Namespace) -> int:
    aim = client.query("aim", **aim_text.aim_arguments(client, given)).data
    _show_aim(client, aim, given)
    return FAILED if aim_text.aim_problem(aim) else DONE


def _speed(given: argparse.Namespace) -> dict[str, float]:
    return {} if given.speed is None else {"speed": given.speed}


def _show_aim(client: StationClient, aim: Any, given: argparse.Namespace) -> None:
    if given.json:
        print(json.dumps(dict(aim)), flush=True)
        return
    names = client.status()["facts"]["joint_names"]
    commanded = client.query("aim").data["joints"]
    speed = getattr(given, "speed", None) or 1.0
    print("\n".join(aim_text.aim_lines(aim, commanded, names, speed)), flush=True)


def _tune(client: StationClient, given: argparse.Namespace) -> int:
    said = arguments(given)
    if said:
        client.command("tune", **said)
    status = client.status()
    if given.json:
        print(json.dumps({"strategy": status["tuning"], "task": status["task"]}))
    else:
        print("\n  ".join(tuning_lines(status, everything=given.show)))
        print(f"task: {status['task'] or 'none'}")
    return DONE


def _record(client: StationClient, given: argparse.Namespace) -> int:
    return _run_and_wait(client, given, f"record_{given.what}", {})


def _release(client: StationClient, given: argparse.Namespace) -> int:
    client.command("release")
    _show(client.wait(lambda status: not status["state_is"]["latched"], _RELEASE_S), given.json)
    return DONE


def _estop(client: StationClient, given: argparse.Namespace) -> int:
    ack = client.estop(given.why)
    print(
        json.dumps({"status": ack.status, "reason": ack.reason})
        if given.json
        else f"{ack.status}: {ack.reason}"
    )
    return DONE if ack.status == "done" else FAILED


def _status(client: StationClient, given: argparse.Namespace) -> int:
    status = client.status()
    told = (
        json.dumps(status, indent=1, default=str)
        if given.json
        else "\n".join(status_report(status, client.holder))
    )
    print(told)
    return DONE


def _wait(client: StationClient, given: argparse.Namespace) -> int:
    status = client.wait(lambda status: given.what in (status["state"], status["phase"]), given.timeout)
    _show(status, given.json)
    return DONE


def _watch(client: StationClient, given: argparse.Namespace) -> int:
    return watch.watch(client, given.json)


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
