"""Result pages on one database: `python -m benchmarks.results_pages OUT.json [--plans N] [--trials N]`.

The database of EVA_DATA_DIR and DATABASE_URL must be empty, and is filled first. Requests pass through the web's
complete middleware in this process, without a socket.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import statistics
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

from benchmarks.results_seed import Seeded, closed_episode, multiplied, seed

ROUNDS = 120
_QUESTIONS = 40  # simultaneous requests to the calculator
_MS = 1000.0


def main() -> None:
    """Fill the database, send the requests, and write the results."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("--plans", type=int, default=200)
    parser.add_argument("--trials", type=int, default=100_000)
    parser.add_argument("--copies", type=int, default=1, help="of each evaluation; PostgreSQL alone")
    parser.add_argument("--rounds", type=int, default=ROUNDS)
    options = parser.parse_args()
    os.environ.setdefault("DJANGO_SETTINGS_MODULE", "evaweb.settings")
    import django

    django.setup()
    from django.core.management import call_command
    from django.db import connection
    from django.test.utils import setup_test_environment

    setup_test_environment()
    call_command("migrate", verbosity=0)
    began = time.perf_counter()
    seeded = seed(options.plans, options.trials)
    if options.copies > 1:
        seeded = multiplied(seeded, options.copies)
    with connection.cursor() as cursor:
        cursor.execute("ANALYZE")
    measured = {
        "database": connection.vendor,
        "seed_s": time.perf_counter() - began,
        "pages": pages(seeded, options.rounds),
        "exports": exports(seeded),
        "handing": measure_allocation(seeded),
        "planner": planner(seeded),
    }
    options.out.write_text(json.dumps(measured), "utf-8")


def pages(seeded: Seeded, rounds: int) -> dict[str, dict[str, float]]:
    """Return by page the durations of many requests [ms], and the largest number of queries of a request.

    Each evaluation is requested twice. Keys that begin with `cold` are of the first requests, after the caches were
    cleared; the other keys are of the second ones. `p50` and `p95` are percentiles; those with `cpu` are of processor
    time.
    """
    from django.db import connection
    from django.test import Client
    from django.test.utils import CaptureQueriesContext

    from evaweb.results.analysis import caching

    client = Client()
    client.force_login(seeded.viewer)
    chance = random.Random(1)
    timings = {}
    for page, address in _addresses(seeded).items():
        _ask(client, address(seeded.plans[0]))  # loads templates and scipy
        caching.clear_caches()
        cold: list[float] = []
        warm: list[float] = []
        busy: list[float] = []
        queries = 0
        sampled = chance.sample(list(seeded.plans), min(rounds, len(seeded.plans)))
        for plan in sampled:
            with CaptureQueriesContext(connection) as captured:
                _ask(client, address(plan))
            queries = max(queries, len(captured))
        caching.clear_caches()
        for times in (cold, warm):
            for plan in sampled:
                began, worked = time.perf_counter(), time.process_time()
                _ask(client, address(plan))
                times.append((time.perf_counter() - began) * _MS)
                busy.append((time.process_time() - worked) * _MS)
        timings[page] = {
            "p50": statistics.median(warm),
            "p95": _share(warm, 0.95),
            "cold_p50": statistics.median(cold),
            "cold_p95": _share(cold, 0.95),
            "cpu_p95": _share(busy[len(cold) :], 0.95),
            "cold_cpu_p95": _share(busy[: len(cold)], 0.95),
            "queries": float(queries),
        }
    return timings


def _addresses(seeded: Seeded) -> dict[str, Callable[[Any], str]]:
    def under(plan: Any, path: str = "") -> str:
        return f"/result/plans/{plan.name}/{plan.version}/{path}"

    def api(plan: Any, path: str) -> str:
        return f"/api/v1/plans/{plan.name}/{plan.version}/{path}"

    return {
        "dashboard": lambda plan: "/result/lab/",
        "evaluations": lambda plan: "/result/plans/",
        "results": under,
        "comparison": lambda plan: under(plan, "compare/"),
        "evidence": lambda plan: under(plan, "evidence/"),
        "trials": lambda plan: under(plan, "trials/?success=no"),
        "all_trials": lambda plan: "/result/",
        "export": lambda plan: api(plan, "outcomes"),
        "export_statistics": lambda plan: api(plan, "results"),
    }


def planner(seeded: Seeded) -> dict[str, float]:
    """Return the delay of other pages while one viewer sends many different requests to the calculator.

    Key `page_p95_ms` is the 95th percentile of the duration of a page. The keys `answered` and `refused` are numbers of
    requests to the calculator; refused ones are given a time to retry.
    """
    from django.test import Client

    person, operator = Client(), Client()
    person.force_login(seeded.viewer)
    operator.force_login(seeded.operators[0])
    address, answers = "/result/plans/", []

    def ask(number: int) -> None:
        answers.append(person.get("/api/v1/planner", {"rate": 0.2 + number / 100}).status_code)

    _ask(operator, address)
    asking = [threading.Thread(target=ask, args=(number,)) for number in range(_QUESTIONS)]
    for thread in asking:
        thread.start()
    times: list[float] = []
    while any(thread.is_alive() for thread in asking) or len(times) < _QUESTIONS:
        began = time.perf_counter()
        _ask(operator, address)
        times.append((time.perf_counter() - began) * _MS)
    for thread in asking:
        thread.join()
    accepted = sum(status == 200 for status in answers)
    refused = sum(status == 503 for status in answers)
    if accepted + refused < _QUESTIONS:
        raise SystemExit(f"the planner answered {sorted(set(answers))}")
    return {"page_p95_ms": _share(times, 0.95), "answered": float(accepted), "refused": float(refused)}


def exports(seeded: Seeded) -> dict[str, float]:
    """Return the rows per second of exports of all trials, and of single evaluations."""
    from django.test import Client

    client = Client()
    client.force_login(seeded.viewer)
    rates = {}
    for format in ("csv", "parquet"):
        began, rows = time.perf_counter(), 0
        for plan in seeded.plans[:40]:
            answer = client.get(f"/api/v1/plans/{plan.name}/{plan.version}/outcomes?format={format}")
            content = b"".join(answer.streaming_content)
            rows += content.count(b"\r\n") - 1 if format == "csv" else _parquet_rows(content)
        rates[f"evaluation_{format}"] = rows / (time.perf_counter() - began)
    began = time.perf_counter()
    answer = client.get("/api/v1/trials?format=csv")
    rows = sum(piece.count(b"\r\n") for piece in answer.streaming_content) - 1
    rates["all_trials_csv"] = rows / (time.perf_counter() - began)
    return rates


def _parquet_rows(content: bytes) -> int:
    import io

    from pyarrow import parquet

    return int(parquet.read_metadata(io.BytesIO(content)).num_rows)


def measure_allocation(seeded: Seeded) -> dict[str, float]:
    """Let all operators request trials of one plan at all stations simultaneously, until no trial is left.

    Return the numbers of trials allocated, left over or allocated wrongly, and the duration of requests.
    """
    from evaweb.plans.models import Plan
    from evaweb.plans.services import freeze_plan

    source = seeded.plans[0]
    plan = Plan.objects.create(
        name="at-once",
        title="At once",
        owner=source.owner,
        repetitions=4,
        blind=True,
        first=source.first,
        second=source.second,
    )
    plan.checkpoints.set(source.checkpoints.all())
    plan.positions.set(source.positions.all())
    freeze_plan(user=plan.owner, plan=plan)
    times: list[float] = []
    locked: list[str] = []
    faults: list[str] = []
    threads = [
        threading.Thread(
            target=_operator,
            args=(plan, operator, seeded.stations[i % len(seeded.stations)], times, locked, faults),
        )
        for i, operator in enumerate(seeded.operators)
    ]
    began = time.perf_counter()
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    if faults:
        raise SystemExit(f"asking for trials failed: {faults[0]}")
    handed = list(
        plan.handouts.order_by("number").values_list("slot__index", "slot__block", "trial__station", "code")
    )
    return {
        "trials": float(len(handed)),
        "left": float(plan.slots.count() - len(handed)),
        "twice": float(sum(n - 1 for n in Counter(index for index, *_ in handed).values())),
        "codes_twice": float(len(handed) - len({code for *_, code in handed})),
        "out_of_order": float(
            _out_of_order([(index, block, station) for index, block, station, _ in handed])
        ),
        "locked": float(len(locked)),
        "p95_ms": _share(times, 0.95),
        "seconds": time.perf_counter() - began,
    }


def _operator(
    plan: Any, operator: Any, station: Any, times: list[float], locked: list[str], faults: list[str]
) -> None:
    """Request, run and score trials in a loop; if another operator's trial is on the station, wait until it ends.

    If the database is locked for too long, the web refuses a request. The refusal is then added to `locked`, and the
    operator retries.
    """
    from django.db import OperationalError, connection

    from evaweb.core.errors import Conflict

    trial = None
    try:
        while True:
            try:
                trial = trial or _asked(plan, operator, station, times)
                _made(trial, operator)
                trial = None
            except Conflict as refused:
                if any(word in str(refused) for word in ("nothing is left", "are made", "is closed")):
                    return
                if "cannot be scored" in str(refused):
                    raise
                time.sleep(0.01)
            except OperationalError as error:
                if "locked" not in str(error):
                    raise
                locked.append(str(error))
    except BaseException as error:
        faults.append(repr(error))
        raise
    finally:
        connection.close()


def _asked(plan: Any, operator: Any, station: Any, times: list[float]) -> Any:
    from evaweb.plans.allocation import allocate_trial

    began = time.perf_counter()
    trial = allocate_trial(user=operator, station=station, plan=plan).trial
    times.append((time.perf_counter() - began) * _MS)
    return trial


def _made(trial: Any, operator: Any) -> None:
    """End the run of a trial, and score it."""
    from django.utils import timezone

    from evaweb.trials.models import Milestone, Trial, TrialStatus
    from evaweb.trials.services import score_trial

    prepared = Trial.objects.filter(pk=trial.pk, status=TrialStatus.PREPARED)
    if prepared.exists():
        episode = closed_episode(trial.station, timezone.now(), 10.0)
        episode.save()
        prepared.update(status=TrialStatus.ENDED, duration_s=10.0, episode=episode)
    trial.refresh_from_db()
    ticks = dict.fromkeys(Milestone.objects.filter(scene=trial.scene).values_list("pk", flat=True), True)
    score_trial(user=operator, trial=trial, milestones=ticks)


def _out_of_order(handed: Sequence[tuple[int, int, int]]) -> int:
    """Return how often the order of the trials was violated.

    `handed` has for each trial, in the order in which the trials were handed out, its index in the plan, its block and
    its station. Three violations are counted: a block began before an earlier block, a station received a trial before
    an earlier one, or a block had more than one station.
    """
    begun = list(dict.fromkeys(block for _, block, _ in handed))
    wrong = sum(first > second for first, second in pairwise(begun))
    for station in {station for *_, station in handed}:
        mine = [(index, block) for index, block, at in handed if at == station]
        wrong += sum(first > second for first, second in pairwise(mine))
    owners: dict[int, set[int]] = {}
    for _, block, station in handed:
        owners.setdefault(block, set()).add(station)
    return wrong + sum(len(stations) > 1 for stations in owners.values())


def _ask(client: Any, address: str) -> None:
    answer = client.get(address)
    if answer.status_code != 200:
        raise SystemExit(f"{address} answered {answer.status_code}: {answer.content[:300]!r}")


def _share(values: Iterable[float], share: float) -> float:
    ordered = sorted(values)
    return ordered[min(len(ordered) - 1, int(share * len(ordered)))]


if __name__ == "__main__":
    main()
