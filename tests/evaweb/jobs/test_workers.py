"""Workers by what they have: which queues they take, whose data folder is the lab's, and jobs that none can take."""

from __future__ import annotations

import threading
from datetime import timedelta
from pathlib import Path
from uuid import UUID, uuid4

import pytest
from django.core.management import CommandError, call_command
from django.db.models.functions import Now
from django.test import Client
from django.urls import reverse

from evaweb.core.errors import EvaError
from evaweb.jobs import kinds, services, tasks, worker, workers
from evaweb.jobs.kinds import Queue
from evaweb.jobs.models import Hold, Job, JobStatus, LabFolder, WorkerProcess
from evaweb.jobs.workers import NO_FOLDER, NO_QUEUE, NOBODY, waiting_for
from tests.evaweb.conftest import person
from tests.evaweb.jobs.conftest import Toy
from tests.processes import PATIENCE_S, eventually

pytestmark = [pytest.mark.django_db, pytest.mark.usefixtures("rung")]


def enqueue(kind: str = "toy", key: str = "toy:1") -> Job:
    return services.enqueue(kind=kind, key=key, args={})


def running(*queues: str, folder: bool = True, silent_s: float = 0.0) -> UUID:
    seen = Now() - timedelta(seconds=silent_s)
    return WorkerProcess.objects.create(pk=uuid4(), host="two", queues=queues, folder=folder, seen_at=seen).pk


@pytest.fixture
def many_machines(monkeypatch: pytest.MonkeyPatch) -> None:
    """A database that more than one machine can reach, as far as workers can tell."""
    monkeypatch.setattr(workers.connection.__class__, "vendor", "postgresql", raising=False)


# --- queues --------------------------------------------------------------------------------------------------


def test_a_job_goes_into_the_queue_of_its_kind_which_is_one_that_workers_take() -> None:
    assert {name: kind.queue for name, kind in kinds._kinds.items() if kind.queue != Queue.CPU} == {
        "judge": "gpu",
        "preflight": "station",
        "copies": "copies",
    }
    assert kinds.without_folder() == ["preflight"]
    assert enqueue("preflight").queue == "station"
    assert services.run_queue("cpu") == 0


@pytest.mark.parametrize("given", ["", ",", "lab", "cpu,,disk", "CPU"])
def test_a_queue_that_no_job_is_in_is_refused(given: str) -> None:
    with pytest.raises(CommandError, match="allowed: cpu, gpu, station, copies"):
        call_command("worker", queues=given)


def test_queues_are_named_once_each() -> None:
    assert workers.queue_names(" station,cpu, station") == ["cpu", "station"]


@pytest.mark.django_db(transaction=True)
def test_jobs_at_copies_run_beside_each_other(monkeypatch: pytest.MonkeyPatch) -> None:
    both, ending = threading.Barrier(2, timeout=PATIENCE_S), threading.Event()

    def meet(work: kinds.JobContext) -> dict[str, object]:
        return {"met": both.wait() >= 0}

    monkeypatch.setitem(kinds._kinds, "copy", kinds.Declared(meet, queue=Queue.COPIES))
    threads = [threading.Thread(target=worker._work_on_copies, args=(ending,)) for _ in range(2)]
    for thread in threads:
        thread.start()
    for number in range(2):
        services.enqueue(kind="copy", key=f"copy:{number}", args={})
    tasks.work(Queue.COPIES)
    eventually(lambda: Job.objects.filter(result={"met": True}).count() == 2, "both are done")
    ending.set()
    worker.wake_copies()
    for thread in threads:
        thread.join(PATIENCE_S)
        assert not thread.is_alive()


# --- jobs that no running worker can take --------------------------------------------------------------------


def test_a_job_says_what_is_missing_until_a_worker_that_takes_it_runs(toy: Toy) -> None:
    job = enqueue("judge")
    assert waiting_for(job) == NOBODY
    running("cpu", "station")
    running("gpu", silent_s=3600)
    assert waiting_for(job) == NO_QUEUE(queue="gpu")
    running("gpu", folder=False)
    assert waiting_for(job) == NO_FOLDER(queue="gpu")
    running("gpu")
    assert waiting_for(job) == ""
    assert waiting_for(enqueue()) == "", "the first one takes it"


def test_the_page_of_jobs_and_the_first_page_say_which_queue_is_missing(client: Client) -> None:
    client.force_login(person("olga", "operator"))
    running("cpu")
    job = enqueue("judge")
    Job.objects.filter(pk=job.pk).update(created_at=Now() - timedelta(hours=1))
    for address in (reverse("jobs"), reverse("home")):
        page = client.get(address).content.decode()
        assert "No running worker takes the queue gpu" in page, address
    running("gpu")
    for address in (reverse("jobs"), reverse("home")):
        assert "No running worker" not in client.get(address).content.decode(), address


def test_a_worker_is_in_the_list_from_its_first_sign_of_life_to_its_end() -> None:
    owner = uuid4()
    assert workers.record_heartbeat(owner=owner, queues=["cpu"])
    assert workers.record_heartbeat(owner=owner, queues=["cpu"])
    assert workers.served().with_folder == {"cpu"}
    running("gpu", silent_s=2 * 24 * 3600)
    workers.worker_ended(owner=owner)
    assert not WorkerProcess.objects.exists(), "nor one that was never heard of again"


# --- the lab's data folder -----------------------------------------------------------------------------------


def test_on_one_machine_the_data_folder_is_the_labs() -> None:
    assert workers.has_lab_folder()
    workers.lab_folder_named()
    assert not LabFolder.objects.exists()


@pytest.mark.usefixtures("many_machines")
def test_a_worker_with_another_folder_takes_only_what_needs_none(toy: Toy, settings: object) -> None:
    enqueue()
    assert services.claim(queue="cpu", owner=uuid4()) is None, "nobody has said yet which folder it is"
    workers.lab_folder_named()
    settings.EVA_LAB_ID = "another"  # type: ignore[attr-defined]
    workers.record_heartbeat(owner=uuid4(), queues=["cpu", "station"])
    assert (workers.served().queues, workers.served().with_folder) == ({"cpu", "station"}, frozenset())
    enqueue("preflight", "p")
    assert services.claim(queue="cpu", owner=uuid4()) is None
    assert services.claim(queue="station", owner=uuid4()) is not None


@pytest.mark.usefixtures("many_machines")
def test_another_folder_becomes_the_labs_only_once_no_worker_of_the_first_runs(settings: object) -> None:
    workers.lab_folder_named()
    first = running("cpu")
    settings.EVA_LAB_ID = "another"  # type: ignore[attr-defined]
    with pytest.raises(EvaError, match=r"this database is that of the data folder .* whose worker runs"):
        workers.lab_folder_named()
    assert not workers.has_lab_folder()
    workers.worker_ended(owner=first)
    workers.lab_folder_named()
    assert workers.has_lab_folder()


# --- what jobs hold ------------------------------------------------------------------------------------------


def at_work(key: str) -> Job:
    enqueue(key=key)
    job = services.claim(queue="cpu", owner=uuid4())
    assert job is not None
    return job


def test_two_jobs_never_hold_the_same_and_one_that_waits_holds_nothing(
    toy: Toy, monkeypatch: pytest.MonkeyPatch
) -> None:
    one, other = at_work("one"), at_work("other")
    services.hold(one, ["datasets/a", "datasets/b"])
    services.hold(other, ["datasets/c"])
    said: list[str] = []

    def later(seconds: float) -> None:
        other.refresh_from_db()
        said.append(other.progress)
        assert list(other.holds.all()) == [], "two that wait for each other would wait for ever"
        if len(said) == 2:
            services.job_done(job=one, result={})

    monkeypatch.setattr(services.time, "sleep", later)
    services.hold(other, ["datasets/b", "datasets/d"])
    assert said == ["waits for another job at work on the same: one"] * 2
    assert set(Hold.objects.filter(job=other).values_list("what", flat=True)) == {"datasets/b", "datasets/d"}


def test_what_a_swept_job_held_is_free(toy: Toy) -> None:
    one = at_work("one")
    services.hold(one, ["datasets/a"])
    Job.objects.filter(pk=one.pk).update(seen_at=Now() - timedelta(hours=1))
    assert services.reclaim_stale_jobs() == 1
    again = services.claim(queue="cpu", owner=uuid4())
    assert again is not None
    services.hold(again, ["datasets/a"])
    assert Hold.objects.get().owner == again.owner


def test_a_job_that_is_cancelled_while_it_waits_ends(toy: Toy, monkeypatch: pytest.MonkeyPatch) -> None:
    one, other = at_work("one"), at_work("other")
    services.hold(one, ["datasets/a"])
    user = person("olga", "operator")
    monkeypatch.setattr(services.time, "sleep", lambda seconds: services.cancel(user=user, job=other))
    with pytest.raises(kinds.Cancelled):
        services.hold(other, ["datasets/a"])


@pytest.mark.parametrize("args", [{"what": "merge", "datasets": ["datasets/a", "b"], "to": "datasets/m"}])
def test_an_order_holds_all_datasets_that_it_reads_or_writes(args: dict[str, object]) -> None:
    from evaweb.datasets.job_kinds import _names

    assert _names(args) == ["datasets/a", "b", "datasets/m"]
    assert _names({"what": "split", "dataset": "a", "to": "t", "parts": {"x": [0]}}) == ["a", "t", "t/x"]
    assert _names({"what": "import", "dataset": "in/cups"}) == ["in/cups", "datasets/cups"]


# --- a worker that is not heard ------------------------------------------------------------------------------


@pytest.mark.usefixtures("many_machines")
@pytest.mark.django_db(transaction=True)
def test_where_there_are_several_machines_a_worker_ends_before_its_job_is_anothers(
    toy: Toy, monkeypatch: pytest.MonkeyPatch, settings: object, tmp_path: Path
) -> None:
    settings.EVA_JOB_STALE_S = 0.3  # type: ignore[attr-defined]
    workers.lab_folder_named()
    ended: list[int] = []
    monkeypatch.setattr(services.os, "_exit", ended.append)

    def taken(work: kinds.JobContext) -> kinds.Args:
        Job.objects.update(owner=uuid4())
        while not ended:
            services.time.sleep(0.01)
        return {}

    toy.does = taken
    enqueue()
    services.run_queue("cpu")
    assert ended == [1]
    assert Job.objects.get().status == JobStatus.RUNNING, "it is the other's"
