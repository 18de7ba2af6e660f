"""Episodes of one station on its own computer: which of them the lab lacks, which it has, which may go.

DATA/uploads/STATION/UUID.json     the lab has compared it: with which digest, when, and what labels it has
DATA/episodes/.leaving/UUID/       is being removed
"""

from __future__ import annotations

import hashlib
import json
import logging
import os
import shutil
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from runtime.core.durable_files import sync_folder
from runtime.core.errors import RecordingError
from runtime.link.contents import MANIFEST, OUTCOME, Contents, is_episode
from runtime.recording.files import disk_error, read_json, write_atomic
from runtime.recording.labels import FOLDER as LABELS

log = logging.getLogger(__name__)
UPLOADS, LEAVING = "uploads", ".leaving"
_LOOK_S, _LOOK_SHARE = 2.0, 50.0  # between two looks; and at least so many times as long as one took
_DAY_S = 86400.0


@dataclass(frozen=True, slots=True)
class Receipt:
    """What the lab has said of an episode; `verified` is when, Unix time [s]. Digests are SHA-256, hexadecimal."""

    episode: str
    lab: str  # its public key, in hexadecimal
    digest: str
    bytes: int
    verified: float
    labels: str = ""
    removed: float | None = None  # when it was removed here


class Home:
    """The disk of a station's computer, as far as one station's episodes go; all of it belongs to one thread.

    `keep_days` is for how long they are kept here after the lab has compared them; None: for ever.
    """

    def __init__(
        self,
        data: Path,
        station: str,
        lab: str,
        keep_days: float | None = None,
        clock: Callable[[], float] = time.monotonic,
        wall: Callable[[], float] = time.time,
    ) -> None:
        self._station, self._lab, self._keep_days, self._clock, self._wall = (
            station,
            lab,
            keep_days,
            clock,
            wall,
        )
        self._data, self._root = data, data / "episodes"
        self._receipts = {receipt.episode: receipt for receipt in self._read()}
        self._closed: dict[str, float] = {}  # ours, that the lab lacks, and since when they are closed
        self._others: set[str] = set()  # of other stations of this computer, or of none
        self._put_off: dict[str, float] = {}
        self._labels: dict[str, tuple[int, int]] = {}  # files that were looked into, as they were then
        self._look_at = -float("inf")
        self._finish_removing()

    def folder(self, episode: str) -> Path:
        """Where an episode lies."""
        return self._root / episode

    def next(self) -> str:
        """The newest closed episode that the lab lacks and may be offered now, else one that may go; "" for none."""
        self._poll()
        now = self._clock()
        found = [uuid for uuid in self._closed if now >= self._put_off.get(uuid, now)]
        return max(found, key=self._closed.__getitem__) if found else self._removable(now)

    def next_labels(self) -> tuple[str, bytes] | None:
        """Labels of an episode that the lab has, which it does not have as they are now."""
        folder, now = self._data / LABELS, self._clock()
        try:
            files = list(os.scandir(folder))
        except OSError:
            return None
        for entry in files:
            uuid = entry.name.removesuffix(".jsonl")
            if uuid not in self._receipts or now < self._put_off.get(f"labels {uuid}", now):
                continue
            found = entry.stat()
            if self._labels.get(uuid) == (found.st_mtime_ns, found.st_size):
                continue
            lines = Path(entry.path).read_bytes()
            if hashlib.sha256(lines).hexdigest() != self._receipts[uuid].labels:
                return uuid, lines
            self._labels[uuid] = found.st_mtime_ns, found.st_size
        return None

    def arrived(self, episode: str, contents: Contents) -> None:
        """The lab has compared it. One that has been here long enough is removed; else a receipt is kept."""
        known = self._receipts.get(episode)
        if known is not None and known.digest == contents.digest and self._over(known):
            self._remove(known)
            return
        receipt = Receipt(episode, self._lab, contents.digest, contents.size, self._wall())
        self._store_receipt(receipt)
        self._closed.pop(episode, None)

    def labels_arrived(self, episode: str, lines: bytes) -> None:
        """The lab has these labels."""
        self._store_receipt(replace(self._receipts[episode], labels=hashlib.sha256(lines).hexdigest()))

    def put_off(self, what: str, seconds: float) -> None:
        """Do not offer the episode again before; nor the labels of one, as "labels UUID"."""
        self._put_off[what] = self._clock() + seconds

    # --- what there is -------------------------------------------------------------------------------------------

    def _poll(self) -> None:
        now = self._clock()
        if now < self._look_at:
            return
        try:
            names = [entry.name for entry in os.scandir(self._root) if is_episode(entry.name)]
        except OSError:
            names = []  # nothing was recorded here yet
        for name in names:
            if name not in self._receipts and name not in self._closed and name not in self._others:
                self._sort_in(name)
        for name in set(self._closed).difference(names):
            del self._closed[name]
        self._look_at = self._clock() + max(_LOOK_S, _LOOK_SHARE * (self._clock() - now))

    def _sort_in(self, name: str) -> None:
        """Its outcome is the last that a recorder writes: an episode without is open, or was left so."""
        try:
            closed = (self._root / name / OUTCOME).stat().st_mtime
        except OSError:
            return
        try:
            station = read_json(self._root / name / MANIFEST).get("station")
        except RecordingError as error:
            log.warning("episode %s is not offered to the lab: %s", name, error)
            station = None
        if station == self._station:
            self._closed[name] = closed
        else:
            self._others.add(name)

    # --- receipts ------------------------------------------------------------------------------------------------

    def _read(self) -> list[Receipt]:
        """Those of this lab: another one has nothing of it yet."""
        found = []
        for path in (self._data / UPLOADS / self._station).glob("*.json"):
            try:
                receipt = Receipt(**json.loads(path.read_bytes()))
            except (OSError, ValueError, TypeError) as error:
                log.warning("%s is no receipt, its episode is offered again: %r", path, error)
                continue
            if receipt.lab == self._lab and is_episode(receipt.episode):
                found.append(receipt)
        return found

    def _store_receipt(self, receipt: Receipt) -> None:
        folder = self._data / UPLOADS / self._station
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise disk_error("creating", folder, error) from error
        write_atomic(folder / f"{receipt.episode}.json", json.dumps(asdict(receipt), indent=1).encode())
        self._receipts[receipt.episode] = receipt

    # --- retention -----------------------------------------------------------------------------------------------

    def _over(self, receipt: Receipt) -> bool:
        """True if it has been kept for long enough."""
        if self._keep_days is None or receipt.removed is not None:
            return False
        return self._wall() - receipt.verified >= self._keep_days * _DAY_S

    def _removable(self, now: float) -> str:
        """One that may go: it is offered once more before, so that the lab compares what it has then."""
        if self._keep_days is None:
            return ""
        for uuid, receipt in self._receipts.items():
            if self._over(receipt) and now >= self._put_off.get(uuid, now):
                if self.folder(uuid).is_dir():
                    return uuid
                self._store_receipt(replace(receipt, removed=self._wall()))  # somebody else has
        return ""

    def _remove(self, receipt: Receipt) -> None:
        """At once for all who look: nothing ever finds a part of it."""
        folder, leaving = self.folder(receipt.episode), self._root / LEAVING / receipt.episode
        try:
            leaving.parent.mkdir(exist_ok=True)
            os.rename(folder, leaving)
            sync_folder(self._root)
            shutil.rmtree(leaving)
        except OSError as error:
            raise disk_error("removing", folder, error) from error
        self._store_receipt(replace(receipt, removed=self._wall()))
        log.info("episode %s is removed here: the lab has it", receipt.episode)

    def _finish_removing(self) -> None:
        """What a kill has left of folders that were being removed."""
        for folder in (self._root / LEAVING).glob("*"):
            if folder.name in self._receipts:
                shutil.rmtree(folder, ignore_errors=True)
