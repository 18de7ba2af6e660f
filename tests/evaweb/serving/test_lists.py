"""What the address of a list says, and what it is shown as."""

from types import SimpleNamespace

import pytest
from django.http import QueryDict
from django.test import Client

from evaweb.core.errors import EvaError
from evaweb.plans.allocation import allocate_trial
from evaweb.plans.blinding_rules import record_unblinding
from evaweb.plans.models import Plan
from evaweb.plans.services import freeze_plan
from evaweb.serving.lists import (
    SEARCH,
    UNSEEN,
    Column,
    Filter,
    Listing,
)
from evaweb.trials.models import Checkpoint
from tests.evaweb.blind_lab import NAMES
from tests.evaweb.trials import builders

COLUMNS = (
    Column("name", "Name", ("name",), lambda row: row.name),
    Column("size", "Size", ("size", "name"), lambda row: row.size, number=True),
    Column("secret", "Secret"),
    Column("path", "Path", cell=lambda row: row.path, hidden=True),
)
FILTERS = (
    Filter("kind", "Kind", (("a", "an A"), ("b", "a B"))),
    Filter("from", "From", kind=UNSEEN),
    Filter("words", "Words", kind=SEARCH),
)


def listing(query=""):
    return Listing(QueryDict(query), COLUMNS, FILTERS)


def test_a_head_sorts_turns_round_and_lets_go():
    ways = [(head.column.name, head.next, head.sorted) for head in listing().heads]
    assert ways == [("name", "name", ""), ("size", "-size", ""), ("secret", "secret", "")]
    assert [head.next for head in listing("sort=name").heads][:2] == ["-name", "-size"]
    assert next((head.next, head.sorted) for head in listing("sort=-name").heads) == (None, "descending")
    assert [(head.next, head.sorted) for head in listing("sort=-size").heads][1] == ("size", "descending")


@pytest.mark.parametrize(
    ("query", "said"),
    [
        ("sort=secret", "sort = 'secret'; allowed: name, size, each also with - in front"),
        ("sort=path", "sort = 'path'; allowed: name, size"),
        ("kind=c", "kind = 'c'; allowed: a, b"),
        (f"words={'a+' * 500}", "words has 999 characters; allowed: at most 200"),
        ("words=a+b+c+d+e+f+g+h+i+j+k+l+m+n+o+p+q+q", "words has 17 different words; allowed: at most 16"),
    ],
)
def test_what_is_unknown_is_named_and_nothing_is_narrowed(query, said):
    found = listing(f"{query}&from=x")
    assert said in found.fault
    assert (found.sort, found.chips, found.chosen) == ("", [], {"kind": "", "from": "", "words": ""})


def test_what_is_unknown_makes_no_file_of_everything(rf):
    asked = rf.get("/list", {"kind": "c", "format": "csv"})
    with pytest.raises(EvaError, match="kind = 'c'; allowed: a, b"):
        Listing(asked.GET, COLUMNS, FILTERS).file(asked, "all", [SimpleNamespace(name="x", size=1, path="y")])


@pytest.mark.django_db
def test_a_thousand_words_are_refused_on_the_page_of_episodes(client):
    client.force_login(builders.user("ann"))
    answer = client.get("/replay/", {"words": "a " * 1500})
    assert answer.status_code == 200
    assert "words has 2999 characters; allowed: at most 200" in answer.content.decode()


def test_each_chip_leads_to_the_list_without_it():
    chips = listing("kind=a&from=there&sort=name&page=3").chips
    assert [(chip.words, chip.without) for chip in chips] == [
        ("Kind: an A", "from=there&sort=name"),
        ("From: there", "kind=a&sort=name"),
    ]


def test_a_page_that_refuses_shows_all():
    found = listing("kind=a&sort=name")
    found.refuse(EvaError("no"))
    assert (found.fault, found.sort, found.chips) == ("no", "", [])


def test_what_is_not_known_comes_last_either_way():
    rows = [SimpleNamespace(name=name) for name in ("b", None, "a")]
    assert [row.name for row in listing("sort=name").sorted(rows)] == ["a", "b", None]
    assert [row.name for row in listing("sort=-name").sorted(rows)] == ["b", "a", None]


@pytest.mark.django_db
@pytest.mark.parametrize("address", ["/replay/", "/result/"])
def test_nobody_from_whom_checkpoints_are_hidden_sorts_by_them(address, settings, tmp_path):
    settings.DATA_DIR = tmp_path
    bench, olga = builders.bench(), builders.user("olga")
    plan = Plan.objects.create(name="blocks", title="Blocks", owner=olga)
    plan.checkpoints.set(Checkpoint.objects.create(name=name, policy={"url": "ws://h:1"}) for name in NAMES)
    plan.positions.set(bench.scene.positions.all())
    plan = freeze_plan(user=olga, plan=plan)
    trial = builders.finished_trial(
        allocate_trial(user=bench.operator, station=bench.station, plan=plan).trial
    )
    browser = Client()
    browser.force_login(bench.operator)
    for sort in ("checkpoint", "-checkpoint"):
        text = browser.get(address, {"sort": sort}).content.decode()
        assert f"sort = &#x27;{sort}&#x27;; allowed:" in text
    assert "sort=checkpoint" not in browser.get(address).content.decode()
    file = b"".join(browser.get("/replay/", {"format": "csv"}).streaming_content).decode()
    assert trial.handout.code in file
    assert "secret" not in file
    record_unblinding(plan, olga)
    browser.force_login(olga)
    assert "aria-sort" in browser.get(address, {"sort": "checkpoint"}).content.decode()
