"""Journal of answered commands on disk, so that a repeated uuid gets its first answer also after a restart."""

from __future__ import annotations

import json
import logging
import os
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from runtime.core.durable_files import append_durably
from runtime.ipc.messages import Ack, Command

log = logging.getLogger(__name__)
REMEMBERED = 5000
_TAIL_BYTES = 16 << 20  # [bytes] of a file that grows for years; contains REMEMBERED lines


class CommandJournal:
    """Append-only file of answers, `commands.jsonl` in the station's folder."""

    def __init__(self, station_dir: Path) -> None:
        station_dir.mkdir(parents=True, exist_ok=True)
        self._file = (station_dir / "commands.jsonl").open("a+b", buffering=0)
        self.answers = self._read()

    def _read(self) -> dict[str, Ack]:
        size = self._file.seek(0, os.SEEK_END)
        self._file.seek(max(0, size - _TAIL_BYTES))
        content = self._file.read() or b""
        whole, _, torn = content.rpartition(b"\n")
        if torn:  # incomplete after a kill; its command was never answered
            self._file.truncate(size - len(torn))
        answers: dict[str, Ack] = {}
        for line in whole.split(b"\n")[-REMEMBERED:]:
            try:
                row = json.loads(line)
                answers.setdefault(row["uuid"], Ack(**row["ack"]))
            except (ValueError, KeyError, TypeError):
                continue  # damaged, or a line cut by the start of the tail
        return answers

    def append(self, command: Command, ack: Ack) -> str:
        """Write an answer before it is sent; return "", or why it is not on disk."""
        return self.append_all([(command, ack)])

    def append_all(self, answered: Sequence[tuple[Command, Ack]]) -> str:
        """Write answers, with one sync, before they are sent; return "", or why they are not on disk.

        A full disk must not end the process that executes stops: the lines are removed again and the reason is
        logged.
        """
        if not answered:
            return ""
        lines = [json.dumps(_row(*answer), default=str).encode() + b"\n" for answer in answered]
        try:
            append_durably(self._file, b"".join(lines), os.fdatasync)
        except OSError as error:
            kinds = ", ".join(sorted({command.kind for command, _ in answered}))
            log.error("the answer to %s is not on disk: %s", kinds, error)
            return f"not on disk ({error}): after a restart {kinds} could be given twice"
        return ""

    def close(self) -> None:
        """Close the file."""
        self._file.close()


def _row(command: Command, ack: Ack) -> dict[str, Any]:
    return {
        "uuid": command.uuid,
        "kind": command.kind,
        "args": _json_arguments(command.args),
        "user": command.user,
        "role": command.role,
        "holder": command.holder,
        "epoch": command.epoch,
        "wall": time.time(),
        "ack": asdict(ack),
    }


def _json_arguments(arguments: Mapping[str, Any]) -> object:
    """Return the arguments as a dict; if they cannot be written as JSON, a sentence about that.

    Such arguments were refused, but must not raise an exception here.
    """
    try:
        json.dumps(arguments, default=str)
    except (TypeError, ValueError, RecursionError) as error:
        return f"no JSON: {type(error).__name__}"
    return dict(arguments)
