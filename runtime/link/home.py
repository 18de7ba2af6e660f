"""Episodes of one station on its own computer.

An episode has not been sent yet, has been verified by the lab, or may be removed.

DATA/uploads/STATION/UUID.json     receipt: the digest that the lab has verified, and when; the digest of the labels
DATA/episodes/.leaving/UUID/       episode that is being removed
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
_LOOK_S, _LOOK_SHARE = 2.0, 50.0  # between two scans [s]; least ratio of pause to duration of a scan
_DAY_S = 86400.0


@dataclass(frozen=True, slots=True)
class Receipt:
    """Confirmation of an episode by the lab; `verified` is the Unix time [s], digests are SHA-256 in hexadecimal."""

    episode: str
    lab: str  # public key of the lab, hexadecimal
    digest: str
    bytes: int
    verified: float
    labels: str = ""
    removed: float | None = None  # Unix time of its removal here [s]


class Home:
    """Episodes of one station on the disk of its computer. One thread uses it.

    `keep_days`: Days that an episode stays here after the lab has verified it; None: forever.
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
        self._closed: dict[str, float] = {}  # this station's episodes that the lab lacks: time of closing
        self._others: set[str] = set()  # episodes of other stations of this computer, or of none
        self._put_off: dict[str, float] = {}
        self._labels: dict[str, tuple[int, int]] = {}  # label files known to be at the lab: mtime and size
        self._look_at = -float("inf")
        self._finish_removing()

    def folder(self, episode: str) -> Path:
        """Return the folder of an episode."""
        return self._root / episode

    def next(self) -> str:
        """Return the newest closed episode that the lab lacks and that may be offered now.

        If there is none, return an episode that can be removed; "" if there is none either.
        """
        self._poll()
        now = self._clock()
        due = [uuid for uuid in self._closed if now >= self._put_off.get(uuid, now)]
        return max(due, key=self._closed.__getitem__) if due else self._removable(now)

    def next_labels(self) -> tuple[str, bytes] | None:
        """Return uuid and label lines of an episode whose labels at the lab are out of date.

        The lab has the episode, but its labels are older than those here. The result is None if there is no such
        episode.
        """
        folder, now = self._data / LABELS, self._clock()
        try:
            files = list(os.scandir(folder))
        except OSError:
            return None
        for entry in files:
            uuid = entry.name.removesuffix(".jsonl")
            if uuid not in self._receipts or now < self._put_off.get(f"labels {uuid}", now):
                continue
            status = entry.stat()
            if self._labels.get(uuid) == (status.st_mtime_ns, status.st_size):
                continue
            lines = Path(entry.path).read_bytes()
            if hashlib.sha256(lines).hexdigest() != self._receipts[uuid].labels:
                return uuid, lines
            self._labels[uuid] = status.st_mtime_ns, status.st_size
        return None

    def arrived(self, episode: str, contents: Contents) -> None:
        """Record in a receipt that the lab has verified the episode. Raises: RecordingError.

        If there is a receipt with the same content already, and its retention time is over, remove the episode instead.
        """
        stored = self._receipts.get(episode)
        if stored is not None and stored.digest == contents.digest and self._over(stored):
            self._remove(stored)
            return
        receipt = Receipt(episode, self._lab, contents.digest, contents.size, self._wall())
        self._store_receipt(receipt)
        self._closed.pop(episode, None)

    def labels_arrived(self, episode: str, lines: bytes) -> None:
        """Record that the lab has the label lines `lines` of the episode."""
        self._store_receipt(replace(self._receipts[episode], labels=hashlib.sha256(lines).hexdigest()))

    def put_off(self, what: str, seconds: float) -> None:
        """Do not offer `what` to the lab for `seconds` [s].

        `what` is the uuid of an episode, or the text "labels UUID" for the labels of that episode.
        """
        self._put_off[what] = self._clock() + seconds

    # --- scan ---------------------------------------------------------------------------------------------------

    def _poll(self) -> None:
        now = self._clock()
        if now < self._look_at:
            return
        try:
            names = [entry.name for entry in os.scandir(self._root) if is_episode(entry.name)]
        except OSError:
            names = []  # nothing has been recorded here yet
        for name in names:
            if name not in self._receipts and name not in self._closed and name not in self._others:
                self._sort_in(name)
        for name in set(self._closed).difference(names):
            del self._closed[name]
        self._look_at = self._clock() + max(_LOOK_S, _LOOK_SHARE * (self._clock() - now))

    def _sort_in(self, name: str) -> None:
        """Record a new folder as an episode to send, or as one of another station.

        A folder without an outcome is skipped until later: the recorder writes the outcome last.
        """
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
        """Return the receipts of episodes that this lab has verified; receipts of other labs are ignored."""
        receipts = []
        for path in (self._data / UPLOADS / self._station).glob("*.json"):
            try:
                receipt = Receipt(**json.loads(path.read_bytes()))
            except (OSError, ValueError, TypeError) as error:
                log.warning("%s is no receipt, its episode is offered again: %r", path, error)
                continue
            if receipt.lab == self._lab and is_episode(receipt.episode):
                receipts.append(receipt)
        return receipts

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
        """Return True if the episode of this receipt is still here, and its retention time is over."""
        if self._keep_days is None or receipt.removed is not None:
            return False
        return self._wall() - receipt.verified >= self._keep_days * _DAY_S

    def _removable(self, now: float) -> str:
        """Return an episode whose retention time is over, "" if there is none.

        It is offered once more before its removal, so that the lab verifies its present copy.
        """
        if self._keep_days is None:
            return ""
        for uuid, receipt in self._receipts.items():
            if self._over(receipt) and now >= self._put_off.get(uuid, now):
                if self.folder(uuid).is_dir():
                    return uuid
                self._store_receipt(replace(receipt, removed=self._wall()))  # another program has removed it
        return ""

    def _remove(self, receipt: Receipt) -> None:
        """Remove an episode. It is renamed first, so that readers find all of it or nothing."""
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
        """Finish removals that a crash interrupted."""
        for folder in (self._root / LEAVING).glob("*"):
            if folder.name in self._receipts:
                shutil.rmtree(folder, ignore_errors=True)
