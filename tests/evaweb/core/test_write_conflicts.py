"""Two who write the same at one moment: one row, and a sentence for the one who came second."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

import pytest
from django.db import IntegrityError, close_old_connections, connection
from django.test import Client, RequestFactory
from django.urls import reverse

from evaweb.core.errors import EvaError
from evaweb.core.write_conflicts import TAKEN, is_duplicate, once_more
from evaweb.plans.models import Plan
from evaweb.plans.services import plan_draft
from evaweb.serving.error_pages import RefusalMiddleware
from evaweb.trials import scene_writing
from evaweb.trials.models import Checkpoint, Scene
from evaweb.trials.scene_writing import SceneRefused, scene_write
from tests.evaweb.conftest import person
from tests.processes import PATIENCE_S, joined

TAKEN_NAME = IntegrityError("UNIQUE constraint failed: trials_scene.name")


def at_once(*acts: Callable[[], Any]) -> list[Any]:
    """What each returned or raised, all of them begun together."""
    together, found = threading.Barrier(len(acts)), [None] * len(acts)

    def do(place: int, act: Callable[[], Any]) -> None:
        try:
            together.wait(PATIENCE_S)
            found[place] = act()
        except Exception as error:
            found[place] = error
        finally:
            connection.close()

    threads = [threading.Thread(target=do, args=one) for one in enumerate(acts)]
    for thread in threads:
        thread.start()
    for thread in threads:
        joined(thread)
    return found


def cups(title: str) -> dict[str, Any]:
    return {"name": "cups", "title": title, "instruction": "stack", "positions": [{"number": 1}]}


@pytest.mark.django_db(transaction=True)
def test_of_two_new_scenes_of_one_name_made_at_one_moment_one_is_refused_with_the_reason(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    alma = person("alma", "admin")
    if connection.vendor == "postgresql":  # both have looked before either writes
        looked, looks = threading.Barrier(2), threading.local()
        check = scene_writing._assigned

        def both(*given: Any) -> Any:
            faults = check(*given)
            if not getattr(looks, "once", False):
                looks.once = True
                looked.wait(PATIENCE_S)
            return faults

        monkeypatch.setattr(scene_writing, "_assigned", both)

    def make(title: str) -> Callable[[], Any]:
        return lambda: scene_write(user=alma, name=None, given=cups(title))

    found = at_once(make("Hers"), make("His"))
    refused = [one for one in found if isinstance(one, Exception)]
    assert [type(one) for one in refused] == [SceneRefused], found
    assert "already exists" in str(refused[0])
    assert Scene.objects.filter(name="cups").count() == 1


@pytest.mark.django_db(transaction=True)
def test_two_plans_of_one_title_get_two_names() -> None:
    alma = person("alma", "admin")
    found = at_once(*[lambda: plan_draft(user=alma, title="Cups")] * 2)
    assert not [one for one in found if isinstance(one, Exception)], found
    assert sorted(Plan.objects.values_list("name", flat=True)) == ["cups", "cups-2"]


@pytest.mark.django_db(transaction=True)
def test_two_forms_of_one_name_are_one_row_and_no_fault_of_the_web() -> None:
    alma = person("alma", "admin")

    def send() -> int:
        client = Client(raise_request_exception=False)
        client.force_login(alma)
        address = reverse("admin:trials_checkpoint_add")
        return client.post(address, {"name": "pi0"}, headers={"Accept": "text/html"}).status_code

    statuses = sorted(at_once(send, send))
    assert statuses in ([200, 302], [302, 409]), statuses
    assert Checkpoint.objects.filter(name="pi0").count() == 1


def test_a_name_that_was_taken_is_a_sentence_and_any_other_fault_stays_one() -> None:
    request = RequestFactory().post("/setup/scenes/new/", headers={"Accept": "application/json"})
    answer = RefusalMiddleware(lambda request: None).process_exception(request, TAKEN_NAME)
    assert answer is not None
    assert (answer.status_code, TAKEN in answer.content.decode()) == (409, True)
    for other in (
        IntegrityError("NOT NULL constraint failed: trials_scene.title"),
        ValueError("UNIQUE constraint"),
    ):
        assert not is_duplicate(other)
        assert RefusalMiddleware(lambda request: None).process_exception(request, other) is None


@pytest.mark.django_db
def test_rest_says_it_too(client: Client, monkeypatch: pytest.MonkeyPatch) -> None:
    def taken(**given: object) -> None:
        raise TAKEN_NAME

    client.force_login(person("ann", "operator"))
    monkeypatch.setattr("evaweb.api.jobs.services.cancel", taken)
    monkeypatch.setattr("evaweb.api.jobs.job_get", lambda id: None)
    answer = client.post(reverse("api:job-cancel", args=[1]))
    assert (answer.status_code, answer.json()["error"]) == (409, TAKEN)


@pytest.mark.django_db(transaction=True)
def test_a_write_is_done_again_once_and_only_where_a_name_was_taken() -> None:
    faults: list[Exception] = [TAKEN_NAME]
    times: list[int] = []

    @once_more
    def write() -> str:
        times.append(1)
        if faults:
            raise faults.pop()
        return "written"

    assert (write(), len(times)) == ("written", 2)
    faults[:] = [TAKEN_NAME, TAKEN_NAME]
    with pytest.raises(IntegrityError):
        write()
    faults[:] = [EvaError("no")]
    with pytest.raises(EvaError):
        write()
    assert len(times) == 5
    close_old_connections()
