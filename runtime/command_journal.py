"""Every answered command on disk, so that a repeated uuid gets its first answer also after a restart."""

from __future__ import annotations

import json
import os
import time
from dataclasses import asdict
from pathlib import Path

from runtime.messages import Ack, Command

_REMEMBERED = 5000


class CommandJournal:
    """An append-only file of answers, `commands.jsonl` in the station's folder."""

    def __init__(self, station_dir: Path) -> None:
        station_dir.mkdir(parents=True, exist_ok=True)
        self._path = station_dir / "commands.jsonl"
        self.answers = self._read()
        self._file = self._path.open("a", encoding="utf-8")

    def _read(self) -> dict[str, Ack]:
        try:
            lines = self._path.read_text("utf-8", errors="replace").splitlines()
        except FileNotFoundError:
            return {}
        answers = {}
        for line in lines[-_REMEMBERED:]:
            try:
                row = json.loads(line)
                answers[row["uuid"]] = Ack(**row["ack"])
            except (ValueError, KeyError, TypeError):
                continue  # a line torn by a kill: its command was never answered
        if lines and not self._path.read_bytes().endswith(b"\n"):
            with self._path.open("a", encoding="utf-8") as file:
                file.write("\n")
        return answers

    def append(self, command: Command, ack: Ack) -> None:
        """Write one answer before it is given."""
        row = {
            "uuid": command.uuid,
            "kind": command.kind,
            "args": dict(command.args),
            "user": command.user,
            "holder": command.holder,
            "epoch": command.epoch,
            "wall": time.time(),
            "ack": asdict(ack),
        }
        self._file.write(json.dumps(row, default=str) + "\n")
        self._file.flush()
        os.fdatasync(self._file.fileno())
