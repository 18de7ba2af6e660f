"""Time until an e-stop takes effect under each attack.

A page presses over its websocket and at the process for stops simultaneously, and the first answer counts; each of the
two ways is also measured alone. Each attack has its own lab: a real web, a station with a running simulated robot, and
another station. Attackers are separate programs at nice 19 (`benchmarks.attacks`).
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.estop_presses import OpenPage, Press, RestPresser, page_load_time
from benchmarks.estop_station import Station, StationWatch
from benchmarks.labs import ROOT, RunningLab, lab
from benchmarks.report import Figure, Report
from benchmarks.servers import postgresql, why_no_postgresql
from evaweb.lab.rest_client import RestClient
from runtime.core.errors import RuntimeFault

ATTACKS = (
    "none",
    "status_flood",
    "dead_station",
    "viewer_stops",
    "half_open",
    "logins",
    "bodies",
    "toml",
    "slow_json",
    "slow_frames",
    "exports",
    "pings",
    "handshakes",
    "pages",
    "rest_clients",
    "made_up_tokens",
    "halts",
    "database_hangs",
)
WAYS = ("estop", "socket", "rest")  # a page, its websocket alone, REST at the process for stops
SECONDS = 30.0  # of presses per attack, a third for each way
_WANTED_MS = 200
_RECOVERED_S, _GIVEN_UP_S = 10, 60.0
_PAUSE_S = 0.05  # between two presses
_FEWEST = 3  # presses per way, however long they take
_ENDING_S = 30.0


@dataclass(frozen=True, slots=True)
class Bench:
    """Lab, operator's session and station of a measurement.

    `database` is the folder of the lab's PostgreSQL server, None without one.
    """

    lab: RunningLab
    ready_file: Path
    database: Path | None
    operator: RestClient
    station: Station


def measure(seconds: float, attacks: Sequence[str] = ATTACKS) -> Report:
    """Measure e-stop presses during each attack, and return the figures.

    The figures `WAY_p99_ms.ATTACK` are the delays, where WAY is one of WAYS, the ways of pressing. Further figures
    count lost presses, and show whether station and web still run.
    """
    rows = []
    for attack in attacks:
        with tempfile.TemporaryDirectory() as folder, bench(Path(folder)) as lab_bench:
            rows.append(measure_attack(lab_bench, attack, seconds))
    missing = why_no_postgresql()
    if missing:
        print(f"not measured on PostgreSQL: {missing}", file=sys.stderr)
    else:
        rows.append(_on_postgresql(seconds))
    for row in rows:
        if not row["recovered"]:
            print(f"{row['attack']}: the web loads no page for {_GIVEN_UP_S:g} s after it", file=sys.stderr)
    return Report("estop", [figure for row in rows for figure in figures(row)], rows)


def _on_postgresql(seconds: float) -> dict[str, Any]:
    with tempfile.TemporaryDirectory() as folder:
        database = Path(folder) / "postgresql"
        with postgresql(database) as store, bench(Path(folder) / "lab", database, store.url) as lab_bench:
            return measure_attack(lab_bench, "database_hangs", seconds) | {
                "attack": "database_hangs.postgresql"
            }


@contextmanager
def bench(folder: Path, database: Path | None = None, url: str = "") -> Iterator[Bench]:
    """Yield a running lab in a folder; its database is the PostgreSQL server in `database` at `url`, or SQLite."""
    folder.mkdir(exist_ok=True)
    ready = folder / "ready.json"
    environment = {"DJANGO_SETTINGS_MODULE": "evaweb.settings", "DATABASE_URL": url}
    with (
        lab(["-m", "benchmarks.estop_lab", str(ready)], ready, environment) as running,
        closing(Station(running.data)) as station,
    ):
        yield Bench(running, ready, database, running.visitor, station)


def measure_attack(
    found: Bench, attack: str, seconds: float, share: float = 1.0, moving: bool = True
) -> dict[str, Any]:
    """Measure presses for `seconds` during an attack of relative strength `share`; with `moving`, during a run."""
    facts = found.lab.announced
    program = RestPresser(facts["stops"], {"Authorization": f"Bearer {facts['token']}"})
    with closing(OpenPage(found.operator, facts["stops"])) as page:
        senders = dict(zip(WAYS, (page.press, page.over_the_socket, program.press), strict=True))
        found.station.wait_until_up()
        if moving:
            _warmed(found, *senders.values())
            found.station.run()
        watching = StationWatch(found.station, facts["pids"]["web"])
        with _under(found, attack, share) as did:
            time.sleep(seconds / 4.0)  # without presses: the run must continue
            pressed = {
                name: _presses(found.station, press, seconds / len(senders))
                for name, press in senders.items()
            }
    recovery = page_load_time(found.operator, _GIVEN_UP_S)
    watched = watching.end()
    return {
        "attack": attack,
        **pressed,
        "recovered": recovery is not None,
        "recovery_s": _GIVEN_UP_S if recovery is None else recovery,
        "interrupted": _interruption(found.station),
        "attacker": dict(did),
        **watched._asdict(),
    }


def _warmed(lab_bench: Bench, *ways: Callable[[str], Press]) -> None:
    """Press in each of `ways` and load a page, so that first-time costs count neither as delay nor as memory growth."""
    for press in ways:
        press("to begin with")
    page_load_time(lab_bench.operator, _GIVEN_UP_S)


def _interruption(station: Station) -> str:
    try:
        return station.interruption()
    except RuntimeFault as fault:
        return str(fault)


@contextmanager
def _under(lab_bench: Bench, attack: str, share: float) -> Iterator[dict[str, int]]:
    """Run the attack `attack` with the relative strength `share` while the context is open.

    The context yields a map. When the context has ended, the map contains what the attacker has counted. With the
    attack "none" the map stays empty.
    """
    did: dict[str, int] = {}
    if attack == "none":
        yield did
        return
    command = [
        sys.executable,
        "-m",
        "benchmarks.attacks",
        attack,
        str(lab_bench.ready_file),
        str(lab_bench.lab.data),
    ]
    command += [
        "--share",
        str(share),
        *(["--database", str(lab_bench.database)] if lab_bench.database else []),
    ]
    child = subprocess.Popen(command, cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert child.stdin is not None
    assert child.stdout is not None
    try:
        if not child.stdout.readline():
            raise SystemExit(f"the attack {attack} has not begun: it ended with {child.wait()}")
        yield did
    finally:
        child.stdin.close()
        try:
            child.wait(_ENDING_S)
        except subprocess.TimeoutExpired:
            child.kill()
            child.wait()
        output = child.stdout.read()
    did |= json.loads(output) if output else {}


def _presses(station: Station, press: Callable[[str], Press], seconds: float) -> dict[str, Any]:
    """Press and release alternately for `seconds`, and return the results.

    After a failed release there are no more releases.
    """
    presses: list[Press] = []
    lost, releases = 0, True
    until = time.monotonic() + seconds
    while len(presses) < _FEWEST or time.monotonic() < until:
        presses.append(press(f"press {len(presses) + 1}"))
        if not station.latched:
            lost += 1
        elif releases:
            releases = (
                station.release() or station.release()
            )  # the copy of a press may arrive late by the other way
        time.sleep(_PAUSE_S)
    return summarize_presses(presses, lost) | {"released": releases}


def summarize_presses(presses: Sequence[Press], lost: int) -> dict[str, Any]:
    """Return the results of presses; `lost` is the number of presses that the station did not receive."""
    ms = np.array([press.ms for press in presses])
    undone = [
        f"{press.status or 'unanswered'}: {press.reason}" for press in presses if press.status != "done"
    ]
    return {
        "presses": len(presses),
        **{f"p{share}_ms": float(np.percentile(ms, share)) for share in (50, 99)},
        "max_ms": float(ms.max()),
        "failed": sum(press.failed for press in presses),
        "unanswered": sum(not press.status for press in presses),
        "lost": lost,
        "undone": list(dict.fromkeys(undone))[:5],
    }


def figures(row: dict[str, Any]) -> Iterator[Figure]:
    """Yield the figures of one attack."""
    attack = row["attack"]
    for channel in WAYS:
        values = row[channel]
        allowed = f"<= {_WANTED_MS}" if channel == "estop" else ""
        yield Figure(f"{channel}_p99_ms.{attack}", values["p99_ms"], "ms", allowed)
        yield Figure(f"{channel}_p50_ms.{attack}", values["p50_ms"], "ms")
        yield Figure(f"{channel}_presses.{attack}", values["presses"], "")
        for label in ("lost", "failed", "unanswered"):
            yield Figure(f"{channel}_{label}.{attack}", values[label], "", "== 0")
    yield Figure(f"run_interrupted.{attack}", float(bool(row["interrupted"])), "", "== 0")
    yield Figure(f"main_late_ms.{attack}", row["main_late_ms"], "ms")
    yield Figure(f"web_growth_mb.{attack}", row["web_growth_mb"], "MB")
    yield Figure(f"station_growth_mb.{attack}", row["station_growth_mb"], "MB")
    yield Figure(f"recovery_s.{attack}", row["recovery_s"], "s", f"<= {_RECOVERED_S}")
