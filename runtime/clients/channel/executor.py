"""Execution of the scripts' commands, one after the other, and the answers to them."""

from __future__ import annotations

import logging
import time
import uuid
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

from runtime.clients.channel import json_answers
from runtime.clients.channel import status as older
from runtime.clients.channel.message import Message
from runtime.clients.channel.outcomes import Outcome, Outcomes, is_long_running
from runtime.clients.channel.scripts import Script, ScriptActivity, Scripts
from runtime.clients.channel.verb_commands import UnsupportedVerb, VerbContext
from runtime.clients.channel.verbs import VERBS, commands_for_verb
from runtime.clients.client import Refused, StationClient
from runtime.core.errors import RuntimeFault, TransportError
from runtime.ipc.command_arguments import ARGUMENTS

log = logging.getLogger(__name__)
OWN = (*ARGUMENTS, "aim", "estop", "claim", "give_up")
QUERIES = ("status", "config", "frame", "station", "events", "result", "commands")
_APART = (
    '; a script is who it says that it is ("client": NAME); those that do not say it are one holder, or one each '
    'where the deployment says control_channel.scripts = "apart"'
)
_FRAME_S = 0.5
_LOOK_S = 0.1


class CommandExecutor:
    """Executor of the scripts' messages: every command except a stop reaches the coordinator through it.

    One thread uses it.
    """

    def __init__(
        self,
        open_client: Callable[[str], StationClient],
        lives: ScriptActivity,
        outcomes: Outcomes,
        silence_s: float,
        now: Callable[[], float] = time.monotonic,
    ) -> None:
        self._scripts = Scripts(open_client, lives, silence_s)
        self._outcomes = outcomes
        self._now, self._looked = now, 0.0
        self._newest = ""  # reason of the newest refused or failed command

    def answer(self, holder: str, message: Message) -> dict[str, Any]:
        """Execute one message and return its answer; a fault becomes a sentence in the answer."""
        script = self._scripts.get_or_create(holder)
        if message.form == "query":
            return self._run_query(script, message)
        outcome = Outcome(message.id or str(uuid.uuid4()), message.name, "", "done")
        previous = self._outcomes.get(outcome.id)
        if previous is not None and previous.result != "unknown":
            return self._repeated(message, previous, script)
        data: Mapping[str, Any] = {}
        try:
            data = (self._verb if message.form == "cmd" else self._run_command)(script, message, outcome)
        except RuntimeFault as fault:
            self._newest = str(fault)
            outcome.resolve("unknown" if isinstance(fault, TransportError) else "refused", self._newest)
        self._outcomes.add(outcome)
        if message.name == "select_collect_task" and outcome.result == "done":
            return {"ok": True, **data}  # the older channel's form of this answer
        special = dict(data) if message.name == "tab_switch" else {}
        return json_answers.command_answer(message, outcome, data, self._state(script, outcome)) | special

    def _repeated(self, message: Message, previous: Outcome, script: Script) -> dict[str, Any]:
        """Answer a repeated command with the outcome of its first execution, as far as it is known now."""
        if previous.said != message.name:
            reason = f"its id was given to {previous.said!r} before"
            refusal = Outcome(previous.id, message.name, "", "refused", reason)
            return json_answers.command_answer(message, refusal, {}, None)
        return json_answers.command_answer(message, previous, {}, self._state(script, previous))

    def _state(self, script: Script, outcome: Outcome) -> str | None:
        """Return the station's state after a command.

        None if the command was refused or its outcome is unknown, or if the station does not answer.
        """
        if outcome.result in ("refused", "unknown"):
            return None
        try:
            return str(script.client.status()["state"])
        except TransportError:
            return None

    def poll(self) -> None:
        """Renew leases and poll the outcomes of commands in progress. Call regularly."""
        for sentence in self._scripts.poll():
            log.warning("%s", sentence)
        if self._now() - self._looked >= _LOOK_S:
            self._looked = self._now()
            self._poll_outcomes()

    def _poll_outcomes(self) -> None:
        going_on = self._outcomes.pending
        if not going_on:
            return
        client = self._scripts.get_or_create("channel").client  # client without a script: it only reads
        try:
            status = client.status()
            for outcome in going_on:
                outcome.poll(status, client.events_since)
                self._newest = outcome.reason if outcome.result == "failed" else self._newest
        except TransportError as fault:
            log.warning("what became of commands is not known: %s", fault)

    # --- commands ------------------------------------------------------------------------------------------

    def _verb(self, script: Script, message: Message, outcome: Outcome) -> Mapping[str, Any]:
        """Execute the commands of EVA Web that a verb of the older channel stands for; return the answer's data."""
        if message.name not in VERBS:
            raise UnsupportedVerb(
                f"command not allowed: {str(message.fields['cmd'])!r:.80}; known: {', '.join(VERBS)}"
            )
        client = script.client
        with _refused_if_unreachable():
            scene = VerbContext(message, client.status(), script.selection, lambda: _commanded(client))
            sequence = commands_for_verb(scene)
        reply: Mapping[str, Any] = sequence.told
        for number, (kind, arguments) in enumerate(sequence.steps, start=1):
            last = number == len(sequence.steps)
            reply = self._send_command(script, kind, arguments, outcome if last else None) or reply
        script.selection.choose(**sequence.chosen)
        outcome.explain(sequence.note)
        return reply

    def _run_command(self, script: Script, message: Message, outcome: Outcome) -> Mapping[str, Any]:
        """Execute a command of EVA Web; return the data of the answer."""
        kind, arguments = message.name, message.arguments
        if kind not in OWN:
            raise UnsupportedVerb(f"unknown command {kind!r:.80}; known: {', '.join(OWN)}")
        if kind == "aim":
            return script.client.query_with("aim", arguments).data
        if kind not in ("claim", "give_up"):
            return self._send_command(script, kind, arguments, outcome)
        if arguments:
            raise UnsupportedVerb(f"{kind} takes no arguments; given: {', '.join(map(str, arguments)):.200}")
        if kind == "claim":
            self._claim(script)
        else:
            script.release()
        return {}

    def _send_command(
        self, script: Script, kind: str, arguments: Mapping[str, Any], outcome: Outcome | None
    ) -> Mapping[str, Any]:
        """Send one command under the script's lease.

        Raises:
            Refused: The station refuses the lease or the command.
            RuntimeFault: The station was unreachable before the command was sent.
            TransportError: There is no answer; the outcome is unknown.
        """
        with _refused_if_unreachable():
            self._claim(script)
            before = script.client.status()
        ack = script.client.send_command(kind, arguments, outcome.id if outcome else "")
        if outcome is not None:
            outcome.accept(kind, before if is_long_running(kind) else {})
        return {key: value for key, value in ack.data.items() if key not in ("epoch", "holder")}

    def _claim(self, script: Script) -> None:
        try:
            script.claim()
        except Refused as refusal:
            raise Refused(f"{refusal}{_APART if 'channel:' in str(refusal) else ''}") from None

    # --- questions -----------------------------------------------------------------------------------------

    def _run_query(self, script: Script, message: Message) -> dict[str, Any]:
        if message.name not in QUERIES:
            return {
                "ok": False,
                "error": f"unknown query: {message.name!r:.80}; known: {', '.join(QUERIES)}",
            }
        try:
            return {"ok": True, "data": getattr(self, f"_{message.name}")(script, message.fields)}
        except TransportError as fault:
            return {"ok": False, "error": f"console context not ready: {fault}"}
        except RuntimeFault as fault:
            return {"ok": False, "error": str(fault)}

    def _status(self, script: Script, fields: Mapping[str, Any]) -> dict[str, Any]:
        return older.status(script.client.status(), script.selection, self._newest)

    def _config(self, script: Script, fields: Mapping[str, Any]) -> dict[str, Any]:
        status = script.client.status()
        kinds = {"robot_type": status["robot"], "transport_type": status["transport"]}
        return {
            **kinds,
            "station": status["station"],
            "policy_type": status["policy"]["kind"],
            **status["facts"],
        }

    def _frame(self, script: Script, fields: Mapping[str, Any]) -> dict[str, Any]:
        cameras = script.client.status()["facts"]["cameras"]
        stream = script.client.subscribe("joints")
        try:
            joints = stream.receive(_FRAME_S).get("joints", {})
        finally:
            stream.close()
        return {"qpos": joints.get("measured"), "cameras": cameras}

    def _station(self, script: Script, fields: Mapping[str, Any]) -> dict[str, Any]:
        return script.client.status()

    def _events(self, script: Script, fields: Mapping[str, Any]) -> list[dict[str, Any]]:
        since = fields.get("since", 0)
        if isinstance(since, bool) or not isinstance(since, int) or not 0 <= since < 2**53:
            raise UnsupportedVerb(f"since = {since!r:.80}: must be a whole number, the newest event you have")
        return script.client.events_since(since)

    def _result(self, script: Script, fields: Mapping[str, Any]) -> dict[str, Any]:
        identity = fields.get("id")
        self._poll_outcomes()
        result = self._outcomes.get(identity) if isinstance(identity, str) else None
        if result is None:
            raise UnsupportedVerb(f"id = {identity!r:.80}: no command of that id is remembered")
        return result.to_dict

    def _commands(self, script: Script, fields: Mapping[str, Any]) -> dict[str, Any]:
        return {
            "cmd": {f"web:{verb}": entry.description for verb, entry in VERBS.items()},
            "command": list(OWN),
        }

    def close(self) -> None:
        self._scripts.close()


def _commanded(client: StationClient) -> list[float]:
    return list(client.query("aim").data["joints"])


@contextmanager
def _refused_if_unreachable() -> Iterator[None]:
    """Turn a TransportError into a RuntimeFault, for a block in which no command has been sent yet.

    The command then counts as refused: its outcome is not unknown.
    """
    try:
        yield
    except TransportError as fault:
        raise RuntimeFault(f"console context not ready: {fault}") from None
