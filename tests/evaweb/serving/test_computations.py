"""What computes long: beside the web, by a budget for each person, and nowhere else."""

from __future__ import annotations

import os
import signal
import threading
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import pytest
from django.test import Client

from evaweb.plans.models import Plan
from evaweb.serving import computations
from evaweb.serving.computations import (
    AT_ONCE_S,
    REFILLED,
    Busy,
    ComputeProcess,
    Questions,
)
from evaweb.statistics import (
    boundaries,
    design_power,
    planning,
    score_courses,
)
from evaweb.statistics.base import StatisticsError
from tests.evaweb.blind_lab import BlindLab
from tests.evaweb.crawling import crawled
from tests.evaweb.episodes.conftest import recorded  # noqa: F401  a fixture
from tests.processes import PATIENCE_S, eventually

NOW_S = 1000.0


class Played:
    """A process that answers when the test says so, and says what it took."""

    def __init__(self, seconds=0.0):
        self.seconds, self.asked, self.begun, self.free = (
            seconds,
            [],
            threading.Semaphore(0),
            threading.Event(),
        )

    def run(self, work, *given):
        self.asked.append(given)
        self.begun.release()
        assert self.free.wait(PATIENCE_S)
        return work(*given), self.seconds


def test_an_answer_is_computed_once_also_for_those_who_ask_meanwhile():
    played = Played()
    questions = Questions(played.run, patience_s=PATIENCE_S)
    with ThreadPoolExecutor(2) as people:
        coming = [people.submit(questions.result, who, divmod, 7, 2) for who in ("ann", "bob")]
        assert played.begun.acquire(timeout=PATIENCE_S)
        played.free.set()
        assert [one.result(PATIENCE_S) for one in coming] == [(3, 1)] * 2
    assert questions.result("cid", divmod, 7, 2) == (3, 1)
    assert played.asked == [(7, 2)]


def test_who_has_spent_their_computing_waits_for_it_and_nobody_else_does():
    now, played = [NOW_S], Played(AT_ONCE_S)
    played.free.set()
    questions = Questions(played.run, clock=lambda: now[0], patience_s=PATIENCE_S)
    assert questions.result("ann", divmod, 7, 2) == (3, 1)
    with pytest.raises(
        Busy, match=r"have taken 30 s of computing; allowed: 30 s at once\. Try again in 1 s"
    ) as busy:
        questions.result("ann", divmod, 8, 2)
    assert questions.result("bob", divmod, 9, 2) == (4, 1)
    assert questions.result("ann", divmod, 9, 2) == (4, 1)  # what is known costs nothing
    now[0] += busy.value.retry_after_s
    assert questions.result("ann", divmod, 8, 2) == (4, 0)
    now[0] += AT_ONCE_S / REFILLED / 2
    with pytest.raises(Busy) as busy:
        questions.result("bob", divmod, 10, 2) and questions.result("bob", divmod, 11, 2)
    now[0] += busy.value.retry_after_s
    assert questions.result("bob", divmod, 11, 2) == (5, 1)


def test_a_person_has_one_question_at_a_time_and_few_requests_wait(monkeypatch):
    monkeypatch.setattr(computations, "_MOST_WAITING", 2)
    played = Played()
    questions = Questions(played.run, patience_s=PATIENCE_S)
    with ThreadPoolExecutor(2) as people:
        coming = [people.submit(questions.result, "ann", divmod, 7, 2)]
        assert played.begun.acquire(timeout=PATIENCE_S)
        with pytest.raises(Busy, match="one at a time"):
            questions.result("ann", divmod, 8, 2)
        coming.append(people.submit(questions.result, "bob", divmod, 7, 2))
        while questions._waiting < 2:
            threading.Event().wait(0.01)
        with pytest.raises(Busy, match="too many questions"):
            questions.result("cid", divmod, 8, 2)
        played.free.set()
        assert [one.result(PATIENCE_S) for one in coming] == [(3, 1)] * 2
    assert questions.result("ann", divmod, 8, 2) == (4, 0)


def test_what_takes_longer_than_a_request_waits_is_known_when_it_is_asked_again():
    played = Played()
    questions = Questions(played.run, patience_s=0)
    with pytest.raises(Busy, match="is being computed"):
        questions.result("ann", divmod, 7, 2)
    played.free.set()
    assert questions.compute("drafts", divmod, 9, 2) == (4, 1)  # after it: there is one process
    assert questions.result("ann", divmod, 7, 2) == (3, 1)


def test_the_process_beside_computes_says_what_fails_and_is_started_anew():
    beside = ComputeProcess()
    try:
        assert beside.run(os.getpid)[0] not in (os.getpid(), None)
        assert beside.run(os.nice, 0)[0] == 19
        with pytest.raises(StatisticsError, match="allowed: 1 to 250"):
            beside.run(design_power.design_power, "none", 251, 0.2, 0.9, 0.05)
        here = design_power.outlook(0.2, 0.9, 0.8, 0.05, 5, (0.1,))
        there, seconds = beside.run(design_power.outlook, 0.2, 0.9, 0.8, 0.05, 5, (0.1,))
        assert (there, seconds > 0) == (here, True)
        with pytest.raises(Busy, match="has ended"):
            beside.run(signal.raise_signal, signal.SIGKILL)
        assert beside.run(divmod, 7, 2)[0] == (3, 1)
    finally:
        beside.end()


def test_a_process_beside_whose_web_is_gone_ends_in_the_middle_of_its_question():
    beside = ComputeProcess()
    beside.run(divmod, 7, 2)
    beside._wire.send((signal.sigwait, ((signal.SIGUSR1,),)))
    beside._wire.close()
    assert beside._process.wait(PATIENCE_S) == 0


# --- every address --------------------------------------------------------------------------------------------

LONG = (  # whatever takes long at the sizes that a question may have
    (boundaries, "_least_extreme"),
    (design_power, "_simulated"),
    (planning, "_barnard_tables"),
    (score_courses, "_flipped"),
    (score_courses, "_stops"),
)


@pytest.fixture
def counted(monkeypatch):
    """Calls of what computes long, by whether the bounded process made them, which is here the thread of its turns."""
    within, calls = threading.local(), {True: [], False: []}

    def run(work, *given):
        within.now = True
        try:
            return work(*given), 0.0
        finally:
            within.now = False

    def count(name, made, *given):
        calls[getattr(within, "now", False)].append(name)
        return made(*given)

    for module, name in LONG:
        monkeypatch.setattr(module, name, partial(count, name, getattr(module, name)))
    monkeypatch.setattr(computations, "questions", Questions(run, patience_s=PATIENCE_S))
    return calls


@pytest.fixture
def lab(live, runtime, ann, recorded, settings, tmp_path, monkeypatch):  # noqa: F811
    settings.DATA_DIR = tmp_path
    monkeypatch.setattr("evaweb.jobs.doorbell.notify_workers", lambda queue: True)
    return BlindLab(live, runtime, ann, recorded["finished"], tmp_path)


@pytest.mark.django_db(transaction=True)
def test_no_address_computes_long_outside_of_the_process_for_it(lab, alma, counted):
    for stage in ("allocate", "running", "failed", "scored", "closed"):
        getattr(lab, stage)()
    draft = Plan.objects.create(
        name="draft", title="D", question="?", owner=alma, repetitions=3, stopping="late", alpha=0.031
    )
    draft.checkpoints.set(lab.plan.checkpoints.all())
    draft.positions.set(lab.plan.positions.all())
    client = Client(raise_request_exception=False)
    client.force_login(alma)
    asked = "?rate=0.313&better=0.777&hours=0.3&alpha=0.047"
    told = list(crawled(lab, client, [asked]))
    told += [(one, client.get(one).status_code, "") for one in DRAFT]
    eventually(lambda: "progress" not in client.get(DRAFT[1] + asked).content.decode(), "the power")
    assert [address for address, status, _ in told if status == 500] == []
    assert len({address for address, status, _ in told if status == 200}) > 60
    assert {"_least_extreme", "_simulated", "_barnard_tables"} <= set(counted[True])
    assert counted[False] == []


DRAFT = ("/result/plans/draft/1/draft/", "/result/plans/draft/1/draft/power/")


@pytest.mark.django_db
def test_beyond_the_budget_page_and_rest_say_when_to_try_again(vera, client, monkeypatch):
    played = Played(AT_ONCE_S)
    played.free.set()
    monkeypatch.setattr(computations, "questions", Questions(played.run, lambda: NOW_S, PATIENCE_S))
    client.force_login(vera)
    assert client.get("/api/v1/planner?hours=0.2").status_code == 200
    for address in ("/api/v1/planner?rate=0.4", "/result/planner/?rate=0.4"):
        answer = client.get(address)
        assert (answer.status_code, answer["Retry-After"]) == (503, "1")
        assert "30 s at once" in answer.content.decode()
    assert client.get("/result/planner/?hours=0.2").status_code == 200
